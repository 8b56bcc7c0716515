"""What is exported of a drive: cameras, instants, clips and splits."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ..geometry.transform import transform_from
from ..scene import Camera, Lidar, LidarError
from ..scene.lidar_catalogue import catalogue_lidar, lidar_from_values
from .drive import Drive
from .errors import DatasetError
from .labels.noise import BoxNoise
from .labels.points import ROOF
from .perturbed import Perturbation
from .rig import cameras_of
from .variants import Variant

MAX_FRAMES = 100_000


@dataclass(frozen=True)
class ExportPlan:
    """Options of an export.

    Attributes:
        formats: names of writers, see :func:`~.writers.writer_names`.
        cameras: names; empty for all.
        width: of images [px]; None for the cameras' own.
        period_us: between frames [us].
        start_us, end_us: first and last instant [us]; None for those of the drive.
        clip_s: length of a clip [s]: a whole that is written, resumed and split as one.
        splits: share of the clips by name.
        seed: draws which clip is in which split.
        flow: whether optical flow is made.
        lidar: name in the catalogue, or the values of a file of a sensor; None: points are those
            that the cameras' depth gives.
        rig: values of a rig file, instead of ``cameras``, ``width`` and ``lidar``.
        perturb: where the ego of each clip starts; None: on its path.
        noise: of a detector, whose boxes are written beside the true ones; None: none are.
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
    """A stretch of the drive.

    Attributes:
        name: four digits.
        split: that it belongs to.
        times_us: of its frames [us].
        variant: number of its drive in the sweep.
        copy: number of its start beside the path; None where it starts on it.
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
    """The LiDAR of a plan, on the roof where it is not placed itself.

    Raises:
        DatasetError: an unknown name, or values that are no sensor's.
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
    """The clips of all drives, each as often as it is perturbed, numbered through. All of a stretch
    of time are in one split, so that nothing is trained on that is tested on.

    Raises:
        DatasetError: as :func:`planned_clips`, or too many frames in all.
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
    """All clips in their order.

    Raises:
        DatasetError: for instants outside of the drive, a period or a length that give no frame,
            too many frames, or shares that are none.
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
