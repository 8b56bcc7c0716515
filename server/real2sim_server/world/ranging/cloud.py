"""What a LiDAR or a radar has measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one sensor at one instant.

    Attributes:
        sensor: its name.
        modality: ``lidar`` or ``radar``.
        t_us: instant [us]; a sweep ends then.
        duration_us: from the first ray to the last; 0 of radars.
        frame: of ``points``: ``sensor`` or ``vehicle``.
        compensated: whether points are as seen from the pose at ``t_us``.
        T_vehicle_sensor: [4, 4] float64.
        T_world_sensor: [4, 4] float64, at ``t_us``.
        columns: by name, [N] or [N, width] each, ``points`` [N, 3] float32 [m] first.
        codec: ``raw`` or ``deflate``, how it is sent.
    """

    sensor: str
    modality: str
    t_us: int
    duration_us: int
    frame: str
    compensated: bool
    T_vehicle_sensor: Float
    T_world_sensor: Float
    columns: Mapping[str, NDArray[Any]]
    codec: str = "raw"

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.columns["points"])


def in_frame(points: Float, frame: str, T_vehicle_sensor: Float) -> NDArray[np.float32]:
    """Points [N, 3] of the sensor's frame in the frame that is asked for."""
    if frame == "vehicle":
        points = points @ T_vehicle_sensor[:3, :3].T + T_vehicle_sensor[:3, 3]
    return points.astype(np.float32)
