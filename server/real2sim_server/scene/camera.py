"""Cameras: optics, shutter, the rig that carries them, and their motion during an exposure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.sensors import ShutterDirection

from ..geometry import (
    Float,
    invert_transform,
    is_rigid,
    matrix_to_quaternion,
    quaternion_to_matrix,
    slerp,
)
from .errors import SceneError
from .lens import Lens

# Shutter.

DIRECTIONS = get_args(ShutterDirection)
MAX_READOUT_US = 200_000


@dataclass(frozen=True)
class Shutter:
    """The readout of an image.

    Attributes:
        direction: ``global``: all pixels at once; otherwise the rows or columns that are read
            first.
        readout_us: time from the first to the last row or column [us]; 0 if ``global``. The time
            of an image is the middle of its readout.

    Raises:
        SceneError: an unknown direction, or a readout outside 1 to 200,000 us.
    """

    direction: ShutterDirection = "global"
    readout_us: int = 0

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise SceneError(
                f"shutter: direction must be one of {list(DIRECTIONS)}, not {self.direction!r}"
            )
        rolls = self.direction != "global"
        if not (rolls <= self.readout_us <= MAX_READOUT_US * rolls):
            raise SceneError(
                f"shutter: readout_us must be 1 to {MAX_READOUT_US}, and 0 where global, "
                f"not {self.readout_us!r} with {self.direction!r}"
            )

    @property
    def rolls(self) -> bool:
        """Whether rows or columns are exposed in sequence."""
        return self.direction != "global"

    @property
    def by_row(self) -> bool:
        """True if the pixels of a row are exposed together, False if those of a column are."""
        return self.direction in {"top_to_bottom", "bottom_to_top"}

    def line_times(self, width: int, height: int) -> NDArray[np.float64]:
        """Exposure time of each row (or column), from 0 to 1 over the readout.

        As in NCore, the first is at 0 and the last at 1.
        """
        count = height if self.by_row else width
        times = np.arange(count) / max(count - 1, 1)
        return times if self.direction in {"top_to_bottom", "left_to_right"} else 1 - times

    def times_at(self, pixels: Float, width: int, height: int) -> Float:
        """Exposure times of positions [..., 2] [px]; positions outside the image get the time of
        its edge.
        """
        axis, count = (1, height) if self.by_row else (0, width)
        line = np.clip(np.floor(np.nan_to_num(pixels[..., axis])), 0, count - 1).astype(np.int64)
        return self.line_times(width, height)[line]


GLOBAL = Shutter()
"""All pixels at once."""


T_VEHICLE_OPTICAL = np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64
)
"""Rotation from an OpenCV camera frame that looks along vehicle x (x right, y down, z forward)."""


@dataclass(frozen=True, eq=False)
class Optics:
    """The optics before the images were undistorted, at the camera's image size.

    Attributes:
        K: [3, 3] float64 [px].
        lens, shutter: as in :class:`Camera`.
    """

    K: NDArray[np.float64]
    lens: Lens | None = None
    shutter: Shutter = GLOBAL


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera on the vehicle: a pinhole camera unless it has a lens.

    Attributes:
        name: unique on its rig.
        width, height: image size [px].
        K: [3, 3] float64, intrinsics [px]; pixel centres are at +0.5.
        T_vehicle_camera: [4, 4] float64; camera frame is OpenCV (x right, y down, z forward).
        lens: distortion; None for the pinhole.
        shutter: readout of the images.
        recorded: optics of the device, if the log contains undistorted images; None if unknown.

    Raises:
        SceneError: sizes below 1, a K without positive focal lengths, a pose that is not a rigid
            transform, or a lens that does not cover the image.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64]
    T_vehicle_camera: Float
    lens: Lens | None = None
    shutter: Shutter = GLOBAL
    recorded: Optics | None = None

    def __post_init__(self) -> None:
        k = np.array(self.K, dtype=np.float64)
        pose = np.array(self.T_vehicle_camera, dtype=np.float64)
        if self.width < 1 or self.height < 1:
            raise SceneError(
                f"camera {self.name!r}: size {self.width}x{self.height} is not positive"
            )
        if k.shape != (3, 3) or not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0:
            raise SceneError(
                f"camera {self.name!r}: K must be 3x3 with positive focal lengths, not {k.tolist()}"
            )
        if not is_rigid(pose):
            raise SceneError(f"camera {self.name!r}: T_vehicle_camera is not a rigid transform")
        object.__setattr__(self, "K", k)
        object.__setattr__(self, "T_vehicle_camera", pose)
        if self.lens is not None:
            self._check_lens(self.lens)
        if self.recorded is not None:
            self.as_recorded()

    def _check_lens(self, lens: Lens) -> None:
        """Perspective images cover all pixels, others at least the middle ones."""
        try:
            reach = lens.reach
        except SceneError as error:
            raise SceneError(f"camera {self.name!r}: {error}") from error
        column, row = np.linspace(0, self.width, 33), np.linspace(0, self.height, 33)
        edge = [np.stack([column, np.full(33, y)], -1) for y in (0, self.height)]
        edge += [np.stack([np.full(33, x), row], -1) for x in (0, self.width)]
        middle = np.array([[self.width / 2, self.height / 2]])
        seen = self.unproject(np.concatenate(edge) if lens.perspective else middle)[1]
        if not seen.all():
            raise SceneError(
                f"camera {self.name!r}: its {lens.model} lens is valid up to "
                f"{np.degrees(reach):.1f} degrees from its axis, but the image of "
                f"{self.width}x{self.height} reaches beyond; give a smaller image or a calibration "
                "that holds for all of it"
            )

    def as_recorded(self) -> Camera:
        """The physical camera, with its original distortion and shutter; this camera if these are
        unknown.
        """
        if self.recorded is None:
            return self
        optics = self.recorded
        return replace(self, K=optics.K, lens=optics.lens, shutter=optics.shutter, recorded=None)

    @property
    def is_pinhole(self) -> bool:
        """Whether it has neither lens nor rolling shutter."""
        return self.lens is None and not self.shutter.rolls

    @property
    def shows_ranges(self) -> bool:
        """Whether its depth images hold distances along rays rather than depths along z."""
        return self.lens is not None and not self.lens.perspective

    def project(self, points: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Image positions [..., 2] [px] of points [..., 3] in the camera frame, and a mask [...] of
        visible points. Positions can be outside the image; those of invisible points are arbitrary.
        """
        points = np.asarray(points, dtype=np.float64)
        if self.lens is not None:
            plane, valid = self.lens.distort(points)
        else:
            valid = points[..., 2] > 0
            plane = points[..., :2] / np.where(valid, points[..., 2], 1.0)[..., None]
        return plane @ self.K[:2, :2].T + self.K[:2, 2], valid

    def unproject(self, pixels: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Unit directions [..., 3] in the camera frame of image positions [..., 2] [px], and
        whether the lens sees any there."""
        plane = (np.asarray(pixels, dtype=np.float64) - self.K[:2, 2]) @ np.linalg.inv(
            self.K[:2, :2]
        ).T
        if self.lens is not None:
            return self.lens.undistort(plane)
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return rays, np.ones(plane.shape[:-1], bool)

    def resized(self, width: int) -> Camera:
        """The same camera at another image width [px]; the height follows the aspect ratio."""
        if width == self.width:
            return self
        height = max(1, round(self.height * width / self.width))
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        recorded = self.recorded
        if recorded is not None:
            recorded = replace(recorded, K=recorded.K * scale)
        return replace(self, width=width, height=height, K=self.K * scale, recorded=recorded)

    def viewmat(self, T_world_vehicle: Float) -> Float:
        """``T_camera_world`` [4, 4] for the vehicle pose ``T_world_vehicle``."""
        return invert_transform(self.pose(T_world_vehicle))

    def pose(self, T_world_vehicle: Float) -> Float:
        """``T_world_camera`` [4, 4] for the vehicle pose ``T_world_vehicle``."""
        return T_world_vehicle @ self.T_vehicle_camera


@dataclass(frozen=True, eq=False)
class CameraRig:
    """The cameras of a vehicle, by name and in order."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        names = [c.name for c in self.cameras]
        if len(set(names)) != len(names):
            raise SceneError(f"camera names must be unique, not {names}")

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in order."""
        return tuple(c.name for c in self.cameras)

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise SceneError(f"unknown camera {name!r}; this rig has {list(self.names)}")


# Motion of a camera during readout.


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Pose of a camera during the readout of an image.

    The position moves uniformly along a straight line, the rotation uniformly about one axis.

    Attributes:
        start, end: [4, 4] ``T_world_camera`` at the first and the last line.
    """

    start: Float
    end: Float

    @classmethod
    def still(cls, pose: Float) -> CameraMotion:
        """A camera at rest at ``pose`` [4, 4]."""
        return cls(pose, pose)

    @classmethod
    def about(cls, pose: Float, linear: Float, angular: Float, seconds: float) -> CameraMotion:
        """A camera at ``pose`` in the middle of ``seconds``, with velocity ``linear`` [3] [m/s] and
        angular velocity ``angular`` [3] [rad/s], both in the world frame."""
        return cls(*(moved(pose, linear, angular, seconds * side) for side in (-0.5, 0.5)))

    @property
    def moves(self) -> bool:
        """Whether start and end differ."""
        return not np.array_equal(self.start, self.end)

    def at(self, times: Float) -> tuple[Float, Float]:
        """Rotations [..., 3, 3] and positions [..., 3] at ``times`` [...] from 0 to 1."""
        times = np.asarray(times, dtype=np.float64)
        ends = matrix_to_quaternion(np.stack([self.start[:3, :3], self.end[:3, :3]]))
        turns = quaternion_to_matrix(slerp(ends[0], ends[1], times))
        share = times[..., None]
        return turns, (1 - share) * self.start[:3, 3] + share * self.end[:3, 3]

    def middle(self) -> Float:
        """``T_world_camera`` [4, 4] in the middle."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.at(np.array(0.5))
        return pose


def moved(pose: Float, linear: Any, angular: Any, seconds: float) -> Float:
    """A pose [4, 4] after ``seconds`` of uniform motion.

    ``linear`` [3] is the velocity of its origin [m/s], ``angular`` [3] the rotation about it
    [rad/s], both in the world frame.
    """
    found = np.array(pose, dtype=np.float64)
    found[:3, :3] = turned(np.asarray(angular, dtype=np.float64) * seconds) @ found[:3, :3]
    found[:3, 3] += np.asarray(linear, dtype=np.float64) * seconds
    return found


def turned(vector: Float) -> Float:
    """The rotation matrix [3, 3] of a rotation vector [3] [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    axis = vector / angle
    return quaternion_to_matrix(np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)]))
