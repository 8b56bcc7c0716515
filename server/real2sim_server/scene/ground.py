"""The ground of a scene: a height grid that supports vehicles, people and falling objects.

Kernels query heights, normals and poses. :class:`OccupiedCells` holds the occupied cells of the
background above the ground, seen from above, for contact tests and simulation colliders.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._numba import func, kernel
from ..geometry import Float, quaternion_yaw
from .cloud import GaussianCloud
from .errors import SceneError
from .trajectory import Trajectory

# Kernels.

HALF_WHEELBASE, HALF_TRACK = 1.0, 0.8
"""Distances ahead, behind and to the sides at which the slope is sampled [m]. At the size of a
vehicle, noise and edges of single cells do not tilt it."""


@func
def height_under(heights: Any, frame: Any, x: float, y: float) -> Any:
    """Bilinear height between cell centres; positions outside are clamped to the border.

    Args:
        heights: [X, Y] float32, at cell centres [m].
        frame: [3] float64, x and y of the centre of cell (0, 0), and the edge of a cell [m].
        x, y: position [m].
    """
    x0, y0, cell = frame[0], frame[1], frame[2]
    rows, columns = heights.shape
    u = min(max((x - x0) / cell, 0.0), rows - 1.0)
    v = min(max((y - y0) / cell, 0.0), columns - 1.0)
    i, j = min(int(u), rows - 2), min(int(v), columns - 2)
    a, b = u - i, v - j
    low = heights[i, j] * (1.0 - a) + heights[i + 1, j] * a
    high = heights[i, j + 1] * (1.0 - a) + heights[i + 1, j + 1] * a
    return low * (1.0 - b) + high * b


@kernel
def height_at(heights: Any, frame: Any, x: float, y: float) -> Any:
    """Ground height [m] below one position."""
    return height_under(heights, frame, x, y)


@kernel
def heights_at(heights: Any, frame: Any, points: Any) -> Any:
    """Ground heights [S] float64 [m] below positions [S, 2]."""
    found = np.empty(len(points))
    for k in range(len(points)):
        found[k] = height_under(heights, frame, points[k, 0], points[k, 1])
    return found


@func
def normal_over(heights: Any, frame: Any, x: float, y: float, yaw: float) -> Any:
    """Unit normal of the ground plane between the wheels of a vehicle at (x, y) with heading
    ``yaw``.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    fx, fy = HALF_WHEELBASE * cos, HALF_WHEELBASE * sin
    lx, ly = -HALF_TRACK * sin, HALF_TRACK * cos
    ahead = height_under(heights, frame, x + fx, y + fy)
    behind = height_under(heights, frame, x - fx, y - fy)
    left = height_under(heights, frame, x + lx, y + ly)
    right = height_under(heights, frame, x - lx, y - ly)
    rise, lean = (ahead - behind) / (2 * HALF_WHEELBASE), (left - right) / (2 * HALF_TRACK)
    a, b = -(rise * cos - lean * sin), -(rise * sin + lean * cos)
    up = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return a * up, b * up, up


@kernel
def normals_at(heights: Any, frame: Any, points: Any) -> Any:
    """Unit normals [S, 3] float64 of the ground below positions [S, 2]."""
    found = np.empty((len(points), 3))
    for k in range(len(points)):
        found[k] = normal_over(heights, frame, points[k, 0], points[k, 1], 0.0)
    return found


@kernel
def pose_at(heights: Any, frame: Any, x: float, y: float, yaw: float) -> Any:
    """``T_world_vehicle`` [4, 4] of a vehicle on the ground at (x, y) with heading ``yaw``."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    a, b, c = normal_over(heights, frame, x, y, yaw)
    slope = -(a * cos + b * sin) / c
    length = math.sqrt(1.0 + slope * slope)
    fx, fy, fz = cos / length, sin / length, slope / length
    pose = np.zeros((4, 4))
    pose[0, 0], pose[1, 0], pose[2, 0] = fx, fy, fz
    pose[0, 1], pose[1, 1], pose[2, 1] = b * fz - c * fy, c * fx - a * fz, a * fy - b * fx
    pose[0, 2], pose[1, 2], pose[2, 2] = a, b, c
    pose[0, 3], pose[1, 3] = x, y
    pose[2, 3] = height_under(heights, frame, x, y)
    pose[3, 3] = 1.0
    return pose


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights on a grid in the world. Immutable and shared.

    Heights are bilinear between cell centres; outside the grid, the nearest point of its border is
    used. Each position has one height. Where a bridge crosses a road, it is the height of the road
    that was driven.

    Attributes:
        origin: [2] float64, corner of cell (0, 0) [m].
        cell: edge of a cell [m].
        heights: [X, Y] float32, z at cell centres [m], finite; X and Y are at least 2.
        is_ground: [X, Y] bool, where ground is known: measured or driven, between measurements,
            under boxes. Elsewhere heights are extrapolated.

    Raises:
        SceneError: shapes differ, a side is below 2, values are not finite, or the cell is not
            positive.
    """

    origin: Float
    cell: float
    heights: NDArray[np.float32]
    is_ground: NDArray[np.bool_]

    def __post_init__(self) -> None:
        origin = np.array(self.origin, dtype=np.float64)
        heights = np.array(self.heights, dtype=np.float32, order="C")
        is_ground = np.array(self.is_ground, dtype=np.bool_, order="C")
        if origin.shape != (2,) or not np.isfinite(origin).all():
            raise SceneError(f"origin of the ground must be two numbers, not {origin}")
        if heights.ndim != 2 or min(heights.shape) < 2 or heights.shape != is_ground.shape:
            raise SceneError(
                f"ground of heights {list(heights.shape)} and is_ground {list(is_ground.shape)}; "
                "both must be [X, Y] with X, Y >= 2"
            )
        if not np.isfinite(heights).all():
            raise SceneError("heights of the ground hold values that are not finite")
        if not (np.isfinite(self.cell) and self.cell > 0):
            raise SceneError(f"cell of the ground must be a positive length, not {self.cell!r}")
        for array in (origin, heights, is_ground):
            array.flags.writeable = False
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "cell", float(self.cell))
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "is_ground", is_ground)

    @classmethod
    def level(cls, z: float) -> Ground:
        """Ground at height ``z`` [m] everywhere."""
        return cls(np.zeros(2), 1.0, np.full((2, 2), z), np.ones((2, 2), dtype=np.bool_))

    def height_at(self, points: ArrayLike) -> Float:
        """z [S] float64 [m] below ``points`` [S, 2] [m] of the world."""
        found: Float = heights_at(*self.grid, np.ascontiguousarray(points, dtype=np.float64))
        return found

    def height(self, x: float, y: float) -> float:
        """z [m] at one position [m], in about a microsecond."""
        found: float = height_at(*self.grid, x, y)
        return found

    def normal_at(self, points: ArrayLike) -> Float:
        """Unit normals [S, 3] float64 below ``points`` [S, 2], over the size of a vehicle."""
        found: Float = normals_at(*self.grid, np.ascontiguousarray(points, dtype=np.float64))
        return found

    def pose_on(self, x: float, y: float, yaw: float) -> Float:
        """``T_world_vehicle`` [4, 4] float64 of a vehicle at (x, y) [m].

        Its x axis seen from above has heading ``yaw`` [rad]; its z axis is normal to the ground
        between its wheels.
        """
        found: Float = pose_at(*self.grid, x, y, yaw)
        return found

    def covers(self, points: Float) -> NDArray[np.bool_]:
        """Whether ``points`` [S, 2] are on known ground, [S] bool."""
        index = np.floor((points - self.origin) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.heights.shape)).all(axis=1)
        index = np.clip(index, 0, np.array(self.heights.shape) - 1)
        return inside & self.is_ground[index[:, 0], index[:, 1]]

    @property
    def first_centre(self) -> Float:
        """[2] float64, centre of cell (0, 0) [m]."""
        return self.origin + self.cell / 2

    @property
    def centres(self) -> Float:
        """[X * Y, 2] float64, centres of all cells, row by row [m]."""
        cells = np.indices(self.heights.shape).reshape(2, -1).T.astype(np.float64)
        return cells * self.cell + self.first_centre

    @property
    def nbytes(self) -> int:
        """Memory of the grid [bytes]."""
        return self.heights.nbytes + self.is_ground.nbytes

    @cached_property
    def grid(self) -> tuple[NDArray[np.float32], Float]:
        """Arguments of the kernels: heights, and (x0, y0, cell size) of the grid."""
        return self.heights, np.append(self.first_centre, self.cell)


_of_bundles: WeakValueDictionary[str, Ground] = WeakValueDictionary()
_making = threading.Lock()


def of_bundle(content_hash: str, make: Callable[[], Ground]) -> Ground:
    """The ground of the bundle with that hash, cached or from ``make``.

    A scene and its summaries share one ground, so that it is fitted only once.
    """
    with _making:
        known = _of_bundles.get(content_hash)
        if known is None:
            known = _of_bundles[content_hash] = make()
        return known


# Obstacles.

OBSTACLE_CELL = 0.25
"""Edge of a cell [m]."""

MIN_OBSTACLE_HEIGHT, MAX_OBSTACLE_HEIGHT = 0.4, 1.6
"""Heights above the ground of Gaussians that block a car [m]."""

OBSTACLE_OPACITY = 0.5
"""Minimum opacity of Gaussians that count."""

MIN_GAUSSIANS = 3
"""Minimum Gaussians in an occupied cell; fewer are floaters."""

MAX_DISTANCE = 40.0
"""Maximum distance of cells from the recorded path [m]."""

DRIVEN_HALF_WIDTH = 1.1
"""Half width of the driven corridor, which counts as free [m]."""

POSE_SPACING = 0.05
"""Minimum spacing of recorded poses [m]; closer ones only add noise."""

PARKED_LENGTH = 1.0
"""Path length of a parked vehicle [m]."""


class EgoPath(Protocol):
    """The recorded path of the ego, as :func:`occupied_cells` needs it."""

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
class RecordedPath:
    """The recorded path of the ego, without coincident poses.

    Attributes:
        s, positions, yaws: see :class:`EgoPath`.
    """

    s: Float
    positions: Float
    yaws: Float

    @classmethod
    def of(cls, ego: Trajectory) -> RecordedPath:
        """The path of a trajectory; for a parked vehicle, a metre along its heading."""
        kept = [0]
        for i, place in enumerate(ego.positions[:, :2]):
            if float(((place - ego.positions[kept[-1], :2]) ** 2).sum()) >= POSE_SPACING**2:
                kept.append(i)
        positions = ego.positions[kept]
        yaws = np.unwrap(quaternion_yaw(ego.quaternions[kept]))
        if len(kept) == 1:
            ahead = PARKED_LENGTH * np.array([np.cos(yaws[0]), np.sin(yaws[0]), 0.0])
            positions = np.stack([positions[0], positions[0] + ahead])
            yaws = np.repeat(yaws, 2)
        steps = np.abs(np.diff(positions[:, 0] + 1j * positions[:, 1]))
        return cls(np.concatenate([[0.0], np.cumsum(steps)]), positions, yaws)


@dataclass(frozen=True, eq=False)
class OccupiedCells:
    """Ground cells with opaque Gaussians above them.

    Attributes:
        origin: [2] lowest corner [m].
        occupied: [nx, ny] bool.
        points: [K, 3] float64 centres of the blocking Gaussians, in occupied cells only [m].
    """

    origin: Float
    occupied: NDArray[np.bool_]
    points: Float


def occupied_cells(background: GaussianCloud, ground: Ground, path: EgoPath) -> OccupiedCells:
    """Cells in which the background blocks a car.

    A cell is occupied if it contains the centres of at least three Gaussians with more than half
    opacity, between 0.4 and 1.6 m above the ground. The corridor of the recording vehicle is free.

    Args:
        background: background of a scene.
        ground: ground of the same scene.
        path: path of the recording vehicle.
    """
    opaque = (background.opacities > OBSTACLE_OPACITY).cpu().numpy()
    points = background.means.cpu().numpy().astype(np.float64)[opaque]
    lower = path.positions[:, :2].min(axis=0) - MAX_DISTANCE
    upper = path.positions[:, :2].max(axis=0) + MAX_DISTANCE
    shape = np.ceil((upper - lower) / OBSTACLE_CELL).astype(np.int64)
    points = points[((points[:, :2] >= lower) & (points[:, :2] < upper)).all(axis=1)]
    counts = np.zeros(shape, dtype=np.int32)
    if len(points):
        height = points[:, 2] - ground.height_at(points[:, :2])
        points = points[(height > MIN_OBSTACLE_HEIGHT) & (height < MAX_OBSTACLE_HEIGHT)]
        cells = np.floor((points[:, :2] - lower) / OBSTACLE_CELL).astype(np.int64)
        np.add.at(counts, (cells[:, 0], cells[:, 1]), 1)
    occupied = counts >= MIN_GAUSSIANS
    _clear_driven(occupied, lower, path)
    cells = np.floor((points[:, :2] - lower) / OBSTACLE_CELL).astype(np.int64)
    return OccupiedCells(lower, occupied, points[occupied[cells[:, 0], cells[:, 1]]])


def _clear_driven(occupied: NDArray[np.bool_], lower: Float, path: EgoPath) -> None:
    # The corridor extends from the rear bumper at the start to the front bumper at the end.
    length = float(path.s[-1])
    at = np.arange(-1.0, length + 4.0, OBSTACLE_CELL)
    x = np.interp(at, path.s, path.positions[:, 0])
    y = np.interp(at, path.s, path.positions[:, 1])
    yaw = np.interp(at, path.s, path.yaws)
    beyond = at - np.clip(at, 0.0, length)
    x, y = x + beyond * np.cos(yaw), y + beyond * np.sin(yaw)
    for side in np.arange(
        -DRIVEN_HALF_WIDTH, DRIVEN_HALF_WIDTH + OBSTACLE_CELL / 2, OBSTACLE_CELL / 2
    ):
        points = np.stack([x - side * np.sin(yaw), y + side * np.cos(yaw)], axis=1)
        cells = np.floor((points - lower) / OBSTACLE_CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < occupied.shape)).all(axis=1)
        occupied[cells[inside, 0], cells[inside, 1]] = False
