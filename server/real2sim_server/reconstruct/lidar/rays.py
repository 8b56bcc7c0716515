"""Recorded sweeps as rays: which way each was fired, from where and when."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.ranging import MAX_RAYS

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...render.cast.call import transforms_at
from ...scene import Beams, Detection, Lidar

FAR = 250.0
"""Recorded points beyond this are left out [m]."""
SEES_ALL = Detection(range_m=2000.0, reflectivity=1e-6)
"""Nobody knows the limit of the sensor; where its beams were lost the scene says."""


@dataclass(frozen=True, eq=False)
class RecordedRays:
    """The rays of a sweep that returned.

    Attributes:
        lidar: a table of these rays.
        range: [R] float64 [m].
        intensity: [R] float32.
        points: [R, 3] float64, in the world, where each was measured [m].
    """

    lidar: Lidar
    range: Float
    intensity: NDArray[np.float32]
    points: Float

    def select(self, kept: NDArray[np.bool_]) -> RecordedRays:
        """The rays of a mask, in their order."""
        beams = self.lidar.beams
        chosen = Beams(beams.azimuth[kept], beams.elevation[kept], beams.time_us[kept])
        lidar = replace(self.lidar, beams=chosen)
        return RecordedRays(lidar, self.range[kept], self.intensity[kept], self.points[kept])


def recorded_rays(log: DrivingLog, frame: int) -> RecordedRays | None:
    """The rays of the sweep of ``frame``; None where it is empty.

    Sweeps are brought to the frame's time stamp by the vehicle's own motion; here that is undone,
    so that each ray starts where the sensor was.

    Raises:
        LogError: the sweep cannot be read.
    """
    sweep, t_us = log.lidar(frame), int(log.frame_times_us[frame])
    if len(sweep.points) == 0:
        return None
    world = apply_transform(log.ego.transform(t_us), sweep.points)
    instants, index = np.unique(sweep.offset_us, return_inverse=True)
    sensor = transforms_at(log.ego, t_us + instants.astype(np.float64)) @ _shift(sweep.origin)
    to_sensor = invert_transform(sensor)[index]
    local = apply_transform(to_sensor, world[:, None])[:, 0]
    distance = np.linalg.norm(local, axis=1)
    kept = np.flatnonzero((distance > 0.1) & (distance < FAR) & np.isfinite(distance))
    if len(kept) == 0:
        return None
    kept = kept[:: -(-len(kept) // MAX_RAYS)]
    x, y, z = local[kept].T
    beams = Beams(
        np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), sweep.offset_us[kept].astype(np.float64)
    )
    lidar = Lidar(
        name=f"recorded {log.name} {frame}",
        beams=beams,
        T_vehicle_lidar=_shift(sweep.origin),
        min_range=0.1,
        max_range=FAR,
        detection=SEES_ALL,
    )
    return RecordedRays(lidar, distance[kept], sweep.intensity[kept], world[kept])


def _shift(origin: NDArray[np.float32]) -> Float:
    pose = np.eye(4)
    pose[:3, 3] = origin
    return pose
