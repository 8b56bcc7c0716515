"""Options of stage 0, stages of a reconstruction, and the error of this package."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from ..maps import LANE_SOURCES, LaneSource

# Options and errors.


class ReconstructError(ValueError):
    """A log cannot be reconstructed. The message names the missing part or the allowed values."""


@dataclass(frozen=True)
class InitialiseOptions:
    """Options for building Gaussians from a log without training.

    Attributes:
        max_background, max_object: maximum number of Gaussians in the background and per object.
        voxel: edge of the smallest thinning voxels [m]. They double with the distance from the
            drive and stay at about ``voxel + voxel_per_metre * distance`` or below.
        voxel_per_metre: growth of voxels with the distance from the drive.
        object_voxel: edge of thinning voxels in objects [m].
        ground_spacing: distance of the Gaussians on the road near the drive [m].
        max_range: LiDAR points farther from the sensor are dropped [m].
        box_margin: distance outside its box at which a point belongs to an object [m] (mirrors).
        ground_clearance: height above the box bottom below which points are road, not object [m].
        max_colour_frames: maximum number of frames for colours, evenly spread.
        samples: number of best views to average for the colour of a Gaussian.
        sky_resolution: edge length of a face of the sky's cube map [px].
        feature_images: maximum number of images per camera for feature points in regions without
            LiDAR returns; 0 for none.
        stereo_images: maximum number of images per camera for plane-sweep depth in regions without
            LiDAR returns; 0 for none.
        lanes: ``map``: from the log's map; ``log``: without a map, collected from the drive;
            ``none``.

    Raises:
        ReconstructError: a value is out of range.
    """

    max_background: int = 600_000
    max_object: int = 60_000
    voxel: float = 0.05
    voxel_per_metre: float = 0.004
    object_voxel: float = 0.025
    ground_spacing: float = 0.06
    max_range: float = 120.0
    box_margin: float = 0.12
    ground_clearance: float = 0.12
    max_colour_frames: int = 60
    samples: int = 8
    sky_resolution: int = 512
    feature_images: int = 60
    stereo_images: int = 60
    lanes: LaneSource = "map"

    def __post_init__(self) -> None:
        may_be_zero = {
            "voxel_per_metre",
            "box_margin",
            "ground_clearance",
            "feature_images",
            "stereo_images",
        }
        if self.lanes not in LANE_SOURCES:
            raise ReconstructError(f"lanes must be one of {LANE_SOURCES}, not {self.lanes!r}")
        numbers = {name: value for name, value in asdict(self).items() if name != "lanes"}
        for name, value in numbers.items():
            if not (value > 0 or (value == 0 and name in may_be_zero)) or value == float("inf"):
                raise ReconstructError(f"{name}={value!r} of InitialiseOptions must be positive")


# Names, times and progress of stages.

OnProgress = Callable[[str, int, int], None]
"""Called with the name of a stage, its completed steps and its total steps."""
ReportStep = Callable[[int, int], None]


class Stages:
    """Times stages into ``timing_s`` and reports their progress.

    Args:
        on_progress: called at the start, during and at the end of a stage; may be None.
        timing_s: seconds by stage, written; may be None.
    """

    def __init__(self, on_progress: OnProgress | None, timing_s: dict[str, float] | None) -> None:
        self._on_progress = on_progress
        self._timing_s = timing_s if timing_s is not None else {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[ReportStep]:
        """Run a stage; yields a function that takes completed and total steps."""

        def report_step(done: int, total: int) -> None:
            if self._on_progress is not None:
                self._on_progress(name, done, total)

        start = time.perf_counter()
        report_step(0, 1)
        yield report_step
        self._timing_s[name] = time.perf_counter() - start
        report_step(1, 1)
