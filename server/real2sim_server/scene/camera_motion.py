"""A camera that moves while its image is read out, and where it sees points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import Float, matrix_to_quaternion, quaternion_to_matrix, slerp
from .camera import Camera

ROUNDS = 11
"""Most rounds in which the row of a point and its time settle; each gains two digits."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Where a camera is while an image is read out.

    Its place goes evenly along a straight line, its turn evenly about one axis.

    Attributes:
        start, end: [4, 4] ``T_world_camera`` when the first and the last line are taken.
    """

    start: Float
    end: Float

    @classmethod
    def still(cls, pose: Float) -> CameraMotion:
        """A camera that stands at ``pose`` [4, 4]."""
        return cls(pose, pose)

    @classmethod
    def about(cls, pose: Float, linear: Float, angular: Float, seconds: float) -> CameraMotion:
        """Of a camera that is at ``pose`` in the middle of ``seconds``, and moves at ``linear`` [3]
        [m/s] and turns at ``angular`` [3] [rad/s], both in the world."""
        return cls(*(moved(pose, linear, angular, seconds * side) for side in (-0.5, 0.5)))

    @property
    def moves(self) -> bool:
        """Whether start and end differ."""
        return not np.array_equal(self.start, self.end)

    def at(self, times: Float) -> tuple[Float, Float]:
        """Turns [..., 3, 3] and places [..., 3] at ``times`` [...] from 0 to 1."""
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
    """A pose [4, 4] after ``seconds`` of an even motion: ``linear`` [3] of its own origin [m/s],
    ``angular`` [3] about it [rad/s], both in the world."""
    found = np.array(pose, dtype=np.float64)
    found[:3, :3] = turned(np.asarray(angular, dtype=np.float64) * seconds) @ found[:3, :3]
    found[:3, 3] += np.asarray(linear, dtype=np.float64) * seconds
    return found


def turned(vector: Float) -> Float:
    """The rotation [3, 3] about ``vector`` [3] by its length [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    axis = vector / angle
    return quaternion_to_matrix(np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)]))


def project_moving(
    camera: Camera,
    motion: CameraMotion,
    points: Float,
    velocities: Float | None = None,
) -> tuple[Float, NDArray[np.bool_], Float]:
    """Where a camera with a rolling shutter sees points.

    The row in which a point is seen says when it is seen, and the time says where: rounds settle
    both.

    Args:
        camera: with its lens and shutter.
        motion: of the camera.
        points: [N, 3] in the world, in the middle of the read-out [m].
        velocities: [N, 3] of the points [m/s]; None: they stand.

    Returns:
        Positions [N, 2] [px], whether they have any [N], and times [N] from 0 to 1.
    """
    shutter, size = camera.shutter, (camera.width, camera.height)
    per_frame = 0.0 if velocities is None else velocities * (shutter.readout_us * 1e-6)
    times = np.zeros(len(points))
    for _ in range(ROUNDS if shutter.rolls else 1):
        turns, places = motion.at(times)
        seen = points + per_frame * (times - 0.5)[:, None]
        own = np.einsum("nji,nj->ni", turns, seen - places)
        pixels, valid = camera.project(own)
        if not shutter.rolls:
            break
        before, times = times, shutter.times_at(pixels, *size)
        if np.array_equal(before, times):
            break
    return pixels, valid, times
