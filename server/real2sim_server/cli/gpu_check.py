"""``real2sim doctor --gpu-check``: checks and measurements for a new GPU; takes a few minutes.

The parts run independently and report their own errors. Comparisons use the CPU backends of the
same machine.
"""

from __future__ import annotations

import functools
import importlib.metadata
import math
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import transform_from, yaw_quaternion
from ..physics.body import Body, box_particles
from ..physics.colliders import Plane
from ..physics.materials import FixedCorotated
from ..physics.solver import Solver, SolverOptions
from ..reconstruct.initialise.stage0 import initialise_scene
from ..reconstruct.options import InitialiseOptions
from ..reconstruct.training.densify import DensifyOptions
from ..reconstruct.training.schedule import TrainOptions
from ..reconstruct.training.trainer import Trainer
from ..render import Instance, RigView, encode_rgb, render_rigs, select_backend
from ..render.backend import Backend, device_of
from ..render.cast import CastBackend, select_caster
from ..render.cast.call import checked_request
from ..render.images import JpegEncoder, jpeg_encoder_for
from ..scene import Beams, Camera, Lidar, Sky
from ..scene.camera import T_VEHICLE_OPTICAL
from ..synthetic import CameraSpec, SyntheticConfig, generate_log
from ..synthetic.gaussian_street import StreetScene, street_scene

DISTRIBUTIONS = ("real2sim", "torch", "gsplat", "numba-cuda", "cuda-core", "nvidia-nvimgcodec-cu13")
STREET_GAUSSIANS = 100_000
"""Minimum number of Gaussians of a generated street; smaller cases use a subset."""
DISTANCES = (0.0, 2_000.0, 10_000.0)
"""Distances from the world origin at which images are compared [m]."""
YAWS = (0.0, 1.05, -1.05, 2.1, -2.1)
IMAGES = ("rgb", "depth", "instance")
COMPARED = (*IMAGES, "median_depth", "semantic")
SUBSTEPS = 64
TRAINED_WITHIN = 0.02
"""Tolerance of the final training loss, relative to the CPU's."""


@dataclass(frozen=True)
class FrameCase:
    """A set of images of one instant; ``wanted_ms`` is the maximum time."""

    cameras: int
    width: int
    height: int
    gaussians: int
    objects: int
    wanted_ms: float | None = None
    jpeg: bool = False


@dataclass(frozen=True)
class Scale:
    """Size of the checks.

    Attributes:
        compared: number of Gaussians for image comparisons, at width ``compared_width`` [px].
        frames: timed cases, ``repeats`` times each.
        rays: rows and columns of the LiDAR sweep.
        particles: particle counts of the falling block, one run each.
        train_steps, train_width, train_frames, train_gaussians: size of the short training; the
            last is the maximum number of Gaussians of the background.
    """

    compared: int = 200_000
    compared_width: int = 480
    frames: tuple[FrameCase, ...] = (
        FrameCase(1, 1920, 1280, 1_000_000, 20),
        FrameCase(3, 1600, 1066, 1_000_000, 20, wanted_ms=1000 / 120),
        FrameCase(5, 1920, 1280, 3_000_000, 40, wanted_ms=12.0, jpeg=True),
    )
    repeats: int = 40
    rays: tuple[int, int] = (64, 1024)
    particles: tuple[int, ...] = (100_000, 1_000_000)
    train_steps: int = 50
    train_width: int = 160
    train_frames: int = 4
    train_gaussians: int = 20_000


@dataclass(frozen=True, eq=False)
class Devices:
    """Backends to check.

    Attributes:
        serving: creates the backend that renders frames.
        training: backend for training, or its name.
        physics: name of the solver backend.
        casting: creates the backend that casts LiDAR rays.
        name: name of the device, for the table.
    """

    serving: Callable[[], Backend]
    training: str | Backend
    physics: str
    casting: Callable[[], CastBackend]
    name: str


@dataclass(frozen=True)
class Finding:
    """A row of the table; ``holds`` is None without an expected value."""

    part: str
    what: str
    found: str
    wanted: str = ""
    holds: bool | None = None


@dataclass
class GpuCheck:
    """Results of the check.

    Attributes:
        device: name of the device.
        date: ISO 8601 date of the check.
        findings: rows, in the order of the parts.
        failed: error messages, by part.
    """

    device: str
    date: str
    findings: list[Finding] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    @property
    def right(self) -> bool:
        """Whether every part ran and all comparisons agree, regardless of speed."""
        compared = (f.holds for f in self.findings if f.part in ("images", "lidar", "training"))
        return not self.failed and False not in compared

    def markdown(self) -> str:
        """The results as a Markdown table, as in ``docs/gpu.md``."""
        lines = [f"Checked on {self.date}: {self.device}", ""]
        lines += ["| Part | Check | Measured | Target |", "|---|---|---|---|"]
        for finding in self.findings:
            mark = {None: "", True: " (met)", False: " (**not met**)"}[finding.holds]
            lines.append(
                f"| {finding.part} | {finding.what} | {finding.found} | {finding.wanted}{mark} |"
            )
        lines += [f"| {part} | failed | {why} | |" for part, why in self.failed.items()]
        return "\n".join(lines) + "\n"


def this_gpu() -> Devices:
    """The GPU of this machine: serving kernels, gsplat for training, the solver on CUDA."""
    properties = torch.cuda.get_device_properties(0)
    name = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB"
    return Devices(
        partial(select_backend, "nvrtc"), "cuda", "cuda", partial(select_caster, "cuda"), name
    )


def run(
    devices: Devices,
    scale: Scale | None = None,
    *,
    parts: Iterable[str] | None = None,
    on_part: Callable[[str], object] = lambda part: None,
) -> GpuCheck:
    """Run the parts.

    Args:
        devices: backends to check.
        scale: size of the checks.
        parts: names from PARTS; all by default.
        on_part: called with the name of each part before it starts.
    """
    check = GpuCheck(devices.name, datetime.now(UTC).date().isoformat())
    for part in parts or PARTS:
        on_part(part)
        try:
            for finding in PARTS[part](devices, scale or Scale()):
                check.findings.append(replace(finding, part=part))
        except Exception as error:
            reason = " ".join(str(error).split())[:300]
            check.failed[part] = f"{type(error).__name__}: {reason}"
    return check


# --- parts --------------------------------------------------------------------------------------


def _install(devices: Devices, scale: Scale) -> Iterator[Finding]:
    versions = {"Python": platform.python_version()}
    for name in DISTRIBUTIONS:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    yield _note("versions", ", ".join(f"{name} {version}" for name, version in versions.items()))
    yield _note("cores", str(os.cpu_count()))
    if not torch.cuda.is_available():
        return
    yield _note("CUDA of torch", str(torch.version.cuda))
    block = torch.empty(1 << 28, device="cuda")
    other = torch.empty_like(block)
    copied_ms = _median_ms(lambda: _synchronized(other.copy_, block), 10)
    yield _note("copy on the device", f"{2 * block.nbytes / copied_ms / 1e9:.2f} TB/s")
    images = torch.empty(5 * 1920 * 1280 * 3, dtype=torch.uint8, device="cuda")
    pinned = torch.empty(images.shape, dtype=torch.uint8, pin_memory=True)
    for name, target in (("pinned", pinned), ("pageable", torch.empty_like(pinned))):
        ms = _median_ms(lambda target=target: _synchronized(target.copy_, images), 10)  # type: ignore[misc]
        yield _note(f"37 MB to {name} memory", f"{ms:.2f} ms")


def _images(devices: Devices, scale: Scale) -> Iterator[Finding]:
    """Images of the serving kernels and the CPU backend, at several distances from the origin."""
    serving, cpu = devices.serving(), select_backend("cpu")
    width = scale.compared_width
    street = _street(scale.compared)
    for distance in DISTANCES:
        view = _view(street, FrameCase(2, width, width * 2 // 3, 0, 24), distance)
        drawn, expected = (
            render_rigs([view], modalities=COMPARED, backend=backend)[0]
            for backend in (serving, cpu)
        )
        pairs = list(zip(drawn, expected, strict=True))
        apart = max(int(np.abs(a.rgb.astype(int) - b.rgb).max()) for a, b in pairs)
        where = f"{distance / 1e3:g} km from the origin"
        yield Finding(
            "",
            f"largest colour difference from the CPU, {where}",
            f"{apart} levels",
            "1",
            apart <= 1,
        )
        for name in ("instance", "semantic"):
            differ = sum(int((a.images[name] != b.images[name]).sum()) for a, b in pairs)
            what = f"pixels of another {name}, {where}"
            yield Finding("", what, str(differ), "0", differ == 0)
        both = [(a.images["median_depth"], b.images["median_depth"]) for a, b in pairs]
        share = float(np.mean([np.abs(a - b) > 1e-3 for a, b in both]))
        yield Finding(
            "",
            f"median depths that differ by 1 mm, {where}",
            f"{share:.2%}",
            "0.1 %",
            share <= 1e-3,
        )


def _lidar(devices: Devices, scale: Scale) -> Iterator[Finding]:
    """A sweep of a moving sensor, compared with the CPU backend, and its time."""
    rows, columns = scale.rays
    beams = Beams.spinning(np.radians(np.linspace(-24.0, 4.0, rows)), columns=columns)
    lidar = Lidar("check", beams, min_range=1.0, max_range=120.0, returns=2)
    view = _view(_street(scale.compared), FrameCase(1, 16, 16, 0, 24))
    ahead = np.stack(
        [15e-6 * beams.slots[0], 0 * beams.slots[0], np.full(len(beams.slots[0]), 1.8)]
    )
    poses = np.asarray(view.T_world_vehicle) @ transform_from(ahead.T, yaw_quaternion(0.0))
    request = checked_request(view.instances, lidar, poses)
    caster = devices.casting()
    found, expected = caster.cast(request), select_caster("cpu").cast(request)
    differ = float((found.member != expected.member).mean())
    yield Finding("", "rays that hit another Gaussian", f"{differ:.3%}", "0.1 %", differ <= 1e-3)
    same = (found.member == expected.member) & expected.hit
    apart = float(np.abs(found.range - expected.range)[same].max(initial=0.0))
    yield Finding(
        "", "largest range difference of the others", f"{apart * 1e3:.3f} mm", "1 mm", apart <= 1e-3
    )
    times = _times_ms(partial(caster.cast, request), scale.repeats)
    yield _timed(f"{beams.count:,} rays, two returns", times, None)


def _frames(devices: Devices, scale: Scale) -> Iterator[Finding]:
    """Times of complete sets of images, on the host."""
    serving = devices.serving()
    for case in scale.frames:
        view = _view(_street(case.gaussians), case)
        draw = partial(render_rigs, [view], modalities=IMAGES, backend=serving)
        times = _times_ms(draw, scale.repeats)
        cameras = "1 camera" if case.cameras == 1 else f"{case.cameras} cameras"
        name = (
            f"{cameras} {case.width}x{case.height}, {case.gaussians / 1e6:g} M Gaussians, "
            f"{case.objects} objects: colour, depth, instance"
        )
        yield _timed(name, times, None if case.jpeg else case.wanted_ms)
        if case.jpeg:
            jpeg, why = jpeg_encoder_for(device_of(serving))
            with ThreadPoolExecutor(case.cameras) as encoders:
                make = partial(_draw_jpegs, view, serving, encoders, jpeg)
                encoded = _times_ms(make, scale.repeats)
            yield _timed(f"{name.partition(':')[0]}: jpeg by {why}", encoded, case.wanted_ms)


def _physics(devices: Devices, scale: Scale) -> Iterator[Finding]:
    for asked in scale.particles:
        solver = _falling_block(asked, devices.physics)
        count, dt = len(solver.model.masses), solver.time_step()

        def advance(solver: Solver = solver, dt: float = dt) -> None:
            solver.simulation.advance(SUBSTEPS, dt, solver.colliders)
            solver.simulation.measure()  # Waits; reading particles would copy them.

        ms = _median_ms(advance, 3) / SUBSTEPS
        rate = count / ms / 1e3
        wanted = "500" if asked >= 1_000_000 else ""
        holds = rate >= 500 if wanted else None
        found = f"{rate:.1f} M particle-substeps/s, {ms:.3f} ms a substep"
        yield Finding("", f"{count:,} particles", found, wanted, holds)


def _training(devices: Devices, scale: Scale) -> Iterator[Finding]:
    """The same short training on the device and on the CPU."""
    width, steps = scale.train_width, scale.train_steps
    log = generate_log(
        SyntheticConfig(
            seed=5,
            frames=scale.train_frames,
            width=width,
            height=width,
            samples=1,
            cameras=(CameraSpec("front", fov=math.radians(81)),),
            lidar_beams=16,
            lidar_columns=180,
            parked_cars=2,
            moving_cars=1,
        )
    )
    options = TrainOptions(
        iterations=steps,
        hold_out=0,
        sky_resolution=16,
        checkpoint_every=0,
        log_every=10 * steps,
        width=width,
        max_width=width,
        densify=DensifyOptions(method="none", hidden_round=0),
        initialise=InitialiseOptions(
            voxel=0.5,
            ground_spacing=1.0,
            object_voxel=0.3,
            max_background=scale.train_gaussians,
            max_object=scale.train_gaussians // 4,
            sky_resolution=16,
        ),
    )
    scene = initialise_scene(log, options=options.initialise)
    losses, ms = {}, {}
    for name, backend in (("device", devices.training), ("CPU", "cpu")):
        with tempfile.TemporaryDirectory(prefix="real2sim-gpu-") as folder:
            trainer = Trainer(log, scene, options, folder=Path(folder), backend=backend)
            start = time.perf_counter()
            for _ in range(steps):
                losses[name] = sum(trainer.step().values())
            ms[name] = (time.perf_counter() - start) * 1e3 / steps
            trainer.views.close()
    apart = abs(losses["device"] / losses["CPU"] - 1)
    found = f"{losses['device']:.5f}, on the CPU {losses['CPU']:.5f}"
    yield Finding(
        "", f"loss after {steps} steps", found, f"{TRAINED_WITHIN:.0%}", apart <= TRAINED_WITHIN
    )
    yield _note(
        f"a step with {scene.gaussian_count:,} Gaussians",
        f"{ms['device']:.1f} ms, on the CPU {ms['CPU']:.1f} ms",
    )


def _memory(devices: Devices, scale: Scale) -> Iterator[Finding]:
    if torch.cuda.is_available():
        peak = torch.cuda.max_memory_allocated() / 2**30
        yield _note("most memory of the device that was taken", f"{peak:.2f} GiB")
    else:
        yield _note("most memory of the device that was taken", "torch sees no CUDA device")


PARTS: dict[str, Callable[[Devices, Scale], Iterator[Finding]]] = {
    "install": _install,
    "images": _images,
    "lidar": _lidar,
    "frames": _frames,
    "physics": _physics,
    "training": _training,
    "memory": _memory,
}
"""Parts by name, in order."""


# --- scenes and timing --------------------------------------------------------------------------


@functools.lru_cache(1)
def _whole_street(gaussians: int) -> StreetScene:
    return street_scene(gaussians)


def _street(gaussians: int) -> StreetScene:
    street = _whole_street(max(gaussians, STREET_GAUSSIANS))
    step = -(-street.gaussian_count // gaussians)
    if step == 1:
        return street
    thin = [
        replace(i, cloud=i.cloud.select(torch.arange(0, len(i.cloud), step)))
        for i in street.instances
    ]
    return replace(street, instances=thin)


def _view(street: StreetScene, case: FrameCase, distance: float = 0.0) -> RigView:
    """A view of the street from a vehicle on it, with everything shifted away from the origin."""
    away = transform_from([distance, -0.5 * distance, 0.0], yaw_quaternion(0.0))
    background, *cars = street.instances
    objects = [cars[k % len(cars)] for k in range(case.objects)]
    instances = [replace(background, T_world_object=away)]
    for k, car in enumerate(objects):
        beside = transform_from([0.0, 3.0 * (k // len(cars)), 0.0], yaw_quaternion(0.0))
        pose = away @ beside @ np.asarray(car.T_world_object)
        instances.append(Instance(car.cloud, pose, k + 1, semantic=26))
    vehicle = away @ transform_from([20.0, 0.0, 0.0], yaw_quaternion(0.0))
    cameras = [_camera(k, case) for k in range(case.cameras)]
    sky = Sky.uniform((0.5, 0.7, 0.9), resolution=64)
    return RigView(instances, cameras, vehicle, sky)


def _camera(index: int, case: FrameCase) -> Camera:
    focal = 0.9 * case.width
    K = np.array([[focal, 0, case.width / 2], [0, focal, case.height / 2], [0, 0, 1]])
    turned = transform_from([1.5, 0.0, 1.6], yaw_quaternion(YAWS[index]))
    pose: NDArray[np.float64] = turned @ T_VEHICLE_OPTICAL
    return Camera(f"camera {index}", case.width, case.height, K, pose)


def _draw_jpegs(
    view: RigView, serving: Backend, encoders: ThreadPoolExecutor, jpeg: JpegEncoder
) -> list[bytes]:
    [frames] = render_rigs([view], modalities=("rgb",), backend=serving)
    return list(encoders.map(lambda frame: encode_rgb(frame.rgb, "jpeg", jpeg=jpeg), frames))


def _falling_block(particles: int, backend: str) -> Solver:
    edge = round(particles ** (1 / 3))
    block = box_particles([0.05 * edge] * 3, spacing=0.05, density=1000.0)
    pose = transform_from([0.0, 0.0, 0.025 * edge + 1.0], yaw_quaternion(0.0))
    body = Body(
        name="block",
        particles=block.moved(pose),
        material=FixedCorotated(young=2e6, poisson=0.4),
        velocity=(0, 0, -2),
    )
    return Solver([body], [Plane(name="ground")], SolverOptions(backend=backend))


def _note(what: str, found: str) -> Finding:
    return Finding("", what, found)


def _timed(what: str, times_ms: Sequence[float], wanted_ms: float | None) -> Finding:
    middle = statistics.median(times_ms)
    late = sorted(times_ms)[int(0.95 * (len(times_ms) - 1))]
    found = f"p50 {middle:.2f} ms, p95 {late:.2f} ms, {1000 / middle:.0f} sets/s"
    if wanted_ms is None:
        return _note(what, found)
    return Finding("", what, found, f"{wanted_ms:.1f} ms", middle <= wanted_ms)


def _median_ms(work: Callable[[], object], repeats: int) -> float:
    return statistics.median(_times_ms(work, repeats))


def _times_ms(work: Callable[[], object], repeats: int) -> list[float]:
    """Time of each run [ms], after two warm-up runs."""
    for _ in range(2):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append((time.perf_counter() - start) * 1e3)
    return times


def _synchronized(copy: Callable[[torch.Tensor], object], source: torch.Tensor) -> None:
    copy(source)
    torch.cuda.synchronize()
