"""A part of a log: a stretch of it, every n-th frame, some cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import CameraRig
from .driving_log import ChecksFiles, DrivingLog, LidarSweep, LogError, ObjectTrack

SELECTION = "selection"
"""Of a log's provenance: what it is a part of, see :func:`select_from_log`."""


@dataclass(frozen=True)
class LogSelection:
    """Which part of a log is meant.

    Attributes:
        first: number of the first frame.
        stop: number of the first frame that is no longer part of it; None for the log's end.
        every: of these frames, each so many-th.
        cameras: names; None for all.
    """

    first: int = 0
    stop: int | None = None
    every: int = 1
    cameras: tuple[str, ...] | None = None

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left out of any log."""
        return self == LogSelection()


def select_from_log(log: DrivingLog, selection: LogSelection) -> DrivingLog:
    """The part of ``log`` that is selected; its world frame stays.

    The path and the boxes are those from its first image to its last; objects that are not there
    meanwhile are left out. ``provenance`` says what was selected, so that the same part can be
    taken from the same log again, see :func:`same_part`.

    Raises:
        LogError: frames or cameras that the log lacks, or no frame at all.
    """
    frames = _frames(log, selection)
    rig = _cameras(log, selection.cameras)
    part = log_of_frames(log, frames)
    image_times_us = {k: taken for k, taken in part.image_times_us.items() if k in rig.names}
    instants = np.concatenate([part.frame_times_us, *image_times_us.values()])
    start_us, end_us = int(instants.min()), int(instants.max())
    return replace(
        part,
        rig=rig,
        ego=log.ego.between(start_us, end_us),
        tracks=tuple(
            replace(track, trajectory=track.trajectory.between(start_us, end_us))
            for track in log.tracks
            if _is_there(track, start_us, end_us)
        ),
        image_times_us=image_times_us,
        provenance={
            **log.provenance,
            SELECTION: _told(log, frames, selection.cameras),
        },
    )


def same_part(log: DrivingLog, provenance: Mapping[str, Any]) -> DrivingLog:
    """The part of ``log`` that a log with this ``provenance`` was, or what was made of it.

    Raises:
        LogError: the log has no such frames or cameras.
    """
    part = provenance.get(SELECTION)
    if not isinstance(part, dict) or SELECTION in log.provenance:
        return log
    first, stop, every = (int(number) for number in part["frames"])
    cameras = part.get("cameras")
    return select_from_log(
        log, LogSelection(first, stop, every, tuple(cameras) if cameras is not None else None)
    )


def log_of_frames(log: DrivingLog, frames: Sequence[int]) -> DrivingLog:
    """``log`` with these frames alone; paths and boxes stay whole."""
    index = np.asarray(frames, np.int64)
    selected = _SelectedFiles if isinstance(log.source, ChecksFiles) else _SelectedFrames
    return replace(
        log,
        frame_times_us=log.frame_times_us[index],
        source=selected(log, frames),
        image_times_us={name: taken[index] for name, taken in log.image_times_us.items()},
    )


class _SelectedFrames:
    """A source under the numbers of the selected frames; errors name those of the whole log."""

    def __init__(self, log: DrivingLog, frames: Sequence[int]) -> None:
        self._log, self._frames = log, frames

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self._log.image(camera, self._frames[frame])

    def lidar(self, frame: int) -> LidarSweep:
        return self._log.lidar(self._frames[frame])


class _SelectedFiles(_SelectedFrames):
    """The same of a source that checks its files."""

    def check_image(self, camera: str, frame: int) -> None:
        self._files.check_image(camera, self._frames[frame])

    def check_sweep(self, frame: int) -> int | None:
        return self._files.check_sweep(self._frames[frame])

    @property
    def _files(self) -> ChecksFiles:
        assert isinstance(self._log.source, ChecksFiles)
        return self._log.source


def _frames(log: DrivingLog, selection: LogSelection) -> range:
    count, first, stop = log.frame_count, selection.first, selection.stop
    if selection.every < 1:
        raise LogError(f"every {selection.every}-th frame cannot be taken; every is at least 1")
    if not 0 <= first < count or (stop is not None and not first < stop <= count):
        asked = f"{first}:{'' if stop is None else stop}"
        raise LogError(
            f"frames {asked} are no part of log {log.name!r}, which has frames 0:{count}; a part "
            "is first:stop, from the first frame to the one before stop"
        )
    return range(first, count if stop is None else stop, selection.every)


def _cameras(log: DrivingLog, names: tuple[str, ...] | None) -> CameraRig:
    if names is None:
        return log.rig
    unknown = [name for name in names if name not in log.rig.names]
    if unknown or not names:
        raise LogError(f"log {log.name!r} has cameras {list(log.rig.names)}, not {list(names)}")
    return CameraRig(tuple(camera for camera in log.rig if camera.name in names))


def _is_there(track: ObjectTrack, start_us: int, end_us: int) -> bool:
    path = track.trajectory
    return path.start_us <= end_us and start_us <= path.end_us


def _told(log: DrivingLog, frames: range, cameras: tuple[str, ...] | None) -> dict[str, Any]:
    """Numbers of the whole log, also where a part of a part is taken."""
    before = log.provenance.get(SELECTION)
    if isinstance(before, dict):
        frames = range(*before["frames"])[frames.start : frames.stop : frames.step]
        cameras = before["cameras"] if cameras is None else cameras
    return {
        "frames": [frames.start, frames.stop, frames.step],
        "cameras": None if cameras is None else list(cameras),
    }
