"""Obstacles of the background: a grid whose occupied cells hold walls, poles, parked cars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ...scene import Scene
from ...scene.obstacles import CELL, occupied_cells
from ..path import Float, LoggedPath
from .manifold import ContactManifold
from .pulse import Patch
from .rigid_body import BodyProperties, BodyState

BREADTH = 1.0
"""How far to the sides of a contact it is looked for how broad an obstacle is [m]."""


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """A grid on the plane.

    Attributes:
        origin: [2] lowest corner [m].
        occupied: [nx, ny] bool.
    """

    origin: Float
    occupied: NDArray[np.bool_]

    @cached_property
    def sums(self) -> NDArray[np.int64]:
        """[nx + 1, ny + 1], occupied cells below and left of each corner of a cell."""
        sums = np.zeros((self.occupied.shape[0] + 1, self.occupied.shape[1] + 1), np.int64)
        sums[1:, 1:] = self.occupied.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
        return sums

    def manifold(self, body: BodyState, properties: BodyProperties) -> ContactManifold | None:
        """Where a body overlaps occupied cells; the normal points from their middle to its box."""
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)
        hit = np.zeros(len(points), dtype=bool)
        hit[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
        if not hit.any():
            return None
        x, y = points[hit].mean(axis=0).tolist()
        return _nearest_side(body, properties, x, y)

    def patch(self, body: BodyState, properties: BodyProperties, nx: float, ny: float) -> Patch:
        """How far occupied cells reach into a body, from its face against the unit normal ``n``,
        which points out of them; only where :meth:`manifold` finds any."""
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)
        hit = np.zeros(len(points), dtype=bool)
        hit[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
        x, y = points[hit].mean(axis=0).tolist()
        along, across = points @ [nx, ny], points[hit] @ [-ny, nx]
        width = float(np.ptp(across)) + CELL / 2
        return Patch(x, y, float(along[hit].max() - along.min()), width)

    def breadth(self, x: float, y: float, nx: float, ny: float) -> tuple[float, float]:
        """How far what stands at x, y reaches to both sides of it across the normal ``n`` [m], at
        most BREADTH: a pole hardly, a wall as far as is looked."""
        steps = np.arange(0.0, BREADTH + CELL / 4, CELL / 2)
        deep = np.arange(-CELL, CELL * 1.01, CELL / 2)
        found = []
        for sign in (-1.0, 1.0):
            across = sign * steps[:, None]
            places = np.stack([x - across * ny + deep * nx, y + across * nx + deep * ny], axis=-1)
            cells = np.floor((places - self.origin) / CELL).astype(np.int64)
            inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=-1)
            there = np.zeros(inside.shape, dtype=bool)
            there[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
            gaps = np.flatnonzero(~there.any(axis=1))
            found.append(float(steps[gaps[0] - 1]) if len(gaps) and gaps[0] else 0.0)
            if not len(gaps):
                found[-1] = BREADTH
        return found[0], found[1]

    def count(self, body: BodyState, properties: BodyProperties) -> int:
        """Number of occupied cells under a body."""
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / CELL).astype(np.int64)
        inside = cells[((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)]
        distinct = np.unique(inside[:, 0] * self.occupied.shape[1] + inside[:, 1])
        return int(self.occupied.reshape(-1)[distinct].sum())


def _nearest_side(
    body: BodyState, properties: BodyProperties, x: float, y: float
) -> ContactManifold:
    """The manifold at (x, y) on the side of the box that is nearest to it."""
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    dx = x - body.x - properties.box_ahead * cos
    dy = y - body.y - properties.box_ahead * sin
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    deep_x, deep_y = properties.length / 2 - abs(ahead), properties.width / 2 - abs(left)
    if deep_x <= deep_y:
        sign = -math.copysign(1.0, ahead)
        return ContactManifold(x, y, sign * cos, sign * sin, max(deep_x, 0.0))
    sign = -math.copysign(1.0, left)
    return ContactManifold(x, y, -sign * sin, sign * cos, max(deep_y, 0.0))


def footprint(body: BodyState, properties: BodyProperties) -> Float:
    """Points [N, 2] [m] all over the body's box, no farther apart than half a cell."""
    nx = max(math.ceil(properties.length / (CELL / 2)), 1) + 1
    ny = max(math.ceil(properties.width / (CELL / 2)), 1) + 1
    u = np.linspace(-properties.length / 2, properties.length / 2, nx) + properties.box_ahead
    v = np.linspace(-properties.width / 2, properties.width / 2, ny)
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    points: Float = grid @ np.array([[cos, sin], [-sin, cos]]) + [body.x, body.y]
    return points


_grids: WeakKeyDictionary[Scene, ObstacleGrid] = WeakKeyDictionary()


def obstacle_grid(scene: Scene, path: LoggedPath) -> ObstacleGrid:
    """The grid of a scene's background; made once for each scene in memory.

    Which cells are occupied is what :func:`~...scene.obstacles.occupied_cells` says, in simulations
    too.

    Args:
        scene: whose background.
        path: recorded way of the ego.
    """
    found = _grids.get(scene)
    if found is None:
        cells = occupied_cells(scene.background, scene.ground, path)
        found = _grids[scene] = ObstacleGrid(cells.origin, cells.occupied)
    return found
