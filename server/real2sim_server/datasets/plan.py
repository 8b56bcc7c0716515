"""The plan of an export: sensors, times, clips, splits and variants of a drive."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from real2sim_proto.jobs import DatasetSweep, SweptValues
from real2sim_proto.operations import Operation

from ..edit import EditError, ScenarioState, apply_operations
from ..geometry import transform_from
from ..scene import Camera, CameraRig, Lidar, LidarError, Scene, SceneError
from ..scene.camera import T_VEHICLE_OPTICAL
from ..scene.range_sensors import catalogue_lidar, lidar_from_values
from .drive import DatasetError, Drive, ScenarioDrive
from .labels.boxes import BoxNoise
from .labels.points import ROOF
from .perturbed import Perturbation

# --- Rig -----------------------------------------------------------------------------------------

# Sensors of a data set from a file: cameras of the scene, new cameras, and a LiDAR.

Degrees = Annotated[float, Field(ge=-360, le=360)]


class RigCamera(BaseModel):
    """A camera of a rig file: a scene camera by its name, or a new one if ``hfov_deg`` is given.
    Without rotation a new camera looks along the vehicle's x axis.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,79}$")]
    width: Annotated[int, Field(ge=16, le=8192)] | None = None
    height: Annotated[int, Field(ge=16, le=8192)] | None = None
    hfov_deg: Annotated[float, Field(gt=1, lt=170)] | None = None
    position: tuple[float, float, float] = (1.5, 0.0, 1.5)
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0


class Rig(BaseModel):
    """A rig file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cameras: Annotated[list[RigCamera], Field(min_length=1, max_length=64)]
    lidar: str | dict[str, Any] | None = None


def read_rig(path: Path) -> dict[str, Any]:
    """The values of a rig file. Raises DatasetError for an invalid file."""
    try:
        values = json.loads(path.read_bytes())
        Rig.model_validate(values)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: is not a rig file ({error})") from error
    return dict(values)


def cameras_of(values: Mapping[str, Any], rig: CameraRig) -> list[Camera]:
    """The cameras of a rig file, in order.

    Raises:
        DatasetError: the values are invalid, the scene lacks a camera, or a name is not unique.
    """
    try:
        asked = Rig.model_validate(values).cameras
    except ValidationError as error:
        raise DatasetError(f"rig: {error}") from error
    names = [camera.name for camera in asked]
    if len(set(names)) != len(names):
        raise DatasetError(f"rig: camera names must be unique, not {names}")
    return [_camera(camera, rig) for camera in asked]


def _camera(asked: RigCamera, rig: CameraRig) -> Camera:
    if asked.hfov_deg is None:
        if asked.name not in rig.names:
            known = ", ".join(rig.names) or "none"
            raise DatasetError(
                f"rig: camera {asked.name!r}; the scene has {known}; give hfov_deg, width and "
                "height for one of your own"
            )
        camera = rig[asked.name]
        return camera if asked.width is None else camera.resized(asked.width)
    if asked.width is None or asked.height is None:
        raise DatasetError(f"rig: camera {asked.name!r} with hfov_deg needs width and height")
    focal = asked.width / (2 * math.tan(math.radians(asked.hfov_deg) / 2))
    K = np.array([[focal, 0, asked.width / 2], [0, focal, asked.height / 2], [0, 0, 1.0]])
    pose = transform_from(asked.position, (1.0, 0.0, 0.0, 0.0))
    pose[:3, :3] = _turn(asked) @ T_VEHICLE_OPTICAL[:3, :3]
    try:
        return Camera(asked.name, asked.width, asked.height, K, pose)
    except SceneError as error:
        raise DatasetError(f"rig: {error}") from error


def _turn(asked: RigCamera) -> Any:
    """Yaw to the left, then pitch upwards, then roll to the right, about the camera's axes."""
    yaw, pitch, roll = (math.radians(a) for a in (asked.yaw_deg, asked.pitch_deg, asked.roll_deg))
    about_z = [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    about_y = [
        [math.cos(pitch), 0, -math.sin(pitch)],
        [0, 1, 0],
        [math.sin(pitch), 0, math.cos(pitch)],
    ]
    about_x = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    return np.array(about_z) @ np.array(about_y) @ np.array(about_x)


# --- Variants ------------------------------------------------------------------------------------

# The same drive several times, with different values in its edits.

MAX_VARIANTS = 1000
_OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])


@dataclass(frozen=True, eq=False)
class Variant:
    """One drive of a sweep.

    Attributes:
        drive: drive to export.
        values: parameter values; empty without a sweep.
    """

    drive: Drive
    values: Mapping[str, Any] = field(default_factory=dict)


def swept(scene: Scene, state: ScenarioState, sweep: DatasetSweep, seed: int) -> list[Variant]:
    """The variants of a scenario: all combinations of lists and ranges, each with ``draws`` samples
    of the distributions.

    Args:
        scene: scene of the scenario.
        state: before the edits of the sweep.
        sweep: parameters, and edits in which ``"$name"`` is replaced by a value.
        seed: seed of the samples.

    Raises:
        DatasetError: more than MAX_VARIANTS, an edit without a parameter, parameters without an
            edit, or values with invalid or impossible edits; the message names them.
    """
    _check_names(sweep)
    variants = []
    for values in _combinations(sweep, seed):
        try:
            edits = _OPERATIONS.validate_python(_filled(sweep.operations, values))
            edited = apply_operations(state, edits).state
        except ValidationError as error:
            raise DatasetError(f"sweep: {dict(values)} make no edits ({error})") from error
        except EditError as error:
            raise DatasetError(f"sweep: {dict(values)}: {error}") from error
        variants.append(Variant(ScenarioDrive(scene, edited), values))
    return variants


def _check_names(sweep: DatasetSweep) -> None:
    named = set(_names(sweep.operations))
    given = set(sweep.parameters)
    if named - given:
        known = ", ".join(sweep.parameters)
        raise DatasetError(
            f"sweep: an edit has ${min(named - given)}; there are the parameters {known}"
        )
    if given - named:
        raise DatasetError(f"sweep: no edit has ${min(given - named)}")


def _names(value: Any) -> list[str]:
    if isinstance(value, str) and value.startswith("$"):
        return [value[1:]]
    if isinstance(value, Mapping):
        return [name for part in value.values() for name in _names(part)]
    return [name for part in value for name in _names(part)] if isinstance(value, list) else []


def _filled(value: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(value, str) and value.startswith("$"):
        return values[value[1:]]
    if isinstance(value, Mapping):
        return {key: _filled(part, values) for key, part in value.items()}
    return [_filled(part, values) for part in value] if isinstance(value, list) else value


def _combinations(sweep: DatasetSweep, seed: int) -> list[dict[str, Any]]:
    grid = {name: _grid(p) for name, p in sweep.parameters.items() if not p.is_drawn}
    drawn = {name: p for name, p in sweep.parameters.items() if p.is_drawn}
    draws = sweep.draws if drawn else 1
    count = int(np.prod([len(values) for values in grid.values()], initial=1)) * draws
    if count > MAX_VARIANTS:
        raise DatasetError(f"the sweep has {count} variants; {MAX_VARIANTS} is the most")
    rng = np.random.default_rng([seed, len(drawn)])
    return [
        dict(zip(grid, point, strict=True)) | {name: _draw(p, rng) for name, p in drawn.items()}
        for point in itertools.product(*grid.values())
        for _ in range(draws)
    ]


def _grid(values: SweptValues) -> Sequence[Any]:
    if values.values is not None:
        return values.values
    assert values.range is not None
    first, last, count = values.range
    return [float(value) for value in np.linspace(first, last, count)]


def _draw(values: SweptValues, rng: np.random.Generator) -> float:
    if values.uniform is not None:
        return float(rng.uniform(*values.uniform))
    assert values.normal is not None
    return float(rng.normal(*values.normal))


MAX_FRAMES = 100_000


@dataclass(frozen=True)
class ExportPlan:
    """Options of an export.

    Attributes:
        formats: names of writers, see :func:`~.writers.writer_names`.
        cameras: names; empty for all.
        width: image width [px]; None for the cameras' widths.
        period_us: between frames [us].
        start_us, end_us: first and last time [us]; None for those of the drive.
        clip_s: length of a clip [s], the unit of writing, resuming and splitting.
        splits: share of the clips by name.
        seed: assigns clips to splits.
        flow: whether to compute optical flow.
        lidar: name in the catalogue, or the values of a sensor file; None: points come from the
            cameras' depth.
        rig: values of a rig file, instead of ``cameras``, ``width`` and ``lidar``.
        perturb: distribution of the starts of clips; None: on the path.
        noise: error model of a detector, whose boxes are written in addition; None for none.
    """

    formats: tuple[str, ...]
    cameras: tuple[str, ...] = ()
    width: int | None = None
    period_us: int = 100_000
    start_us: int | None = None
    end_us: int | None = None
    clip_s: float = 20.0
    splits: Mapping[str, float] = field(default_factory=lambda: {"train": 1.0})
    seed: int = 0
    flow: bool = True
    lidar: str | Mapping[str, Any] | None = None
    rig: Mapping[str, Any] | None = None
    perturb: Perturbation | None = None
    noise: BoxNoise | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of all options."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class PlannedClip:
    """A section of the drive.

    Attributes:
        name: four digits.
        split: name of its split.
        times_us: times of its frames [us].
        variant: index of its drive in the sweep.
        copy: index of its perturbed start; None if it starts on the path.
    """

    name: str
    split: str
    times_us: tuple[int, ...]
    variant: int = 0
    copy: int | None = None


def planned_cameras(drive: Drive, plan: ExportPlan) -> list[Camera]:
    """The cameras of a plan. Raises DatasetError for a name that the scene lacks."""
    rig = drive.scene.rig
    if plan.rig is not None:
        return cameras_of(plan.rig, rig)
    for name in plan.cameras:
        if name not in rig.names:
            raise DatasetError(f"camera {name!r}; the scene has {', '.join(rig.names) or 'none'}")
    chosen = [rig[name] for name in plan.cameras] or list(rig)
    if not chosen:
        raise DatasetError("the scene has no camera to export")
    return [c if plan.width is None else c.resized(plan.width) for c in chosen]


def planned_lidar(plan: ExportPlan) -> Lidar | None:
    """The LiDAR of a plan, on the roof unless the values contain a pose.

    Raises:
        DatasetError: an unknown name, or invalid values.
    """
    named = plan.lidar if plan.rig is None else plan.rig.get("lidar")
    if named is None:
        return None
    try:
        lidar = catalogue_lidar(named) if isinstance(named, str) else lidar_from_values(named)
    except LidarError as error:
        raise DatasetError(str(error)) from error
    placed = not np.array_equal(lidar.T_vehicle_lidar, np.eye(4))
    return lidar if placed else lidar.placed(transform_from(ROOF, (1.0, 0.0, 0.0, 0.0)))


def planned_shards(variants: Sequence[Variant], plan: ExportPlan) -> list[PlannedClip]:
    """The clips of all drives, once per perturbation, with consecutive numbers.

    All clips of one time section are in the same split, which prevents training on test data.

    Raises:
        DatasetError: as :func:`planned_clips`, or too many frames in total.
    """
    copies = (None,) if plan.perturb is None else tuple(range(plan.perturb.copies))
    found = [
        replace(clip, variant=number, copy=copy)
        for number, variant in enumerate(variants)
        for clip in planned_clips(variant.drive, plan)
        for copy in copies
    ]
    frames = sum(len(clip.times_us) for clip in found)
    if frames > MAX_FRAMES:
        raise DatasetError(f"{frames} frames; {MAX_FRAMES} is the most in one export")
    return [replace(clip, name=f"{k:04d}") for k, clip in enumerate(found)]


def planned_clips(drive: Drive, plan: ExportPlan) -> list[PlannedClip]:
    """All clips in order.

    Raises:
        DatasetError: times outside the drive, a period or length without a frame, too many
            frames, or invalid shares.
    """
    first, last = drive.span
    start = first if plan.start_us is None else plan.start_us
    end = last if plan.end_us is None else plan.end_us
    if not first <= start <= end <= last:
        raise DatasetError(f"the export would show {start} to {end} us; there is {first} to {last}")
    if plan.period_us < 1 or not plan.clip_s > 0:
        raise DatasetError("the period and the length of a clip must be positive")
    times = list(range(start, end + 1, plan.period_us))
    if len(times) > MAX_FRAMES:
        raise DatasetError(f"{len(times)} frames; {MAX_FRAMES} is the most in one export")
    length = max(1, round(plan.clip_s * 1e6 / plan.period_us))
    parts = [tuple(times[k : k + length]) for k in range(0, len(times), length)]
    splits = _splits(len(parts), plan)
    return [PlannedClip(f"{k:04d}", splits[k], part) for k, part in enumerate(parts)]


def _splits(count: int, plan: ExportPlan) -> list[str]:
    shares = np.array(list(plan.splits.values()), dtype=np.float64)
    if not len(shares) or not np.isfinite(shares).all() or (shares < 0).any() or not shares.sum():
        raise DatasetError(f"splits {dict(plan.splits)}; give a share above 0 for each name")
    for name in plan.splits:
        if not name.replace("_", "").isalnum():
            raise DatasetError(f"split {name!r}; a name has letters, digits and _ only")
    ends = np.rint(np.cumsum(shares) / shares.sum() * count).astype(int)
    order = np.random.default_rng(plan.seed).permutation(count)
    names = [""] * count
    for place, clip in enumerate(order.tolist()):
        names[clip] = list(plan.splits)[int(np.searchsorted(ends, place, side="right"))]
    return names
