"""Gaussians from points: shapes, ground points, and colours that no camera observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, matrix_to_quaternion
from ...scene import Ground
from ...scene.ground_fit import GroundFit, cell_means, pull_push

# Surfels: flat along the local surface, large enough to close its gaps.

NEIGHBOURS = 20
CHUNK = 50_000
"""Number of points fitted at a time. Limits the memory."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Flat Gaussians.

    Attributes:
        points: [N, 3] float32 [m].
        axes: [N, 3, 3] float32 rotations; columns are the two tangents and the normal.
        scales: [N, 3] float32, standard deviations along these axes [m].
    """

    points: NDArray[np.float32]
    axes: NDArray[np.float32]
    scales: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def normals(self) -> NDArray[np.float32]:
        """[N, 3] float32, unit, of either sign."""
        return self.axes[:, :, 2]

    @property
    def quats(self) -> NDArray[np.float32]:
        """[N, 4] float32, wxyz."""
        return matrix_to_quaternion(self.axes).astype(np.float32)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> Surfels:
        """The surfels selected by a mask or by indices."""
        return Surfels(self.points[index], self.axes[index], self.scales[index])

    @classmethod
    def join(cls, parts: list[Surfels]) -> Surfels:
        """All surfels of ``parts``, in order."""
        return cls(
            np.concatenate([p.points for p in parts]),
            np.concatenate([p.axes for p in parts]),
            np.concatenate([p.scales for p in parts]),
        )


def fit_surfels(
    points: NDArray[np.float32],
    *,
    largest: NDArray[np.float32] | float,
    smallest: float = 0.008,
) -> Surfels:
    """Orient and size a Gaussian on each point by its nearest neighbours.

    Normals are the axes of least variance. Along each tangent the scale follows the distance to the
    neighbours on either side, so that gaps between scan lines close without blurring along them.
    Where neighbours vary in all directions (leaves), the Gaussian becomes round.

    Args:
        points: [N, 3] float32 [m].
        largest: upper bound of the tangent scales [m], one or [N].
        smallest: lower bound of the normal scale [m]; tangent scales are at least twice that.
    """
    n = len(points)
    bound = np.broadcast_to(np.asarray(largest, dtype=np.float32), (n,))
    if n < 4:
        return _round_surfels(points, bound)
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    axes = np.empty((n, 3, 3), dtype=np.float32)
    scales = np.empty((n, 3), dtype=np.float32)
    count = min(NEIGHBOURS + 1, n)
    for start in range(0, n, CHUNK):
        part = slice(start, min(start + CHUNK, n))
        _, index = tree.query(points[part], k=count, workers=-1)
        offsets = points[index[:, 1:]].astype(np.float64) - points[part, None]
        axes[part], scales[part] = _fit_chunk(offsets, bound[part], smallest)
    return Surfels(points, axes, scales)


def round_surfels(
    points: NDArray[np.float32], distance: NDArray[np.float32], *, spread: float = 0.012
) -> Surfels:
    """Round Gaussians on sparse points without a common surface.

    Args:
        points: [N, 3] float32 [m].
        distance: [N] float32, from the viewpoint [m].
        spread: upper bound of the scale, as a fraction of that distance.
    """
    largest = np.maximum(spread * distance, 0.02).astype(np.float32)
    if len(points) > 3:
        from scipy.spatial import cKDTree

        near, _ = cKDTree(points).query(points, k=4, workers=-1)
        largest = np.minimum(largest, np.maximum(0.5 * near[:, 1:].mean(1), 0.02)).astype(
            np.float32
        )
    return _round_surfels(points, largest)


def _round_surfels(points: NDArray[np.float32], bound: NDArray[np.float32]) -> Surfels:
    axes = np.broadcast_to(np.eye(3, dtype=np.float32), (len(points), 3, 3)).copy()
    return Surfels(points, axes, np.repeat(bound[:, None], 3, axis=1).astype(np.float32))


def _fit_chunk(
    offsets: Float, bound: NDArray[np.float32], smallest: float
) -> tuple[Float, NDArray[np.float32]]:
    """Axes [N, 3, 3] and scales [N, 3] from neighbour ``offsets`` [N, K, 3]."""
    centred = offsets - offsets.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", centred, centred) / offsets.shape[1]
    variances, vectors = np.linalg.eigh(covariance)
    axes = vectors[:, :, ::-1].copy()
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    local = np.einsum("nki,nij->nkj", offsets, axes)
    tangent = np.stack([_gap(local, 0), _gap(local, 1)], axis=1)
    # Three neighbouring Gaussians then reach an opacity above 90 % in the middle of a gap.
    tangent = np.clip(0.6 * tangent, 2 * smallest, bound[:, None])
    thickness = np.sqrt(np.maximum(variances[:, 0], 0) / np.maximum(variances[:, 2], 1e-12))
    normal = tangent.mean(axis=1) * np.clip(thickness, 0.12, 0.8)
    scales = np.concatenate([tangent, np.maximum(normal, smallest)[:, None]], axis=1)
    return axes, scales.astype(np.float32)


def _gap(local: Float, axis: int) -> Float:
    """Mean distance [N] to the next neighbours ahead and behind along a tangent axis."""
    along, across = local[:, :, axis], local[:, :, 1 - axis]
    length = np.linalg.norm(local, axis=2)
    in_sector = np.abs(along) >= np.abs(across)
    ahead = np.where(in_sector & (along > 0), length, np.inf).min(axis=1)
    behind = np.where(in_sector & (along < 0), length, np.inf).min(axis=1)
    # At the rim of a surface one side is empty, so only the other side counts.
    ahead, behind = np.minimum(ahead, 1.5 * behind), np.minimum(behind, 1.5 * ahead)
    mean = (ahead + behind) / 2
    nearest = length[:, : min(4, length.shape[1])].mean(axis=1)
    return np.asarray(np.where(np.isfinite(mean), mean, nearest))


# Ground points on roads and pavements.
#
# LiDAR rings leave gaps on the road, and the LiDAR never measures the ground under a parked car.
# The fitted ground closes both, so the road stays complete when an edit removes the car.


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points spread evenly over the ground.

    Attributes:
        points: [N, 3] float32, world [m].
        normals: [N, 3] float32, unit, upwards.
        spacing: [N] float32, distance to the next point [m].
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    spacing: NDArray[np.float32]


def spread_ground(fit: GroundFit, spacing: float, limit: int) -> GroundPoints:
    """Cover the ground with a square grid that coarsens with the distance from the drive.

    Args:
        fit: fit of the ground; points are on its measured surface.
        spacing: distance between points near the drive [m].
        limit: maximum number of points; the grid coarsens to stay below it.
    """
    while True:
        parts = [
            _grid_ring(fit, spacing * factor, inner, outer)
            for factor, inner, outer in ((1, 0, 12), (2, 12, 24), (4, 24, 45), (8, 45, 1e9))
        ]
        if sum(len(p) for p in parts) <= limit:
            break
        spacing *= 1.15
    xy = np.concatenate(parts)
    step = np.concatenate(
        [np.full(len(p), spacing * f) for p, f in zip(parts, (1, 2, 4, 8), strict=True)]
    )
    z = fit.surface.height_at(xy)
    return GroundPoints(
        np.concatenate([xy, z[:, None]], axis=1).astype(np.float32),
        _surface_normals(fit.surface, xy),
        step.astype(np.float32),
    )


def _grid_ring(fit: GroundFit, step: float, inner: float, outer: float) -> Float:
    """Grid points [N, 2] on ground cells between two distances from the drive."""
    surface = fit.surface
    wanted = surface.is_ground & (fit.distance >= inner) & (fit.distance < outer)
    rows, columns = np.nonzero(wanted)
    if len(rows) == 0:
        return np.zeros((0, 2))
    corner = surface.origin + np.stack([rows, columns], axis=1) * surface.cell
    first = np.ceil(corner / step - 0.5).astype(np.int64)
    count = int(np.ceil(surface.cell / step)) + 1
    offsets = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="ij"), -1)
    xy = (first[:, None] + offsets.reshape(1, -1, 2) + 0.5) * step
    inside = ((xy >= corner[:, None]) & (xy < corner[:, None] + surface.cell)).all(axis=-1)
    return np.asarray(xy[inside])


def _surface_normals(surface: Ground, xy: Float) -> NDArray[np.float32]:
    step = surface.cell
    x_step, y_step = np.array([step, 0.0]), np.array([0.0, step])
    along_x = surface.height_at(xy + x_step) - surface.height_at(xy - x_step)
    along_y = surface.height_at(xy + y_step) - surface.height_at(xy - y_step)
    normals = np.stack([-along_x, -along_y, np.full(len(xy), 2 * step)], axis=1)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(unit, dtype=np.float32)


# --- Inpainting -----------------------------------------------------------------------------------

MIRROR_REACH = 0.15
"""Maximum distance of an observed point from the mirror image of the point it colours [m]."""
TRUST_REACH = 1.0
"""Distance over which the weight of an observed neighbour's colour falls to 1/e [m]."""
MIN_OBSERVED = 30
"""Minimum number of observed points for the colour of a body."""
COLOUR_SIGMA = 0.06
"""Standard deviation of colours that count as one."""
GREY = np.array([0.4, 0.4, 0.4], dtype=np.float32)

Colours = NDArray[np.float32]
Known = NDArray[np.bool_]


class ColourPrior:
    """Prior for the colour of a point, given its height and LiDAR intensity.

    Holds the mean colours of the log's seen points by height and intensity class.
    """

    def __init__(
        self,
        heights: NDArray[np.float32],
        intensity: NDArray[np.float32],
        colours: Colours,
        known: Known,
        edges: tuple[float, ...],
    ) -> None:
        self._edges = np.array(edges)
        seen = intensity[known]
        self._quantiles = (
            np.quantile(seen, [0.2, 0.4, 0.6, 0.8]) if len(seen) else np.linspace(0.2, 0.8, 4)
        )
        mean = colours[known].mean(axis=0) if len(seen) else GREY
        shape = (len(edges) + 1, len(self._quantiles) + 1)
        self._table = np.empty((*shape, 3), dtype=np.float32)
        rows, columns = self._classes(heights[known], seen)
        for row in range(shape[0]):
            for column in range(shape[1]):
                members = colours[known][(rows == row) & (columns == column)]
                # A few extra samples of the overall mean regularise small classes.
                total = members.sum(axis=0, dtype=np.float64) + 20 * mean
                self._table[row, column] = total / (len(members) + 20)

    def colour(self, heights: NDArray[np.float32], intensity: NDArray[np.float32]) -> Colours:
        """Likely colours [N, 3] of points with ``heights`` [N] [m] and ``intensity`` [N]."""
        rows, columns = self._classes(heights, intensity)
        return self._table[rows, columns]

    def _classes(
        self, heights: NDArray[np.float32], intensity: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return np.searchsorted(self._edges, heights), np.searchsorted(self._quantiles, intensity)


def fill_from_neighbours(
    points: NDArray[np.float32],
    colours: Colours,
    known: Known,
    prior: Colours,
    *,
    trust_reach: float = TRUST_REACH,
) -> Colours:
    """Colour unobserved points from observed points nearby, otherwise from ``prior`` [N, 3].

    The weight of neighbours' colours falls to 1/e over ``trust_reach`` [m].
    """
    from scipy.spatial import cKDTree

    if known.all():
        return colours
    filled = np.where(known[:, None], colours, prior)
    if known.any():
        count = min(6, int(known.sum()))
        tree = cKDTree(points[known])
        distance, index = tree.query(points[~known], k=[*range(1, count + 1)], workers=-1)
        weight = 1 / (distance + 0.05)
        near = (colours[known][index] * weight[..., None]).sum(axis=1) / weight.sum(1)[:, None]
        trust = np.exp(-distance[:, :1] / trust_reach)
        filled[~known] = trust * near + (1 - trust) * prior[~known]
    return filled.astype(np.float32)


def body_color(
    heights: NDArray[np.float32],
    colours: Colours,
    known: Known,
    prior: Colours,
    edges: tuple[float, ...],
) -> Colours:
    """The most common colour of an object's seen points at about the same height.

    The mode represents the paint better than the mean, because it ignores lamps, plates and
    reflections.

    Args:
        heights: [N] as a fraction of the object's height, 0 at its middle.
        colours: [N, 3] where ``known`` [N].
        prior: [N, 3], used if too few points were observed.
        edges: limits of the bands of height.
    """
    if known.sum() < MIN_OBSERVED:
        return prior
    bands = np.searchsorted(edges, heights)
    filled = np.broadcast_to(modal_colour(colours[known]), colours.shape).copy()
    for band in range(len(edges) + 1):
        seen = known & (bands == band)
        if seen.sum() >= MIN_OBSERVED:
            filled[bands == band] = modal_colour(colours[seen])
    return filled


def modal_colour(colours: Colours) -> Colours:
    """The mode [3] of ``colours`` [N, 3]."""
    few = colours[:: -(-len(colours) // 400)]
    distance = np.linalg.norm(few[:, None] - few[None], axis=2)
    votes = np.exp(-0.5 * (distance / COLOUR_SIGMA) ** 2)
    winner = votes[votes.sum(axis=1).argmax()]
    return np.asarray((few * winner[:, None]).sum(axis=0) / winner.sum(), dtype=np.float32)


def fill_from_mirror(
    points: NDArray[np.float32], colours: Colours, known: Known
) -> tuple[Colours, Known]:
    """Colour unobserved points of an object from its other side, across y = 0.

    Vehicles are symmetric, so the observed side is the best prior for the other one.
    """
    from scipy.spatial import cKDTree

    if known.all() or not known.any():
        return colours, known
    mirrored = points[~known] * np.array([1, -1, 1], dtype=np.float32)
    distance, index = cKDTree(points[known]).query(mirrored, workers=-1)
    near = distance < MIRROR_REACH
    colours, now_known = colours.copy(), known.copy()
    unobserved = np.flatnonzero(~known)[near]
    colours[unobserved] = colours[known][index[near]]
    now_known[unobserved] = True
    return colours, now_known


def fill_ground(
    surface: Ground, points: NDArray[np.float32], colours: Colours, known: Known
) -> Colours:
    """Colour unobserved ground points from the ground around them, smoother towards the middle."""
    if known.all() or not known.any():
        return np.where(known[:, None], colours, GREY)
    shape = surface.heights.shape
    cell = np.floor((points[:, :2] - surface.origin) / surface.cell).astype(np.int64)
    rows, columns = np.clip(cell, 0, np.array(shape) - 1).T
    flat = np.asarray(np.ravel_multi_index((rows, columns), shape))
    mean, counts = cell_means(colours[known], flat[known], (shape[0], shape[1]))
    weights = np.minimum(counts / 2, 1).astype(np.float32)
    raster = pull_push(mean.astype(np.float32), weights)
    return np.where(known[:, None], colours, raster.reshape(-1, 3)[flat])
