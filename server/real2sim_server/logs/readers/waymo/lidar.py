"""Range images of the Waymo Open Dataset to points.

Source: ``compute_range_image_polar`` and its neighbours in the data set's own
``range_image_utils``; the notes of ``dataset.proto``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....geometry.rotation import Float
from ....geometry.transform import apply_transform, invert_transform
from ...driving_log import LidarSweep, LogError

TOP = 1
"""Number of the only laser whose range images have a pose per pixel."""


@dataclass(frozen=True, eq=False)
class Laser:
    """Calibration of one laser.

    Attributes:
        number: 1 is TOP.
        inclinations: [N] float64 [rad], ascending; or None, then ``limits`` are divided evenly.
        limits: (lowest, highest) inclination [rad].
        T_vehicle_laser: [4, 4].
    """

    number: int
    inclinations: Float | None
    limits: tuple[float, float]
    T_vehicle_laser: Float

    def rows(self, height: int, where: str) -> Float:
        """Inclination [height] of each row of a range image; the first row looks up the most.

        Raises:
            LogError: the image has another number of rows than the laser has beams.
        """
        if self.inclinations is None:
            low, high = self.limits
            return ((np.arange(height) + 0.5) / height * (high - low) + low)[::-1]
        if len(self.inclinations) != height:
            raise LogError(
                f"{where}: a range image of {height} rows, but laser {self.number} has "
                f"{len(self.inclinations)} beam inclinations"
            )
        return self.inclinations[::-1]

    def azimuths(self, width: int) -> Float:
        """Azimuth [width] [rad] of each column in the laser's own frame."""
        correction = np.arctan2(self.T_vehicle_laser[1, 0], self.T_vehicle_laser[0, 0])
        turn = (width - np.arange(width) - 0.5) / width * 2 - 1
        azimuths: Float = turn * np.pi - correction
        return azimuths


@dataclass(frozen=True, eq=False)
class RangeImage:
    """One return of one laser.

    Attributes:
        laser: its calibration.
        values: [H, W, C] float32: range [m] (0 or below: nothing), intensity, ...
        pixel_poses: [H, W, 6] float32 roll, pitch, yaw, x, y, z of ``T_world_vehicle`` when each
            pixel was measured; None: all points are in the vehicle frame of the frame already.
        where: file and place, for errors.
    """

    laser: Laser
    values: NDArray[np.float32]
    pixel_poses: NDArray[np.float32] | None
    where: str


@dataclass(frozen=True)
class SweepTiming:
    """Times of one sweep of the TOP laser, which goes from behind over the left to the front.

    Attributes:
        start_us: of the first column, relative to the frame's time stamp.
        duration_us: of the sweep.
    """

    start_us: float
    duration_us: float


def merge_range_images(
    images: Iterable[RangeImage], T_world_vehicle: Float, timing: SweepTiming
) -> LidarSweep:
    """All points of a frame in its vehicle frame.

    Points of the TOP laser were measured while it turned; those of the others are given without
    times, their offset is 0. Intensities are clipped to [0, 1].

    Args:
        images: all returns of all lasers.
        T_world_vehicle: pose of the frame [4, 4], in the world of the pixel poses.
        timing: when the columns of the TOP laser were measured.
    """
    points, intensities, offsets = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    origin = np.zeros(3)
    for image in images:
        row, column, found = pixel_points(image)
        if image.pixel_poses is not None:
            poses = image.pixel_poses[row, column].astype(np.float64)
            in_world = np.einsum("nij,nj->ni", rotations(poses[:, :3]), found) + poses[:, 3:]
            found = apply_transform(invert_transform(T_world_vehicle), in_world)
        points.append(found)
        intensities.append(np.clip(image.values[row, column, 1], 0, 1))
        width = image.values.shape[1]
        fraction = (column + 0.5) / width * timing.duration_us + timing.start_us
        offsets.append(fraction if image.laser.number == TOP else np.zeros(len(column)))
        if image.laser.number == TOP or not origin.any():
            origin = image.laser.T_vehicle_laser[:3, 3]
    return LidarSweep(
        points=np.concatenate(points).astype(np.float32),
        intensity=np.concatenate(intensities).astype(np.float32),
        offset_us=np.round(np.concatenate(offsets)).astype(np.int32),
        origin=origin.astype(np.float32),
    )


def pixel_points(image: RangeImage) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Rows [N], columns [N] and points [N, 3] float64 of all pixels with a return, row by row, in
    the vehicle frame of their own instant."""
    height, width = image.values.shape[:2]
    inclination = image.laser.rows(height, image.where)
    azimuth = image.laser.azimuths(width)
    ranges = image.values[..., 0].astype(np.float64)
    row, column = np.nonzero(np.isfinite(ranges) & (ranges > 0))
    distance, up, turned = ranges[row, column], inclination[row], azimuth[column]
    level = distance * np.cos(up)
    local = np.stack(
        [level * np.cos(turned), level * np.sin(turned), distance * np.sin(up)], axis=1
    )
    return row, column, apply_transform(image.laser.T_vehicle_laser, local)


def rotations(angles: Float) -> Float:
    """Matrices [N, 3, 3] of roll, pitch, yaw [N, 3] [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles(rotation: Float) -> Float:
    """Roll, pitch, yaw [..., 3] [rad] of rotations [..., 3, 3]; the inverse of rotations."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -1, 1))
    yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)
