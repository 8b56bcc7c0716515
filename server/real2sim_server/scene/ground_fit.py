"""Fitting of the ground to points, the driven path and the bottoms of boxes.

The points are a log's LiDAR or, for a scene without a log, the centres of background Gaussians. The
paper searches for the road among Gaussians: it projects boxes down onto them, selects those around
the projections, and fits their plane by RANSAC (Fischler and Bolles 1981). Real roads are not
planar, so this module fits planes section by section along the drive, and uses them as the initial
state of a height grid that follows the points from coarse to fine.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform, quaternion_to_matrix
from .cloud import GaussianCloud
from .errors import SceneError
from .ground import Ground
from .trajectory import Trajectory

# --- holes in grids ----------------------------------------------------------------------------


def pull_push(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill unknown cells smoothly from known ones (Gortler et al. 1996, "The Lumigraph").

    Args:
        values: [H, W, C] float32; ignored where the weight is 0.
        weights: [H, W] float32 in [0, 1], confidence of a cell.

    Returns:
        [H, W, C] float32: ``values`` where the weight is 1, elsewhere blended with coarser levels.
        All zeros if no cell is known.
    """
    height, width = weights.shape
    if height == 1 and width == 1:
        return np.where(weights[..., None] > 0, values, 0).astype(np.float32)
    coarse_values, coarse_weights = _halve(values, weights)
    coarse = pull_push(coarse_values, coarse_weights)
    w = weights[..., None]
    filled = np.where(w > 0, values, 0) * w + _double(coarse, height, width) * (1 - w)
    return np.asarray(filled, dtype=np.float32)


def cell_means(
    values: NDArray[Any], cells: NDArray[np.int64], shape: tuple[int, int]
) -> tuple[Float, NDArray[np.int64]]:
    """Mean values [H, W, C] and counts [H, W] in the cells of a grid; 0 in empty cells.

    Args:
        values: [N, C].
        cells: [N], flat index of the cell of each value.
        shape: (H, W).
    """
    count = shape[0] * shape[1]
    counts = np.bincount(cells, minlength=count)
    sums = np.stack([np.bincount(cells, column, count) for column in values.T], axis=-1)
    mean = sums / np.maximum(counts, 1)[:, None]
    return mean.reshape(*shape, -1), counts.reshape(shape)


def sample_cells(values: NDArray[Any], at: Float) -> Float:
    """Values [N, C] of a grid [H, W, C] at positions [N, 2] in cells, bilinear between the centres
    of cells; beyond the border, those of the border.
    """
    from scipy.ndimage import map_coordinates

    channels = np.moveaxis(values, -1, 0)
    found = [map_coordinates(c, at.T - 0.5, order=1, mode="nearest") for c in channels]
    return np.stack(found, axis=-1).astype(np.float64)


def _halve(
    values: NDArray[np.float32], weights: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    height, width = weights.shape
    padding = ((0, height % 2), (0, width % 2))
    w = np.pad(weights, padding)
    v = np.pad(np.where(weights[..., None] > 0, values, 0), (*padding, (0, 0))) * w[..., None]
    h2, w2 = w.shape[0] // 2, w.shape[1] // 2
    total = w.reshape(h2, 2, w2, 2).sum(axis=(1, 3))
    summed = v.reshape(h2, 2, w2, 2, -1).sum(axis=(1, 3))
    mean = summed / np.maximum(total, 1e-12)[..., None]
    return mean.astype(np.float32), np.minimum(total, 1).astype(np.float32)


def _double(coarse: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Bilinear enlargement to [height, width, C]."""
    rows = _linear(np.arange(height), coarse.shape[0])
    columns = _linear(np.arange(width), coarse.shape[1])
    r0, r1, fr = rows
    c0, c1, fc = columns
    wide = coarse[:, c0] * (1 - fc)[None, :, None] + coarse[:, c1] * fc[None, :, None]
    tall = wide[r0] * (1 - fr)[:, None, None] + wide[r1] * fr[:, None, None]
    return np.asarray(tall, dtype=np.float32)


def _linear(
    index: NDArray[np.int64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    place = np.clip((index + 0.5) / 2 - 0.5, 0, size - 1)
    low = np.floor(place).astype(np.int64)
    return low, np.minimum(low + 1, size - 1), (place - low).astype(np.float32)


Size = tuple[float, float, float]

REACH = 70.0
"""Extent of the ground around the drive [m]."""


class Level(NamedTuple):
    """One pass of the fit.

    Attributes:
        cell: cell size of its grid [m].
        tolerance: points within this distance of the previous level are on the ground [m].
        growth: growth of the tolerance with the distance from the drive.
        fraction: quantile of a cell's heights that is used. Objects are never below the ground,
            and the lowest point of all is noise. Coarse cells contain walls, whose feet are used.
    """

    cell: float
    tolerance: float
    growth: float
    fraction: float


LEVELS = (
    Level(4.0, 0.6, 0.03, 0.1),
    Level(1.0, 0.35, 0.0, 0.15),
    Level(0.25, 0.15, 0.0, 0.35),
)
FEW_POINTS = 5_000
"""Minimum number of ground points for the finest level."""
CONTINUED = 1e-3
"""Weight of cells without data; it preserves the surface so far within about 30 cells from data."""
CLOSING = ((25.0, 1.5), (REACH, 4.0))
"""Distance from the drive up to which gaps are closed, and half the size of these gaps [m]."""
DRIVEN = 3.0
"""The ground is known within this distance of the drive, measured or not [m]."""

FURTHEST = 1e6
"""Maximum distance of the driven path from the origin [m], as in the wire format."""
SPACING = 0.5
"""Spacing of positions along the driven path [m]."""
TRUSTED = 10.0
"""Distance to the side up to which a plane under the path is used [m]. Its border height is used
beyond."""
MANY = 50_000
MIN_UPRIGHT = 0.5
"""Minimum z of ground normals (60 degrees). The ground counts as level where they lean more."""
UNDER_WHEELS = (1.25, 2.0)
"""The ground is the plane under the path up to the first distance from it, and the surface fitted
to points beyond the second [m].
"""
FADE_WIDTH = 8.0
"""The surface fitted to points is raised or lowered to meet the path, fading up to this distance
[m].
"""
SMOOTHED = 4
"""Smoothing of this offset along the path, standard deviation in path positions."""

AROUND, UNDER = 2.5, 1.0
"""Margin around a projected box, and depth below its bottom, of the candidate points [m]."""
ON_PLANE = 0.08
"""Maximum distance of RANSAC inliers from the plane [m]."""
ROUNDS, SAMPLE = 400, 5_000
LEAN_MAX = float(np.cos(np.radians(25)))
STRETCH = 30.0
"""Length of path over which the road counts as planar [m]."""
FEW_INLIERS = 100
OFF_PATH = 0.3
"""Maximum distance of the road plane from the driven path [m]."""
EGO_BOX = (4.6, 1.85, 1.6)
"""Size of the ego's box in the search for the road below its path [m]."""


class Standing(Protocol):
    """An object on the ground: from a scene, its summary, or a track of a log."""

    @property
    def size(self) -> Size: ...  # noqa: D102
    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class GroundFit:
    """Result of a fit.

    Attributes:
        ground: ground of the scene, with the driven heights and slopes on the driven path.
        surface: ground from the points alone, on the same grid.
        distance: [X, Y] float32, of each cell from the drive [m].
    """

    ground: Ground
    surface: Ground
    distance: NDArray[np.float32]


# --- the whole fit -----------------------------------------------------------------------------


def fit_ground(points: Float, path: DrivenPath, boxes: BoxBottoms) -> GroundFit:
    """Fit the ground, coarse to fine, starting from the driven path.

    On each level, a cell gets a low quantile of its points that agree with the previous level.
    Cells without such points get the bottom of a box at that position, or the plane under the path
    if they were driven over. All others are interpolated from their neighbours. The result is
    deterministic, bit for bit.

    Args:
        points: [N, 3], background in the world [m]; if empty, only path and boxes are used.
        path: driven by the vehicle.
        boxes: objects on the ground that hide it.
    """
    coarsest = LEVELS[0].cell
    low = np.floor((path.points[:, :2].min(axis=0) - REACH) / coarsest) * coarsest
    high = path.points[:, :2].max(axis=0) + REACH
    size = np.ceil((high - low) / coarsest).astype(int) * coarsest
    points, bottoms = (_within(p, low, size) for p in (points, boxes.points))
    fitted: _Fitted | None = None
    for level in LEVELS:
        on_ground, standing = (_on_ground(p, path, level, fitted) for p in (points, bottoms))
        if level is LEVELS[-1] and len(on_ground) < FEW_POINTS:
            break
        known = _Known(on_ground, standing, path)
        fitted = _fit_level(known, _Grid(low, size, level.cell), level, fitted)
    assert fitted is not None
    surface = _close(fitted, boxes.footprints)
    return GroundFit(_through_path(surface, fitted.distance, path), surface, fitted.distance)


def fit_scene_ground(cloud: GaussianCloud, ego: Trajectory, objects: Iterable[Standing]) -> Ground:
    """The ground of a scene without a stored one, from its Gaussians, boxes and ego path.

    Args:
        cloud: the background, world frame; on any device.
        ego: path of the recording vehicle, which moved on the ground.
        objects: objects on the ground.
    """
    points = ground_points(cloud)
    path = road_under(points, DrivenPath.of(ego))
    return fit_ground(points, path, box_bottoms(objects)).ground


def ground_points(cloud: GaussianCloud) -> Float:
    """Centres [N, 3] float64 of Gaussians that may be ground: opaque, and not flat and upright like
    walls.
    """
    means, opacities = (v.detach().cpu().numpy() for v in (cloud.means, cloud.opacities))
    scales, quats = (v.detach().cpu().numpy() for v in (cloud.scales, cloud.quats))
    solid = np.flatnonzero(opacities > OPAQUE)
    ordered = np.sort(scales[solid], axis=1)
    thin = scales[solid].argmin(axis=1)
    axes = quaternion_to_matrix(quats[solid].astype(np.float64))
    lying = np.abs(axes[np.arange(len(solid)), 2, thin]) > LYING
    chosen = solid[lying | (ordered[:, 0] > FLAT * ordered[:, 1])]
    return np.asarray(means[chosen], dtype=np.float64)


OPAQUE = 0.3
"""Minimum opacity of Gaussians used for the ground."""
FLAT, LYING = 0.5, 0.7
"""A Gaussian is flat if its shortest axis is below this fraction of the next one, and horizontal if
that axis is within 45 degrees of vertical.
"""


# --- the driven path ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """Contact path of the ego's wheels.

    Attributes:
        points: [P, 3] float64, about half a metre apart [m].
        normals: [P, 3] float64, unit, of the ground planes under the ego.
        driven: [P] float64, z of the ego itself [m]; ``points`` may be moved onto a detected road.
        leaning: [P, 3] float64, the ego's own normals.
    """

    points: Float
    normals: Float
    driven: Float
    leaning: Float

    @classmethod
    def of(cls, ego: Trajectory) -> DrivenPath:
        """The path of a trajectory ``T_world_vehicle``, whose origin moves on the ground.

        Raises:
            SceneError: it is too far from the origin for metre precision.
        """
        furthest = float(np.abs(ego.positions).max())
        if furthest > FURTHEST:
            raise SceneError(
                f"the vehicle is {furthest:.3g} m from the origin; at most {FURTHEST:g} m are "
                "allowed: move the scene to its origin, or give the right scale"
            )
        kept = _apart(ego.positions)
        positions = ego.positions[kept]
        normals = quaternion_to_matrix(ego.quaternions[kept])[:, :, 2]
        normals = np.where(normals[:, 2:] > MIN_UPRIGHT, normals, [0.0, 0.0, 1.0])
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)))
        at = np.append(np.arange(0.0, way[-1], SPACING), way[-1])
        points = np.stack([np.interp(at, way, positions[:, i]) for i in range(3)], axis=1)
        leaning = np.stack([np.interp(at, way, normals[:, i]) for i in range(3)], axis=1)
        leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
        return cls(points, leaning, points[:, 2], leaning)

    def plane(self, xy: Float, *, trusted: float = np.inf) -> tuple[Float, Float]:
        """Distance [N] [m] of ``xy`` [N, 2] from the path, and z [N] [m] on the plane under its
        nearest position. The plane is level beyond ``trusted`` metres.
        """
        distance, nearest = self.nearest(xy)
        offset = xy - self.points[nearest, :2]
        normal = self.normals[nearest]
        fraction = np.minimum(1.0, trusted / np.maximum(distance, 1e-9))
        slope = (offset * normal[:, :2]).sum(axis=1) / normal[:, 2]
        return distance, self.points[nearest, 2] - fraction * slope

    def nearest(self, xy: Float) -> tuple[Float, NDArray[np.int64]]:
        """Distance [N] [m] and index [N] of the nearest position of the path."""
        # Threads only pay off for many positions. The results are the same.
        workers = -1 if len(xy) > MANY else 1
        distance, index = self._tree.query(xy, workers=workers)
        return np.asarray(distance), np.asarray(index)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points[:, :2])


def _apart(positions: Float) -> list[int]:
    """Indices of poses at least a tenth of SPACING from the previous one, seen from above."""
    kept = [0]
    x, y = positions[0, :2].tolist()
    for i, (px, py) in enumerate(positions[:, :2].tolist()):
        if (px - x) ** 2 + (py - y) ** 2 >= (SPACING / 10) ** 2:
            kept.append(i)
            x, y = px, py
    return kept


def _through_path(surface: Ground, distance: NDArray[np.float32], path: DrivenPath) -> Ground:
    """Bend the surface so that it passes through the path.

    Recorded poses must be on the surface. To the sides, the surface keeps its shape and is raised
    or lowered to meet the path.
    """
    from scipy.ndimage import gaussian_filter1d

    near = np.flatnonzero(distance.ravel() < FADE_WIDTH + surface.cell)
    xy = surface.centres[near]
    apart, nearest = path.nearest(xy)
    rise = path.driven - surface.height_at(path.points[:, :2])
    rise = gaussian_filter1d(rise, SMOOTHED, mode="nearest")
    inner, outer = UNDER_WHEELS
    beside = surface.heights.ravel()[near] + _fade(apart, inner, FADE_WIDTH) * rise[nearest]
    normal = path.leaning[nearest]
    slope = ((xy - path.points[nearest, :2]) * normal[:, :2]).sum(axis=1) / normal[:, 2]
    under = path.driven[nearest] - slope
    heights = surface.heights.ravel().astype(np.float64)
    heights[near] = beside + _fade(apart, inner, outer) * (under - beside)
    shaped = heights.astype(np.float32).reshape(surface.heights.shape)
    return Ground(surface.origin, surface.cell, shaped, surface.is_ground)


def _fade(distance: Float, inner: float, outer: float) -> Float:
    """1 up to ``inner``, 0 from ``outer`` on, smooth in between."""
    u = np.clip((outer - distance) / (outer - inner), 0.0, 1.0)
    return np.asarray(u * u * (3 - 2 * u))


# --- the paper's road: RANSAC among the points around projected boxes ---------------------------


@dataclass(frozen=True, eq=False)
class RoadPlane:
    """A plane fitted to points.

    Attributes:
        normal: [3] unit, upwards.
        offset: offset of its points along the normal [m].
        candidates: [K] indices of the points around the projected boxes.
        inliers: [K] bool, candidates on the plane.
        rms: distance of inliers from the plane, root mean square [m].
    """

    normal: Float
    offset: float
    candidates: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    rms: float

    def height_at(self, xy: Float) -> Float:
        """z [N] [m] of the plane at ``xy`` [N, 2]."""
        return np.asarray((self.offset - xy @ self.normal[:2]) / self.normal[2])


def find_road_plane(
    points: Float, boxes: Sequence[tuple[Float, Sequence[float]]], *, seed: int = 0
) -> RoadPlane:
    """The plane of the road under boxes.

    Args:
        points: [N, 3] of the background, world [m].
        boxes: (``T_world_box`` [4, 4], (length, width, height)) of objects on the road.
        seed: seed of RANSAC's samples; the same seed gives the same plane.

    Raises:
        SceneError: no boxes, fewer than three points around them, or no nearly level plane.
    """
    if not boxes:
        raise SceneError("no boxes to look for ground under; give at least one")
    candidates = np.flatnonzero(_around(points, boxes))
    if len(candidates) < 3:
        raise SceneError(
            f"{len(candidates)} of {len(points)} points are around the {len(boxes)} boxes; "
            "at least 3 are needed to find the ground"
        )
    normal, offset, inliers = _ransac(points[candidates], seed)
    distance = points[candidates[inliers]] @ normal - offset
    rms = float(np.sqrt((distance**2).mean()))
    return RoadPlane(normal, offset, candidates, inliers, rms)


def road_under(points: Float, path: DrivenPath) -> DrivenPath:
    """The path with the road planes that RANSAC finds below it, section by section. Sections
    without a plane near the path keep the plane of the ego.
    """
    moved, normals = path.points.copy(), path.normals.copy()
    places = max(round(STRETCH / SPACING), 1)
    step = max(round(EGO_BOX[0] / 2 / SPACING), 1)
    reach = EGO_BOX[0] + AROUND
    for first in range(0, len(moved), places):
        rows = slice(first, min(first + places, len(moved)))
        low, high = moved[rows, :2].min(axis=0) - reach, moved[rows, :2].max(axis=0) + reach
        beside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
        boxes = [(_ego_box(path, k), EGO_BOX) for k in range(rows.start, rows.stop, step)]
        try:
            plane = find_road_plane(points[beside], boxes)
        except SceneError:
            continue
        heights = plane.height_at(path.points[rows, :2])
        off = np.abs(heights - path.points[rows, 2]).max()
        if int(plane.inliers.sum()) >= FEW_INLIERS and off < OFF_PATH:
            moved[rows, 2], normals[rows] = heights, plane.normal
    return DrivenPath(moved, normals, path.driven, path.leaning)


def _ego_box(path: DrivenPath, index: int) -> Float:
    """``T_world_box`` [4, 4] of a box on the path, aligned with it."""
    last = len(path.points) - 1
    ahead = path.points[min(index + 1, last)] - path.points[max(index - 1, 0)]
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = path.points[index] + [0.0, 0.0, EGO_BOX[2] / 2]
    return pose


def _around(points: Float, boxes: Sequence[tuple[Float, Sequence[float]]]) -> NDArray[np.bool_]:
    """Points near the boxes' projections and below the boxes' middles."""
    near = np.zeros(len(points), dtype=np.bool_)
    for pose, size in boxes:
        half = np.asarray(size, dtype=np.float64) / 2
        reach = float(np.hypot(half[0], half[1])) + AROUND
        close = np.flatnonzero((np.abs(points[:, :2] - pose[:2, 3]) < reach).all(axis=1))
        forward = pose[:2, 0] / max(float(np.linalg.norm(pose[:2, 0])), 1e-9)
        offset = points[close, :2] - pose[:2, 3]
        along = np.abs(offset @ forward)
        across = np.abs(offset @ np.array([-forward[1], forward[0]]))
        height = points[close, 2] - (pose[2, 3] - half[2])
        inside = (along < half[0] + AROUND) & (across < half[1] + AROUND)
        near[close[inside & (height > -UNDER) & (height < half[2])]] = True
    return near


def _ransac(points: Float, seed: int) -> tuple[Float, float, NDArray[np.bool_]]:
    """Unit normal [3] and offset of the plane with most inliers, refitted to them."""
    draw = np.random.default_rng(seed)
    sample = points if len(points) <= SAMPLE else points[draw.permutation(len(points))[:SAMPLE]]
    best, most = None, -1
    for _ in range(ROUNDS):
        a, b, c = sample[draw.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs(normal[2]) < LEAN_MAX * length:
            continue
        normal *= np.sign(normal[2]) / length
        count = int((np.abs((sample - a) @ normal) < ON_PLANE).sum())
        if count > most:
            best, most = (normal, float(normal @ a)), count
    if best is None:
        raise SceneError("no plane near level among the points around the boxes")
    normal, offset = best
    for _ in range(3):
        own = points[np.abs(points @ normal - offset) < ON_PLANE]
        if len(own) < 3:
            break
        centre = own.mean(axis=0)
        normal = np.linalg.svd(own - centre, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[2])
        offset = float(normal @ centre)
    return normal, offset, np.abs(points @ normal - offset) < ON_PLANE


# --- levels of the grid ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Grid:
    low: Float
    size: Float
    cell: float

    @property
    def shape(self) -> tuple[int, int]:
        x, y = np.round(self.size / self.cell).astype(int)
        return int(x), int(y)

    @property
    def centres(self) -> Float:
        cells = np.indices(self.shape).reshape(2, -1).T.astype(np.float64)
        return (cells + 0.5) * self.cell + self.low

    def cells(self, xy: Float) -> NDArray[np.int64]:
        index = np.floor((xy - self.low) / self.cell).astype(np.int64)
        return index[:, 0] * self.shape[1] + index[:, 1]


@dataclass(frozen=True, eq=False)
class _Fitted:
    ground: Ground
    distance: NDArray[np.float32]


def _within(points: Float, low: Float, size: Float) -> Float:
    inside = ((points[:, :2] >= low) & (points[:, :2] < low + size)).all(axis=1)
    return points[inside].astype(np.float64)


def _on_ground(points: Float, path: DrivenPath, level: Level, coarser: _Fitted | None) -> Float:
    """Points near the surface of the previous level, or near the plane under the path."""
    if coarser is not None:
        expected = coarser.ground.height_at(points[:, :2])
        return points[np.abs(points[:, 2] - expected) < level.tolerance]
    distance, expected = path.plane(points[:, :2])
    return points[np.abs(points[:, 2] - expected) < level.tolerance + level.growth * distance]


@dataclass(frozen=True, eq=False)
class _Known:
    """Data of one level: consistent points and bottoms of boxes, and the path."""

    points: Float
    bottoms: Float
    path: DrivenPath


def _fit_level(known: _Known, grid: _Grid, level: Level, coarser: _Fitted | None) -> _Fitted:
    """Fit one level: data where cells are known, interpolation elsewhere."""
    centres = grid.centres
    distance, below = known.path.plane(centres, trusted=TRUSTED)
    base = below if coarser is None else coarser.ground.height_at(centres)
    heights, weights = base.copy(), np.full(len(base), CONTINUED)
    driven = distance < UNDER_WHEELS[0]
    heights[driven], weights[driven] = below[driven], 1.0
    under, bottom, _ = _by_cell(known.bottoms, grid, 0.5)
    heights[under], weights[under] = bottom, 1.0
    cells, measured_heights, counts = _by_cell(known.points, grid, level.fraction)
    heights[cells], weights[cells] = measured_heights, np.minimum(counts / 3, 1)
    # Only the difference to the previous level is interpolated, so the ground keeps its shape
    # there.
    change = (heights - base).astype(np.float32).reshape(*grid.shape, 1)
    spread = pull_push(change, weights.astype(np.float32).reshape(grid.shape))[..., 0]
    measured = np.zeros(len(heights), dtype=np.bool_)
    measured[cells] = True
    filled = (base.reshape(grid.shape) + spread).astype(np.float32)
    ground = Ground(grid.low, grid.cell, filled, measured.reshape(grid.shape))
    return _Fitted(ground, distance.astype(np.float32).reshape(grid.shape))


def _by_cell(points: Float, grid: _Grid, fraction: float) -> tuple[NDArray[np.int64], Float, Float]:
    """Cells with points, the quantile ``fraction`` of their z, and their numbers of points."""
    cell = grid.cells(points[:, :2])
    order = np.lexsort((points[:, 2], cell))
    cells, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    chosen = starts + (counts * fraction).astype(np.int64)
    return cells, points[order[chosen], 2], counts.astype(np.float64)


def _close(level: _Fitted, footprints: Float) -> Ground:
    """Mark gaps between rings, areas hidden by boxes, and the area under the vehicle as ground."""
    import cv2

    surface, distance = level.ground, level.distance
    measured = surface.is_ground.astype(np.uint8)
    ground = measured.copy()
    inner = 0.0
    for reach, radius in CLOSING:
        cells = round(radius / surface.cell)
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
        closed = cv2.morphologyEx(measured, cv2.MORPH_CLOSE, disk)
        ring = (distance >= inner) & (distance < reach)
        ground |= np.where(ring, closed, 0).astype(np.uint8)
        inner = reach
    for corners in footprints:
        # fillConvexPoly takes (column, row); the grid is [x, y].
        polygon = np.round((corners - surface.origin) / surface.cell - 0.5)[:, ::-1]
        cv2.fillConvexPoly(ground, polygon.astype(np.int32), 1)
    ground[distance < DRIVEN] = 1
    whole = cv2.morphologyEx(ground, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    heights = surface.heights
    if surface.cell == LEVELS[-1].cell:
        heights = np.asarray(cv2.GaussianBlur(heights, (5, 5), 1.0), dtype=np.float32)
    return Ground(surface.origin, surface.cell, heights, whole.astype(np.bool_))


# --- boxes -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoxBottoms:
    """Ground contact areas of boxes, over all times.

    Attributes:
        points: [N, 3] float64, spread over the bottoms, world [m].
        footprints: [M, 4, 2] float64, corners of the bottoms, enlarged [m].
    """

    points: Float
    footprints: Float


def box_bottoms(
    standing: Iterable[Standing],
    times_us: NDArray[np.int64] | None = None,
    *,
    margin: float = 0.4,
) -> BoxBottoms:
    """Bottoms of boxes at those of the given times at which they exist.

    Without times, the poses of the tracks are used, at most ``POSES`` evenly spread ones per track.
    """
    points, footprints = [np.zeros((0, 3))], [np.zeros((0, 4, 2))]
    for thing in standing:
        grid, corners = _bottom_grid(thing.size), _bottom_corners(thing.size, margin)
        for pose in _poses(thing.trajectory, times_us):
            points.append(apply_transform(pose, grid))
            footprints.append(apply_transform(pose, corners)[None, :, :2])
    return BoxBottoms(np.concatenate(points), np.concatenate(footprints))


POSES = 60


def _poses(track: Trajectory, times_us: NDArray[np.int64] | None) -> list[Float]:
    own = track.times_us[:: -(-len(track.times_us) // POSES)]
    chosen = own if times_us is None else times_us
    return [track.transform(t) for t in chosen.tolist() if track.covers(t)]


def _bottom_corners(size: Size, margin: float) -> Float:
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    corners = np.zeros((4, 3))
    corners[:, :2] = signs * (np.array(size[:2]) / 2 + margin)
    return corners


def _bottom_grid(size: Size) -> Float:
    step = LEVELS[-1].cell
    x, y = (np.arange(-s / 2 + step / 2, s / 2, step) for s in size[:2])
    grid = np.stack([g.ravel() for g in np.meshgrid(x, y, indexing="ij")], axis=1)
    return np.concatenate([grid, np.full((len(grid), 1), -size[2] / 2)], axis=1)
