"""Obstacles of the background: a grid whose occupied cells hold walls, poles, parked cars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ...scene import Scene
from ..path import Float, LoggedPath
from .manifold import ContactManifold
from .pulse import Patch
from .rigid_body import BodyProperties, BodyState

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

BREADTH = 1.0
"""How far to the sides of a contact it is looked for how broad an obstacle is [m]."""

DRIVEN_HALF_WIDTH = 1.1
"""The recorded vehicle drove through here, so there is nothing [m]."""


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

    A cell is occupied when at least three Gaussians of more than half opacity have their centres in
    it between 0.4 and 1.6 m above the ground. Where the recorded vehicle drove it is free.

    Args:
        scene: whose background.
        path: recorded way of the ego.
    """
    found = _grids.get(scene)
    if found is None:
        found = _grids[scene] = _build(scene, path)
    return found


def _build(scene: Scene, path: LoggedPath) -> ObstacleGrid:
    opaque = (scene.background.opacities > OPAQUE).cpu().numpy()
    points = scene.background.means.cpu().numpy().astype(np.float64)[opaque]
    lower = path.positions[:, :2].min(axis=0) - REACH
    upper = path.positions[:, :2].max(axis=0) + REACH
    shape = np.ceil((upper - lower) / CELL).astype(np.int64)
    points = points[((points[:, :2] >= lower) & (points[:, :2] < upper)).all(axis=1)]
    counts = np.zeros(shape, dtype=np.int32)
    if len(points):
        height = points[:, 2] - scene.ground.height_at(points[:, :2])
        standing = points[(height > LOWEST) & (height < HIGHEST)]
        cells = np.floor((standing[:, :2] - lower) / CELL).astype(np.int64)
        np.add.at(counts, (cells[:, 0], cells[:, 1]), 1)
    occupied = counts >= FEWEST
    _clear_driven(occupied, lower, path)
    return ObstacleGrid(lower, occupied)


def _clear_driven(occupied: NDArray[np.bool_], lower: Float, path: LoggedPath) -> None:
    # From behind the rear axle at the start to the front bumper at the end.
    at = np.arange(-1.0, path.length + 4.0, CELL)
    x = np.interp(at, path.s, path.positions[:, 0])
    y = np.interp(at, path.s, path.positions[:, 1])
    yaw = np.interp(at, path.s, path.yaws)
    beyond = at - np.clip(at, 0.0, path.length)
    x, y = x + beyond * np.cos(yaw), y + beyond * np.sin(yaw)
    for side in np.arange(-DRIVEN_HALF_WIDTH, DRIVEN_HALF_WIDTH + CELL / 2, CELL / 2):
        points = np.stack([x - side * np.sin(yaw), y + side * np.cos(yaw)], axis=1)
        cells = np.floor((points - lower) / CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < occupied.shape)).all(axis=1)
        occupied[cells[inside, 0], cells[inside, 1]] = False
