"""The one type every log reader yields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import Float
from ..scene import CameraRig, LaneGraph, Trajectory


class LogError(ValueError):
    """A log that cannot be read; the message names the file, what is wrong and what is expected."""


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """One sweep of all LiDARs, brought to one instant.

    Attributes:
        points: [N, 3] float32, vehicle frame at the frame's time stamp [m]; the motion of the
            recording vehicle during the sweep is compensated.
        intensity: [N] float32 in [0, 1].
        offset_us: [N] int32, when each point was measured relative to the frame's time stamp
            [us]; a moving object has moved by its own velocity times this.
        origin: [3] float32, sensor position in the vehicle frame [m].
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    offset_us: NDArray[np.int32]
    origin: NDArray[np.float32]


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
        """``T_world_object`` [4, 4] at ``t_us``, or None when the object is not there.

        Boxes hold for the frames' time stamps, but images are taken around them: up to
        ``reach_us`` before its first and after its last box the object stays where it is there.
        """
        path = self.trajectory
        if not path.start_us - reach_us <= t_us <= path.end_us + reach_us:
            return None
        return path.transform(min(max(t_us, path.start_us), path.end_us))


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Any error of the block as one of a damaged log, as far as a reader did not say it better.

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
    """Reads the heavy parts of a log, one file at a time."""

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB [H, W, 3] of a camera at a frame. Raises LogError naming a file it cannot read."""
        ...

    def lidar(self, frame: int) -> LidarSweep:
        """The sweep of a frame. Raises LogError naming a file it cannot read."""
        ...


@runtime_checkable
class ChecksFiles(Protocol):
    """A source that checks its files by their headers, without reading all of their contents."""

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError when the image is missing, cut off or of another size."""
        ...

    def check_sweep(self, frame: int) -> int | None:
        """How many points the sweep promises, None where its header does not say.

        Raises LogError when the sweep is missing, cut off or lacks arrays of the right shape.
        """
        ...


@dataclass(frozen=True, eq=False)
class LoggedMap:
    """A map of its own format that lies beside a log.

    Attributes:
        path: the file or folder, as ``maps.read_map`` takes it.
        T_world_map: [4, 4] from the map's frame to the log's world [m].
    """

    path: Path
    T_world_map: Float


@dataclass(frozen=True, eq=False)
class DrivingLog:
    """A recorded drive; images and sweeps are read when they are asked for.

    World frame: x forward, y left, z up [m]; it is the vehicle frame of the first frame unless
    the dataset says otherwise, so that coordinates stay small.

    Attributes:
        name: short name, from the folder.
        rig: calibrated cameras, distortion already removed from the images.
        frame_times_us: [F] int64 [us], increasing.
        ego: ``T_world_vehicle`` at least over all frames (rear axle centre on the ground).
        tracks: every tracked object, in a stable order.
        source: where images and sweeps come from.
        ego_size: (length, width, height) of the recording vehicle [m].
        provenance: dataset, sequence, licence, reader (JSON values only).
        image_times_us: [F] int64 [us] by camera, when its images were really taken, where that
            differs from the frame's time stamp; see :meth:`image_time_us`.
        lanes: of the map that the log comes with, in its world frame; None without one.
        logged_map: where such a map is that has not been read; None without one.
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
    lanes: LaneGraph | None = field(default=None, repr=False)
    logged_map: LoggedMap | None = field(default=None, repr=False)

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.frame_times_us)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB uint8 [H, W, 3] of ``camera`` at ``frame``, the camera's size.

        Raises:
            LogError: the image is missing, broken or of another size.
        """
        if camera in self.provenance.get("cameras_without_images", ()):
            raise LogError(f"log {self.name!r}: camera {camera!r} has no images")
        expected = self.rig[camera]
        checked = self._checked(frame)
        with damage_named(f"log {self.name!r}: image of camera {camera!r} at frame {frame}"):
            image = self.source.image(camera, checked)
        if image.shape != (expected.height, expected.width, 3):
            raise LogError(
                f"log {self.name!r}: image of camera {camera!r} at frame {frame} is {image.shape}, "
                f"its calibration says ({expected.height}, {expected.width}, 3)"
            )
        return image

    def image_time_us(self, camera: str, frame: int) -> int:
        """When ``camera`` took its image of ``frame`` [us]; ``ego`` covers that instant.

        Cameras of one vehicle are often triggered one after the other while the LiDAR turns: at
        10 m/s half a metre lies between the first and the last image of a frame.
        """
        times = self.image_times_us.get(camera, self.frame_times_us)
        return int(times[self._checked(frame)])

    def lidar(self, frame: int) -> LidarSweep:
        """The LiDAR sweep of ``frame``; it may be empty.

        Raises:
            LogError: the sweep is missing or broken.
        """
        checked = self._checked(frame)
        with damage_named(f"log {self.name!r}: sweep of frame {frame}"):
            return self.source.lidar(checked)

    def _checked(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            raise LogError(f"log {self.name!r} has frames 0 to {self.frame_count - 1}, not {frame}")
        return frame
