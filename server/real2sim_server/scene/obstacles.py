"""What of a scene's background stands in the way of a car: occupied cells, seen from above.

The closed loop tests contact against these cells, and simulations make colliders of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import Float, quaternion_yaw
from .cloud import GaussianCloud
from .ground import Ground
from .trajectory import Trajectory

CELL = 0.25
"""Edge of a cell [m]."""

LOWEST, HIGHEST = 0.4, 1.6
"""Heights above the ground between which a Gaussian is in the way of a car [m]."""

OPAQUE = 0.5
"""Gaussians fainter than this do not count."""

FEWEST = 3
"""Gaussians in a cell from which on it is occupied; fewer are floaters."""

REACH = 40.0
"""Distance from the recorded path within which cells are looked at [m]."""

DRIVEN_HALF_WIDTH = 1.1
"""The recorded vehicle drove through here, so there is nothing [m]."""

POSE_SPACING = 0.05
"""Recorded poses nearer than this to the one before add nothing but noise [m]."""

STUB = 1.0
"""Length given to the way of a vehicle that never moved [m]."""


class Way(Protocol):
    """What is needed of the recorded way of the ego."""

    @property
    def s(self) -> Float:
        """[P] distance of each pose from the start [m]."""
        ...

    @property
    def positions(self) -> Float:
        """[P, 3] [m]."""
        ...

    @property
    def yaws(self) -> Float:
        """[P] continuous [rad]."""
        ...


@dataclass(frozen=True, eq=False)
class RecordedWay:
    """The recorded way of the ego, poses that are apart only.

    Attributes:
        s, positions, yaws: see :class:`Way`.
    """

    s: Float
    positions: Float
    yaws: Float

    @classmethod
    def of(cls, ego: Trajectory) -> RecordedWay:
        """The way of a trajectory; of a vehicle that never moved, a metre along its heading."""
        kept = [0]
        for i, place in enumerate(ego.positions[:, :2]):
            if float(((place - ego.positions[kept[-1], :2]) ** 2).sum()) >= POSE_SPACING**2:
                kept.append(i)
        positions = ego.positions[kept]
        yaws = np.unwrap(quaternion_yaw(ego.quaternions[kept]))
        if len(kept) == 1:
            ahead = STUB * np.array([np.cos(yaws[0]), np.sin(yaws[0]), 0.0])
            positions = np.stack([positions[0], positions[0] + ahead])
            yaws = np.repeat(yaws, 2)
        steps = np.abs(np.diff(positions[:, 0] + 1j * positions[:, 1]))
        return cls(np.concatenate([[0.0], np.cumsum(steps)]), positions, yaws)


@dataclass(frozen=True, eq=False)
class OccupiedCells:
    """Cells of the ground in which something opaque stands.

    Attributes:
        origin: [2] lowest corner [m].
        occupied: [nx, ny] bool.
        points: [K, 3] float64 centres of the Gaussians in the way, of occupied cells only [m].
    """

    origin: Float
    occupied: NDArray[np.bool_]
    points: Float


def occupied_cells(background: GaussianCloud, ground: Ground, way: Way) -> OccupiedCells:
    """Where something of a background is in the way.

    A cell is occupied when at least three Gaussians of more than half opacity have their centres in
    it between 0.4 and 1.6 m above the ground. Where the recorded vehicle drove it is free.

    Args:
        background: of a scene.
        ground: of the same scene.
        way: of the vehicle that recorded it.
    """
    opaque = (background.opacities > OPAQUE).cpu().numpy()
    points = background.means.cpu().numpy().astype(np.float64)[opaque]
    lower = way.positions[:, :2].min(axis=0) - REACH
    upper = way.positions[:, :2].max(axis=0) + REACH
    shape = np.ceil((upper - lower) / CELL).astype(np.int64)
    points = points[((points[:, :2] >= lower) & (points[:, :2] < upper)).all(axis=1)]
    counts = np.zeros(shape, dtype=np.int32)
    if len(points):
        height = points[:, 2] - ground.height_at(points[:, :2])
        points = points[(height > LOWEST) & (height < HIGHEST)]
        cells = np.floor((points[:, :2] - lower) / CELL).astype(np.int64)
        np.add.at(counts, (cells[:, 0], cells[:, 1]), 1)
    occupied = counts >= FEWEST
    _clear_driven(occupied, lower, way)
    cells = np.floor((points[:, :2] - lower) / CELL).astype(np.int64)
    return OccupiedCells(lower, occupied, points[occupied[cells[:, 0], cells[:, 1]]])


def _clear_driven(occupied: NDArray[np.bool_], lower: Float, way: Way) -> None:
    # From behind the rear axle at the start to the front bumper at the end.
    length = float(way.s[-1])
    at = np.arange(-1.0, length + 4.0, CELL)
    x = np.interp(at, way.s, way.positions[:, 0])
    y = np.interp(at, way.s, way.positions[:, 1])
    yaw = np.interp(at, way.s, way.yaws)
    beyond = at - np.clip(at, 0.0, length)
    x, y = x + beyond * np.cos(yaw), y + beyond * np.sin(yaw)
    for side in np.arange(-DRIVEN_HALF_WIDTH, DRIVEN_HALF_WIDTH + CELL / 2, CELL / 2):
        points = np.stack([x - side * np.sin(yaw), y + side * np.cos(yaw)], axis=1)
        cells = np.floor((points - lower) / CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < occupied.shape)).all(axis=1)
        occupied[cells[inside, 0], cells[inside, 1]] = False
