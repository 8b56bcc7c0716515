"""The type that every log reader returns, and parts of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float
from ..scene import CameraRig, LaneGraph, Trajectory
from ..scene.errors import FileError

NAMED = 5
"""Maximum number of records of a kind to name in a summary."""


def left_out_lines(left_out: Mapping[str, Sequence[str]]) -> list[str]:
    """What a log leaves out: for each kind a line with the number, then the first five."""
    lines = []
    for kind, sentences in left_out.items():
        lines.append(f"{kind}: {len(sentences)}")
        lines += [f"  {sentence}" for sentence in sentences[:NAMED]]
        if len(sentences) > NAMED:
            lines.append(f"  and {len(sentences) - NAMED} more")
    return lines


class LogError(FileError):
    """A log that cannot be read; the message names the file, the problem and the expectation."""


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """One sweep of all LiDARs, compensated to one time.

    Attributes:
        points: [N, 3] float32, vehicle frame at the frame's time stamp [m]; the motion of the
            recording vehicle during the sweep is compensated.
        intensity: [N] float32 in [0, 1].
        offset_us: [N] int32, time of measurement relative to the frame's time stamp [us]; a moving
            object has moved by its own velocity times this.
        origin: [3] float32, sensor position in the vehicle frame [m].
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    offset_us: NDArray[np.int32]
    origin: NDArray[np.float32]


NO_SWEEP = LidarSweep(
    points=np.zeros((0, 3), np.float32),
    intensity=np.zeros(0, np.float32),
    offset_us=np.zeros(0, np.int32),
    origin=np.zeros(3, np.float32),
)


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """A tracked box.

    Attributes:
        object_id: unique in the log, ``<category>_<id>`` such as ``car_3``.
        category: ``car``, ``truck``, ``van``, ``bus``, ``pedestrian``, ``cyclist``, ``other`` ...
        size: (length, width, height) along the object's x, y, z [m].
        trajectory: ``T_world_object``, origin at the box centre, x forward, z up.
    """

    object_id: str
    category: str
    size: tuple[float, float, float]
    trajectory: Trajectory

    def transform_near(self, t_us: int, *, reach_us: int = 60_000) -> Float | None:
        """``T_world_object`` [4, 4] at ``t_us``, or None if the object is not present.

        Boxes refer to the time stamps of frames, but images are taken around them. Up to
        ``reach_us`` before its first and after its last box, the object keeps that pose.
        """
        path = self.trajectory
        if not path.start_us - reach_us <= t_us <= path.end_us + reach_us:
            return None
        return path.transform(min(max(t_us, path.start_us), path.end_us))


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Convert any error of the block to a LogError of a damaged log, unless it already is one.

    Raises:
        LogError: with ``where`` and the error.
    """
    try:
        yield
    except LogError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        raise LogError(f"{where}: is damaged, or not as its layout asks ({reason})") from error


class FrameSource(Protocol):
    """Reads images and sweeps of a log, one file at a time."""

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB [H, W, 3] of a camera at a frame. Raises LogError naming a file it cannot read."""
        ...

    def lidar(self, frame: int) -> LidarSweep:
        """The sweep of a frame. Raises LogError naming a file it cannot read."""
        ...


@runtime_checkable
class ChecksFiles(Protocol):
    """A source that checks files by their headers, without reading all of their contents."""

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is missing, truncated or of another size."""
        ...

    def check_sweep(self, frame: int) -> int | None:
        """Number of points according to the sweep's header; None if it has none.

        Raises LogError if the sweep is missing, truncated or lacks arrays of the right shape.
        """
        ...


@dataclass(frozen=True, eq=False)
class LoggedMap:
    """A separate map that belongs to a log.

    Attributes:
        path: the file or folder, for ``maps.read_map``.
        T_world_map: [4, 4] from the map's frame to the log's world [m].
    """

    path: Path
    T_world_map: Float


@dataclass(frozen=True, eq=False)
class DrivingLog:
    """A recorded drive; images and sweeps are read on demand.

    World frame: x forward, y left, z up [m]. It is the vehicle frame of the first frame unless the
    dataset defines another, so that coordinates stay small.

    Attributes:
        name: short name, from the folder.
        rig: calibrated cameras; images are already undistorted.
        frame_times_us: [F] int64 [us], increasing.
        ego: ``T_world_vehicle`` (rear axle centre on the ground); covers at least all frames.
        tracks: every tracked object, in a stable order.
        source: reads images and sweeps.
        ego_size: (length, width, height) of the recording vehicle [m].
        provenance: dataset, sequence, licence, reader (JSON values only).
        image_times_us: [F] int64 [us] by camera, actual times of its images if they differ from the
            frame's time stamp; see :meth:`image_time_us`.
        absent_images: (camera, frame) without a usable image.
        absent_sweeps: frames without a usable sweep.
        left_out: by kind (``images``, ``sweeps``, ``frames``, ``boxes``, ...), a sentence for each
            record of the files that the log does not use.
        lanes: lanes of the log's map, in its world frame; None without a map.
        logged_map: location of a map that has not been read; None without one.
    """

    name: str
    rig: CameraRig
    frame_times_us: NDArray[np.int64]
    ego: Trajectory
    tracks: tuple[ObjectTrack, ...]
    source: FrameSource
    ego_size: tuple[float, float, float] = (4.6, 1.85, 1.6)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    image_times_us: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    absent_images: frozenset[tuple[str, int]] = frozenset()
    absent_sweeps: frozenset[int] = frozenset()
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    lanes: LaneGraph | None = field(default=None, repr=False)
    logged_map: LoggedMap | None = field(default=None, repr=False)

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.frame_times_us)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB uint8 [H, W, 3] of ``camera`` at ``frame``, the camera's size.

        Raises:
            LogError: the image is absent (see :meth:`has_image`), broken or of another size.
        """
        expected = self.rig[camera]
        checked = self._checked(frame)
        if not self.has_image(camera, frame):
            raise LogError(
                f"log {self.name!r}: camera {camera!r} has no usable image at frame {frame}; "
                "left_out tells why, has_image() tells which are there"
            )
        with damage_named(f"log {self.name!r}: image of camera {camera!r} at frame {frame}"):
            image = self.source.image(camera, checked)
        if image.shape != (expected.height, expected.width, 3):
            raise LogError(
                f"log {self.name!r}: image of camera {camera!r} at frame {frame} is {image.shape}, "
                f"its calibration says ({expected.height}, {expected.width}, 3)"
            )
        return image

    def has_image(self, camera: str, frame: int) -> bool:
        """Whether ``camera`` has a usable image at ``frame``."""
        return (camera, frame) not in self.absent_images

    def seen_frames(self) -> list[int]:
        """Frames with a usable image of at least one camera."""
        names = self.rig.names
        return [f for f in range(self.frame_count) if any(self.has_image(n, f) for n in names)]

    def image_time_us(self, camera: str, frame: int) -> int:
        """Time of the image of ``camera`` in ``frame`` [us], covered by ``ego``.

        Cameras of one vehicle are often triggered in sequence while the LiDAR turns: at 10 m/s, the
        first and the last image of a frame are half a metre apart.
        """
        times = self.image_times_us.get(camera, self.frame_times_us)
        return int(times[self._checked(frame)])

    def lidar(self, frame: int) -> LidarSweep:
        """The LiDAR sweep of ``frame``; without points if it is absent.

        Raises:
            LogError: the sweep is broken.
        """
        checked = self._checked(frame)
        if frame in self.absent_sweeps:
            return NO_SWEEP
        with damage_named(f"log {self.name!r}: sweep of frame {frame}"):
            return self.source.lidar(checked)

    def _checked(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            raise LogError(f"log {self.name!r} has frames 0 to {self.frame_count - 1}, not {frame}")
        return frame


# --- Selection -----------------------------------------------------------------------------------

# A range of frames, every n-th frame, some cameras.

SELECTION = "selection"
"""Key of a log's provenance: the selected part, see :func:`select_from_log`."""


@dataclass(frozen=True)
class LogSelection:
    """Selected part of a log.

    Attributes:
        first: index of the first frame.
        stop: index after the last frame; None for the log's end.
        every: use every Nth of these frames.
        cameras: camera names; None for all.
    """

    first: int = 0
    stop: int | None = None
    every: int = 1
    cameras: tuple[str, ...] | None = None

    @property
    def is_whole(self) -> bool:
        """Whether it selects the complete log."""
        return self == LogSelection()


def select_from_log(log: DrivingLog, selection: LogSelection) -> DrivingLog:
    """Select a part of ``log``; its world frame does not change.

    The path and the boxes cover the time from its first image to its last; objects that do not
    exist then are dropped. ``provenance`` records the selection, so that the same part can be
    selected from the same log again, see :func:`same_part`.

    Raises:
        LogError: frames or cameras that the log lacks, or no frame at all.
    """
    frames = _frames(log, selection)
    rig = _cameras(log, selection.cameras)
    part = log_of_frames(log, frames)
    absent = frozenset((name, frame) for name, frame in part.absent_images if name in rig.names)
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
        absent_images=absent,
        provenance={
            **log.provenance,
            SELECTION: _told(log, frames, selection.cameras),
        },
    )


def same_part(log: DrivingLog, provenance: Mapping[str, Any]) -> DrivingLog:
    """Select the part of ``log`` with this ``provenance``, for example of a scene made from it.

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
    """``log`` with only these frames. Paths and boxes stay complete."""
    index = np.asarray(frames, np.int64)
    selected = _SelectedFiles if isinstance(log.source, ChecksFiles) else _SelectedFrames
    new = list(enumerate(frames))
    return replace(
        log,
        absent_images=frozenset(
            (name, i) for i, f in new for name in log.rig.names if not log.has_image(name, f)
        ),
        absent_sweeps=frozenset(i for i, f in new if f in log.absent_sweeps),
        frame_times_us=log.frame_times_us[index],
        source=selected(log, frames),
        image_times_us={name: taken[index] for name, taken in log.image_times_us.items()},
    )


class _SelectedFrames:
    """A source with the indices of the selected frames; errors name those of the whole log."""

    def __init__(self, log: DrivingLog, frames: Sequence[int]) -> None:
        self._log, self._frames = log, frames

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self._log.image(camera, self._frames[frame])

    def lidar(self, frame: int) -> LidarSweep:
        return self._log.lidar(self._frames[frame])


class _SelectedFiles(_SelectedFrames):
    """``_SelectedFrames`` for a source that checks its files."""

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
            f"frames {asked} are not part of log {log.name!r}, which has frames 0:{count}; a part "
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
    """The selection in frame indices of the whole log, even for a part of a part."""
    before = log.provenance.get(SELECTION)
    if isinstance(before, dict):
        frames = range(*before["frames"])[frames.start : frames.stop : frames.step]
        cameras = before["cameras"] if cameras is None else cameras
    return {
        "frames": [frames.start, frames.stop, frames.step],
        "cameras": None if cameras is None else list(cameras),
    }
