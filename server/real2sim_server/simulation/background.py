"""Colliders of a scene: its ground, and upright boxes around background obstacles.

Occupied cells are those of the closed loop (``scene.ground``). Adjacent cells form one obstacle.
Its Gaussians are split lengthwise until a rectangle in the plane fits each part: one for a pole,
one per side of a house, several for a curved hedge. The recording shows only one side of a wall,
so boxes extend away from the recorded path.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, invert_transform
from ..physics.colliders import Box, HeightField
from ..scene import GaussianCloud, Ground, Scene
from ..scene.ground import (
    MAX_OBSTACLE_HEIGHT,
    OBSTACLE_CELL,
    OBSTACLE_OPACITY,
    OccupiedCells,
    RecordedPath,
    occupied_cells,
)

BACKGROUND = "background"
"""Prefix of the names of these colliders."""
TOP = 4.0
"""Maximum height above the ground of Gaussians that are used [m]."""
FOOT = 0.5
"""Depth below the ground at which boxes begin [m]."""
THIN = 0.4
"""Width below which a part always fits its box, regardless of FILLED [m]."""
FILLED = 0.6
"""Minimum occupied fraction of the cells in the box of a broader part."""
DEPTH = 0.5
"""Depth of boxes behind visible sides, away from the recorded path [m]."""
NARROW = 0.12
"""Minimum width of boxes [m]."""
TRIM = 0.02
"""Fraction of a part's Gaussians trimmed in front of its box, behind it, and above it."""
AROUND = 0.2
"""Clearance around simulated objects at the start [m]."""
BEYOND = 0.06
"""Extent of boxes beyond the outermost Gaussian centres [m]."""
BOXES_MAX = 200
"""Maximum number of boxes; the nearest ones are used."""


@dataclass(frozen=True, eq=False)
class Cleared:
    """A box around an object's start, kept free of colliders.

    Attributes:
        T_world_box: [4, 4].
        size: [3] [m].
    """

    T_world_box: Float
    size: Float

    def holds(self, points: Float) -> NDArray[np.bool_]:
        """Whether points [N, 2] are inside the box, in the plane."""
        back = invert_transform(self.T_world_box)
        level = np.column_stack([points, np.full(len(points), self.T_world_box[2, 3])])
        local = level @ back[:3, :3].T + back[:3, 3]
        inside: NDArray[np.bool_] = np.all(
            np.abs(local[:, :2]) <= self.size[:2] / 2 + AROUND, axis=1
        )
        return inside


@dataclass(frozen=True, eq=False)
class _Rectangle:
    """A rectangle in the plane: centre [2], unit vector along it [2], length and width [m]."""

    centre: Float
    along: Float
    length: float
    width: float

    @property
    def across(self) -> Float:
        return np.array([-self.along[1], self.along[0]])

    def grid(self, step: float) -> Float:
        """[N, 2] points that cover it, at most ``step`` [m] apart."""
        u, v = (
            np.linspace(-edge / 2, edge / 2, max(math.ceil(edge / step), 1) + 1)
            for edge in (self.length, self.width)
        )
        grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        points: Float = self.centre + grid @ np.stack([self.along, self.across])
        return points


def background_colliders(scene: Scene, cleared: Sequence[Cleared], *, within: float) -> list[Box]:
    """Boxes around background obstacles, named ``background.0`` and so on.

    Args:
        scene: scene with background, ground and recorded path.
        cleared: initial boxes of the simulated objects; at least one.
        within: maximum distance of obstacles from these boxes [m].
    """
    way = RecordedPath.of(scene.ego)
    cells = occupied_cells(scene.background, scene.ground, way)
    starts = np.array([c.T_world_box[:2, 3] for c in cleared])
    points = cells.points
    apart = np.linalg.norm(points[:, None, :2] - starts, axis=2).min(axis=1)
    free = ~np.any([c.holds(points[:, :2]) for c in cleared], axis=0)
    found = [
        _seen_side(rectangle, way, cleared)
        for part in _connected(points[(apart < within) & free], cells)
        for rectangle in _fitted(part, cells, cleared)
    ]
    distances = [float(np.linalg.norm(starts - r.centre, axis=1).min()) for r in found]
    kept = [found[k] for k in np.argsort(distances, kind="stable")[:BOXES_MAX].tolist()]
    high = _high_points(scene.background, scene.ground, kept)
    return [_upright(f"{BACKGROUND}.{k}", r, scene.ground, high) for k, r in enumerate(kept)]


def described(boxes: Sequence[Box]) -> list[dict[str, object]]:
    """The background colliders as JSON values."""
    rows: list[dict[str, object]] = []
    for box in boxes:
        pose = np.asarray(box.T_world_box)
        rows.append(
            {
                "name": box.name,
                "position": np.round(pose[:3, 3], 3).tolist(),
                "size": np.round(np.asarray(box.size), 3).tolist(),
                "yaw": round(math.atan2(pose[1, 0], pose[0, 0]), 4),
            }
        )
    return rows


def _connected(points: Float, cells: OccupiedCells) -> Iterator[Float]:
    """Points [K, 2] of each 8-connected group of cells."""
    from scipy import ndimage

    if not len(points):
        return
    index = np.floor((points[:, :2] - cells.origin) / OBSTACLE_CELL).astype(np.int64)
    there = np.zeros(cells.occupied.shape, dtype=np.bool_)
    there[index[:, 0], index[:, 1]] = True
    labels, count = ndimage.label(there, structure=np.ones((3, 3)))
    own = labels[index[:, 0], index[:, 1]]
    order = np.argsort(own, kind="stable")
    ends = np.searchsorted(own[order], np.arange(1, count + 2))
    for first, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        yield points[order[first:end], :2]


def _fitted(
    points: Float, cells: OccupiedCells, cleared: Sequence[Cleared]
) -> Iterator[_Rectangle]:
    """Rectangles that cover points [K, 2] of one obstacle, split until they fit."""
    rectangle = _around(points)
    grid = rectangle.grid(OBSTACLE_CELL / 2)
    blocked = any(c.holds(grid).any() for c in cleared)
    index = np.floor((grid - cells.origin) / OBSTACLE_CELL).astype(np.int64)
    index = np.clip(index, 0, np.array(cells.occupied.shape) - 1)
    filled = float(cells.occupied[index[:, 0], index[:, 1]].mean())
    fits = rectangle.width <= THIN or filled >= FILLED
    if fits and not blocked:
        yield rectangle
        return
    if rectangle.length <= OBSTACLE_CELL:
        # Smaller parts are not resolved.
        if not blocked:
            yield rectangle
        return
    far = (points - rectangle.centre) @ rectangle.along > 0
    for part in (points[far], points[~far]):
        if len(part):
            yield from _fitted(part, cells, cleared)


def _around(points: Float) -> _Rectangle:
    """The rectangle around points [K, 2], along their longest extent."""
    middle = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - middle).T) if len(points) > 1 else np.eye(2))
    along = axes[:, 1]
    frame = np.stack([along, [-along[1], along[0]]])
    local = (points - middle) @ frame.T
    low, high = local.min(axis=0), local.max(axis=0)
    # Cover the full length so that parts of a wall meet; trim outliers across it.
    low[0], high[0] = low[0] - BEYOND, high[0] + BEYOND
    low[1], high[1] = np.quantile(local[:, 1], [TRIM, 1 - TRIM])
    length, width = np.maximum(high - low, NARROW).tolist()
    return _Rectangle(middle + (low + high) / 2 @ frame, along, length, width)


def _seen_side(rectangle: _Rectangle, way: RecordedPath, cleared: Sequence[Cleared]) -> _Rectangle:
    """Thicken a long, thin rectangle away from the recorded path and from ``cleared`` boxes.

    Poles stay as they are.
    """
    missing = DEPTH - rectangle.width
    if missing <= 0 or rectangle.length < 2 * DEPTH:
        return rectangle
    apart = way.positions[:, :2] - rectangle.centre
    towards = apart[int((apart**2).sum(axis=1).argmin())]
    sign = -math.copysign(1.0, float(rectangle.across @ towards))
    centre = rectangle.centre + sign * missing / 2 * rectangle.across
    deep = _Rectangle(centre, rectangle.along, rectangle.length, DEPTH)
    return rectangle if any(c.holds(deep.grid(OBSTACLE_CELL / 2)).any() for c in cleared) else deep


def _high_points(background: GaussianCloud, ground: Ground, near: Sequence[_Rectangle]) -> Float:
    """[K, 3] x, y and height above ground [m] of opaque Gaussians above the height of a car."""
    if not near:
        return np.zeros((0, 3))
    means = background.means.cpu().numpy().astype(np.float64)
    centres = np.array([r.centre for r in near])
    margin = max(r.length for r in near)
    low, high = centres.min(axis=0) - margin, centres.max(axis=0) + margin
    inside = ((means[:, :2] > low) & (means[:, :2] < high)).all(axis=1)
    inside &= (background.opacities > OBSTACLE_OPACITY).cpu().numpy()
    points = means[inside]
    points[:, 2] -= ground.height_at(points[:, :2])
    low_enough: Float = points[(points[:, 2] > 0) & (points[:, 2] < TOP)]
    return low_enough


def _upright(name: str, rectangle: _Rectangle, ground: Ground, high: Float) -> Box:
    """The box over a rectangle, up to the highest points above it."""
    local = (high[:, :2] - rectangle.centre) @ np.stack([rectangle.along, rectangle.across]).T
    reach = np.array([rectangle.length, rectangle.width]) / 2 + OBSTACLE_CELL / 2
    above = high[np.all(np.abs(local) < reach, axis=1), 2]
    tall = float(np.quantile(above, 1 - TRIM)) if len(above) else MAX_OBSTACLE_HEIGHT
    heights = ground.height_at(rectangle.grid(OBSTACLE_CELL))
    low, top = float(heights.min()) - FOOT, float(heights.max()) + tall
    pose = np.eye(4)
    pose[:2, 0], pose[:2, 1] = rectangle.along, rectangle.across
    pose[:2, 3], pose[2, 3] = rectangle.centre, (low + top) / 2
    return Box(name=name, T_world_box=pose, size=(rectangle.length, rectangle.width, top - low))


# The ground.

GROUND = "ground"
"""Name of the ground collider, which supports tyres."""

MARGIN = 40.0
"""Margin of the ground collider around the given positions [m]."""


def ground_collider(
    ground: Ground, places: Float, *, offset: float = 0.0, friction: float | None = None
) -> HeightField:
    """The scene's ground around given positions as a collider; bitwise the same surface.

    Args:
        ground: ground of the scene.
        places: [N, 2] positions to cover, N >= 1, world frame [m].
        offset: height offset [m].
        friction: friction coefficient; None for that of the bodies.
    """
    last = np.array(ground.heights.shape) - 1
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    first = np.floor((low - ground.first_centre) / ground.cell).astype(np.int64)
    end = np.ceil((high - ground.first_centre) / ground.cell).astype(np.int64)
    # At least two samples per axis, even for positions outside the grid.
    i, j = np.clip(first, 0, last - 1).tolist()
    m, n = np.clip(end, [i + 1, j + 1], last).tolist()
    return HeightField(
        name=GROUND,
        heights=ground.heights[i : m + 1, j : n + 1].astype(np.float64) + offset,
        origin=ground.first_centre + np.array([i, j]) * ground.cell,
        spacing=ground.cell,
        friction=friction,
    )
