"""``real2sim demo``: serve a street, edit it over REST, drive it over WebSocket."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from real2sim import Client, ReplyTimeoutError, connect
from real2sim.planners import EpisodeSummary, FollowRoute, Planner, run_episode
from real2sim_proto.operations import Duplicate, Operation, Translate

from ..console import StatusLine, console, print_figures, write_json
from ..geometry import box_corners, transform_from
from ..render.images import video_file, write_png
from ..scene.io import DEMO_SCENE as SCENE

if TYPE_CHECKING:
    from real2sim import DriveSession, Observation
    from real2sim_proto.scenes import ObjectInfo, SceneInfo


# --- Worker ---------------------------------------------------------------------------------------

START_S = 180.0


class WorkerStartError(RuntimeError):
    """A worker that did not start."""


@dataclass(frozen=True)
class WorkerProcess:
    """A running `real2sim serve`.

    Attributes:
        url: its address.
        process: its process.
        log_file: its output.
    """

    url: str
    process: subprocess.Popen[bytes]
    log_file: Path

    def wait_listening(self, seconds: float = START_S) -> None:
        """Wait until the port is open; the worker may not be ready yet.

        Raises:
            WorkerStartError: it exited, or did not listen in time; with the last line of its log.
        """
        port = int(self.url.rsplit(":", 1)[1])
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise self._failed(f"ended with exit code {self.process.returncode}")
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                return
            time.sleep(0.1)
        raise self._failed(f"did not listen within {seconds:.0f} s")

    def _failed(self, what: str) -> WorkerStartError:
        lines = self.log_file.read_text(errors="replace").strip().splitlines()
        last = lines[-1] if lines else "it printed nothing"
        return WorkerStartError(f"the worker {what}: {last} (see {self.log_file})")


@contextlib.contextmanager
def worker_process(*, scenes: Path, data: Path, log_file: Path) -> Iterator[WorkerProcess]:
    """Start ``real2sim serve`` on a free loopback port, wait until it listens, and stop it on exit.

    Arguments as for :func:`starting_worker`.

    Raises:
        WorkerStartError: it exited, or did not listen in time; with the last line of its log.
    """
    with starting_worker(scenes=scenes, data=data, log_file=log_file) as worker:
        worker.wait_listening()
        yield worker


@contextlib.contextmanager
def starting_worker(*, scenes: Path, data: Path, log_file: Path) -> Iterator[WorkerProcess]:
    """Like :func:`worker_process`, without waiting, so that other work can run meanwhile.

    Args:
        scenes: folder of scene bundles.
        data: folder for its scenarios and sessions.
        log_file: file for the worker's output.
    """
    port = _free_port()
    command = [sys.executable, "-m", "real2sim", "serve", "--port", str(port)]
    command += ["--scenes", str(scenes), "--data", str(data)]
    log_file.parent.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("REAL2SIM_")}
    with log_file.open("wb") as output:
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment
        )
        try:
            yield WorkerProcess(f"http://127.0.0.1:{port}", process, log_file)
        finally:
            _stop(process)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _stop(process: subprocess.Popen[bytes]) -> None:
    # As Ctrl-C does. On SIGTERM, a worker would first wait for proxies to notice.
    process.send_signal(signal.SIGINT)
    try:
        process.wait(timeout=15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# --- Edits ---------------------------------------------------------------------------------------

# One car moved, another duplicated, both to free places.

AHEAD = (6.0, 45.0)
"""Distance range ahead of the start for edited cars [m], where the camera sees them well."""

WIDTH = 960


@dataclass(frozen=True)
class StreetEdits:
    """The edits, and images of them.

    Attributes:
        moved, duplicated: ids of the two edited cars.
        before, after: RGB uint8 [H, W, 3] of the same camera.
        logged: [L, 2] path of the recording vehicle [m].
        footprints: (id, corners [4, 2] at the start [m], whether it was edited) of every object.
        gaussians: number of Gaussians of the scene.
    """

    moved: str
    duplicated: str
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    logged: NDArray[np.float64]
    footprints: list[tuple[str, NDArray[np.float64], bool]]
    gaussians: int


def edit_street(scenario: Any, scene: SceneInfo, *, camera: str) -> StreetEdits:
    """Move one parked car and duplicate another, with images before and after."""
    before = scenario.preview(camera=camera, width=WIDTH, codec="jpeg").array
    candidates = _standing_cars(scenario.info.objects, scene)
    moved = _apply_first_without_overlap(scenario, _moves(candidates))
    others = [car for car in candidates if car.object_id != moved.object_id]
    copied = _apply_first_without_overlap(scenario, _copies(others or candidates))
    after = scenario.preview(camera=camera, width=WIDTH, codec="jpeg").array
    objects = scenario.refresh().info.objects
    original = {info.object_id for info in scene.objects}
    edited = {moved.object_id} | {o.object_id for o in objects if o.object_id not in original}
    return StreetEdits(
        moved=moved.object_id,
        duplicated=copied.object_id,
        before=before,
        after=after,
        logged=np.array(scene.ego.positions if scene.ego else [])[:, :2],
        footprints=[(o.object_id, _footprint(o), o.object_id in edited) for o in objects],
        gaussians=scene.gaussians,
    )


def _standing_cars(objects: Sequence[ObjectInfo], scene: SceneInfo) -> list[ObjectInfo]:
    """Stationary cars ahead of the start, nearest first."""
    start = np.array(scene.ego.positions[0]) if scene.ego else np.zeros(3)
    found = []
    for info in objects:
        if info.trajectory is None or info.trajectory.times_us[0] > scene.start_us:
            continue
        places = np.array(info.trajectory.positions)
        ahead = places[0, 0] - start[0]
        if np.ptp(places, axis=0).max() < 0.3 and AHEAD[0] < ahead < AHEAD[1]:
            found.append((ahead, info))
    return [info for _, info in sorted(found, key=lambda pair: pair[0])]


def _moves(cars: Sequence[ObjectInfo]) -> Iterator[Operation]:
    """Operations that move a car from its parking space into the adjacent lane, same heading."""
    for car in cars:
        position = np.array(car.trajectory.positions[0]) if car.trajectory else np.zeros(3)
        inward = -np.sign(position[1]) * (car.size[1] + 0.9)
        for along in (0.0, 3.0, -3.0, 6.0):
            yield Translate(object_id=car.object_id, x=along, y=float(inward), frame="world")


def _copies(cars: Sequence[ObjectInfo]) -> Iterator[Operation]:
    """Operations that duplicate a car, one or two lengths ahead or behind."""
    for car in cars:
        for lengths in (1.25, -1.25, 2.5, -2.5):
            yield Duplicate(object_id=car.object_id, x=lengths * car.size[0], frame="object")


def _apply_first_without_overlap(scenario: Any, operations: Iterator[Operation]) -> Any:
    """Try operations as dry runs; apply the first one without warnings, else the first one."""
    first: Operation | None = None
    for operation in operations:
        first = first or operation
        if not scenario.apply([operation], dry_run=True).warnings:
            first = operation
            break
    if first is None:
        raise RuntimeError("the demo street has no standing car ahead of the start")
    scenario.apply([first])
    return first


def _footprint(info: ObjectInfo) -> NDArray[np.float64]:
    assert info.trajectory is not None
    pose = transform_from(info.trajectory.positions[0], info.trajectory.quaternions[0])
    corners = box_corners(pose, info.size)
    return corners[[0, 1, 3, 2], :2]


# --- Pictures ------------------------------------------------------------------------------------

Image = NDArray[np.uint8]

CAPTION_BACKGROUND = (32, 36, 44)
EGO_COLOR = "#1f6feb"
OBJECT_COLOR = "#8b949e"
EDITED_COLOR = "#d1495b"


def mosaic(images: Sequence[Image], caption: str) -> Image:
    """Images of equal height side by side, above a caption."""
    row = np.concatenate(images, axis=1)
    bar = np.full((24, row.shape[1], 3), CAPTION_BACKGROUND, dtype=np.uint8)
    cv2.putText(
        bar, caption, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA
    )
    return np.concatenate([row, bar], axis=0)


def draw_map(
    path: Path,
    *,
    logged: NDArray[np.float64],
    driven: NDArray[np.float64],
    boxes: Sequence[tuple[str, NDArray[np.float64], bool]],
) -> None:
    """A top-down plot of the drive.

    Args:
        path: PNG to write.
        logged: [L, 2] path of the recording vehicle, world [m].
        driven: [N, 2] path of the controlled vehicle, world [m].
        boxes: (id, footprint [4, 2] in the world [m], whether it was edited).
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(12, 4.2), dpi=120)
    for name, corners, edited in boxes:
        color = EDITED_COLOR if edited else OBJECT_COLOR
        axes.fill(corners[:, 0], corners[:, 1], color=color, alpha=0.55 if edited else 0.35)
        if edited:
            x, y = corners.mean(axis=0)
            axes.annotate(name, (x, y + 1.6), color=color, fontsize=8, ha="center")
    axes.plot(logged[:, 0], logged[:, 1], color="black", lw=1, ls="--", label="recorded")
    axes.plot(driven[:, 0], driven[:, 1], color=EGO_COLOR, lw=2.5, alpha=0.8, label="driven")
    axes.set_aspect("equal")
    margin = 15.0
    axes.set_xlim(driven[:, 0].min() - margin, driven[:, 0].max() + margin)
    axes.set_ylim(driven[:, 1].min() - margin, driven[:, 1].max() + margin)
    axes.set_xlabel("x, forward at the start [m]")
    axes.set_ylabel("y, left [m]")
    axes.set_title("the drive from above; edited objects in red")
    axes.legend(loc="upper left", frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)


CAMERAS = ("front_left", "front", "front_right")
STEP_US = 100_000
QUIET_S, POLL_S, WARM_UP_S = 5.0, 1.0, 600.0


def run(*, out: Path, steps: int, from_log: bool, leave_serving: bool) -> None:
    """Run the whole demo and write the results to ``out``.

    Args:
        out: output folder; results of an earlier demo are replaced.
        steps: clock steps of 0.1 s to drive; the shipped street ends after 100.
        from_log: record a drive and reconstruct it without training, instead of unpacking the
            trained street that is shipped.
        leave_serving: keep the worker running until Ctrl-C, and print what to try next.
    """
    clock = StageTimer()
    scenes = _clear(out)
    with starting_worker(scenes=scenes, data=out / "worker", log_file=out / "worker.log") as worker:
        # Runs while the worker starts; both take about as long.
        _prepare_street(out, scenes, steps, clock, from_log=from_log)

        with connect(worker.url) as client:
            with clock("start the worker"):
                worker.wait_listening()
                wait_ready(client)
                client.scenes.load(SCENE)
            with clock("edit over REST"):
                scenario = client.scenarios.create(scene=SCENE, name="demo")
                edits = edit_street(scenario, client.scenes.get(SCENE), camera="front")
            with clock("drive over WebSocket"):
                session = client.session(scenario=scenario.scenario_id)
                drive = drive_through(
                    session,
                    FollowRoute(speed=8.0),
                    cameras=CAMERAS,
                    steps=steps,
                    dt_us=STEP_US,
                    video_path=out / "drive.webm",
                )
        with clock("leave pictures"):
            _leave_pictures(out, edits, drive)
        figures = _summary(edits, drive, clock)
        write_json(out / "summary.json", figures)
        _report(out, drive, clock)
        if leave_serving:
            _keep_serving(worker.url, scenario.scenario_id)


class StageTimer:
    """Wall-clock seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the block as ``stage``, and print its name."""
        start = time.perf_counter()
        with console.status(stage) if console.is_terminal else nullcontext():
            yield
        self.seconds[stage] = time.perf_counter() - start


def wait_ready(client: Client) -> None:
    """Wait for the worker, and print its state if this takes long.

    Raises:
        ReplyTimeoutError: it is not ready after ten minutes.
    """
    deadline = time.monotonic() + WARM_UP_S
    line, timeout = StatusLine(), QUIET_S
    try:
        while True:
            try:
                client.wait_ready(timeout=timeout)
                return
            except ReplyTimeoutError as error:
                if time.monotonic() > deadline:
                    raise
                line.show(f"the worker is not ready yet: {error.hint}")
            timeout = POLL_S
    finally:
        line.end()


def _clear(out: Path) -> Path:
    """Remove the results of an earlier demo; return the folder for scenes."""
    for stale in ("log", "scenes", "worker"):
        shutil.rmtree(out / stale, ignore_errors=True)
    scenes = out / "scenes"
    scenes.mkdir(parents=True)
    return scenes


def _prepare_street(
    out: Path, scenes: Path, steps: int, clock: StageTimer, *, from_log: bool
) -> None:
    from .street import UNTRAINED_HZ, build_street, record_street, unpack_street

    if not from_log:
        with clock("unpack the street"):
            unpack_street(scenes, SCENE)
        return
    log = out / "log"
    with clock("record a synthetic drive"):
        record_street(log, duration_s=(steps + 2) * STEP_US * 1e-6, hz=UNTRAINED_HZ)
    with clock("reconstruct it"):
        build_street(log, scenes, SCENE)


def _leave_pictures(out: Path, edits: StreetEdits, drive: FilmedDrive) -> None:
    write_png(out / "edit_before.png", edits.before)
    write_png(out / "edit_after.png", edits.after)
    for step, picture in drive.stills.items():
        write_png(out / f"drive_{step:03d}.png", picture)
    draw_map(out / "map.png", logged=edits.logged, driven=drive.path, boxes=edits.footprints)


def _summary(edits: StreetEdits, drive: FilmedDrive, clock: StageTimer) -> dict[str, object]:
    return {
        "scene": SCENE,
        "gaussians": edits.gaussians,
        "objects": len(edits.footprints),
        "moved": edits.moved,
        "duplicated": edits.duplicated,
        "cameras": list(CAMERAS),
        "stages_s": clock.seconds,
        "episode": drive.summary.to_dict(),
    }


def _report(out: Path, drive: FilmedDrive, clock: StageTimer) -> None:
    episode = drive.summary
    figures: dict[str, object] = {f"{k} [s]": v for k, v in clock.seconds.items()}
    figures |= {
        "steps driven": episode.steps,
        "distance [m]": episode.distance,
        "ended by": episode.reason or "steps done",
        "steps per second": episode.steps_per_second,
    }
    figures |= {f"{name} p50 [ms]": times.p50 for name, times in episode.stages.items()}
    print_figures("demo", figures)
    console.print(
        f"in {out}: drive.webm, edit_before.png, edit_after.png, map.png, summary.json",
        highlight=False,
    )


def _keep_serving(url: str, scenario_id: str) -> None:
    preview = f"{url}/v1/scenarios/{scenario_id}/preview?camera=front"
    operations = '{"operations": [{"op": "rotate", "object_id": "car_1", "angle": 0.26}]}'
    console.print(
        f"\nthe worker stays up at {url} until Ctrl-C; next, in another terminal:\n\n"
        f"  curl '{preview}' -o now.jpg\n"
        f"  curl -X POST {url}/v1/scenarios/{scenario_id}/operations \\\n"
        f"       -H 'Content-Type: application/json' -d '{operations}'\n"
        f"  real2sim drive --url {url} --scenario {scenario_id} --steps 50 --out out/drive\n",
        highlight=False,
        soft_wrap=True,
    )
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        console.print("stopped")


# --- Drive ---------------------------------------------------------------------------------------

STILLS = 3
FILM_WIDTH = 960
"""Width of the film [px]; encoding at the size of the stills would take longer than rendering."""


@dataclass
class FilmedDrive:
    """A driven episode.

    Attributes:
        summary: figures of the episode.
        path: [N, 2] world positions of the vehicle, one per step [m].
        stills: a few frames of the film, by step.
    """

    summary: EpisodeSummary
    path: NDArray[np.float64]
    stills: dict[int, Image] = field(default_factory=dict)


def drive_through(
    session: DriveSession,
    planner: Planner,
    *,
    cameras: Sequence[str],
    steps: int,
    dt_us: int,
    video_path: Path,
) -> FilmedDrive:
    """Drive ``steps`` steps with ``planner`` and film all cameras side by side.

    Args:
        session: unopened session; closed afterwards.
        planner: planner that drives.
        cameras: cameras from left to right.
        steps, dt_us: number and length [us] of clock steps.
        video_path: WebM file to write.
    """
    path: list[tuple[float, float]] = []
    stills: dict[int, Image] = {}
    wanted = {round(steps * (i + 1) / (STILLS + 1)) for i in range(STILLS)}
    with session, video_file(video_path, frames_per_second=1e6 / dt_us) as film:

        def watch(obs: Observation) -> None:
            caption = (
                f"t {obs.t_us * 1e-6:5.1f} s   {obs.ego.speed * 3.6:4.1f} km/h   "
                f"step {obs.step}   {obs.command}"
            )
            picture = mosaic([obs.image(camera) for camera in cameras], caption)
            film.add(_shrunk(picture))
            path.append(obs.ego.position[:2])
            if obs.step in wanted:
                stills[obs.step] = picture

        summary = run_episode(
            session,
            planner,
            steps=steps,
            sensors=list(cameras),
            on_observation=watch,
            seed=0,
            dt_us=dt_us,
            privileged=True,
        )
    return FilmedDrive(summary=summary, path=np.array(path), stills=stills)


def _shrunk(picture: Image) -> Image:
    height, width = picture.shape[:2]
    size = FILM_WIDTH, round(height * FILM_WIDTH / width)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
