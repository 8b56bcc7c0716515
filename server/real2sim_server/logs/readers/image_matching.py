"""Gives every frame one image per camera, where cameras run by their own clocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..driving_log import LogError


@dataclass(frozen=True, eq=False)
class TimedImages:
    """Images of one camera: files and their time stamps [I] [us], increasing."""

    files: Sequence[Path]
    times_us: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MatchedImages:
    """Images by frame.

    Attributes:
        frames: [F] which of the given frames have an image of every camera: a run without gaps.
        files: F files by camera.
        times_us: [F] time stamps by camera.
    """

    frames: NDArray[np.intp]
    files: dict[str, list[Path]]
    times_us: dict[str, NDArray[np.int64]]


def match_images(
    frame_times_us: NDArray[np.int64],
    cameras: Mapping[str, TimedImages],
    *,
    tolerance_us: int,
    where: Path,
) -> MatchedImages:
    """The nearest image of every camera for every frame.

    Frames at both ends, for which some camera has none, are dropped: sensors start and stop at
    different moments.

    Args:
        frame_times_us: [F] increasing.
        cameras: at least one image each.
        tolerance_us: how far an image may be from its frame.
        where: the log, for errors.

    Raises:
        LogError: a camera lacks an image in the middle of the log, or no frame has all images.
    """
    nearest = {name: _nearest(frame_times_us, c.times_us) for name, c in cameras.items()}
    found = {
        name: np.abs(cameras[name].times_us[index] - frame_times_us) <= tolerance_us
        for name, index in nearest.items()
    }
    whole = np.ones(len(frame_times_us), dtype=bool)
    for mask in found.values():
        whole &= mask
    if not whole.any():
        raise LogError(
            f"{where}: no frame has an image of all cameras {sorted(cameras)} within "
            f"{tolerance_us} us"
        )
    first, last = np.flatnonzero(whole)[[0, -1]]
    for name, mask in found.items():
        missing = np.flatnonzero(~mask[first : last + 1]) + first
        if len(missing):
            raise LogError(
                f"{where}: camera {name!r} has no image within {tolerance_us} us of the frame at "
                f"{frame_times_us[missing[0]]} us ({len(missing)} frames lack one)"
            )
    frames = np.arange(first, last + 1)
    return MatchedImages(
        frames,
        {n: [c.files[i] for i in nearest[n][frames]] for n, c in cameras.items()},
        {n: c.times_us[nearest[n][frames]] for n, c in cameras.items()},
    )


def _nearest(wanted: NDArray[np.int64], given: NDArray[np.int64]) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(given, wanted), 1, max(len(given) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(given) - 1)
    closer = np.abs(given[before] - wanted) <= np.abs(given[after] - wanted)
    return np.asarray(np.where(closer, before, after))
