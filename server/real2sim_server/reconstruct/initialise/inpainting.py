"""Inpainting: colours of Gaussians that no camera observed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene import Ground
from ...scene.ground_fit import pull_push

MIRROR_REACH = 0.15
"""An unobserved point takes the colour of a point observed this near to its mirror image [m]."""
TRUST_REACH = 1.0
"""Distance over which the weight of an observed neighbour's colour falls to 1/e [m]."""
MIN_OBSERVED = 30
"""Fewer observed points than this say nothing about the colour of a body."""
COLOUR_SIGMA = 0.06
"""Standard deviation of colours that count as one."""
GREY = np.array([0.4, 0.4, 0.4], dtype=np.float32)

Colours = NDArray[np.float32]
Known = NDArray[np.bool_]


class ColourPrior:
    """What colour a point is likely to have, by its height and its LiDAR intensity.

    Learnt from the seen points of the same log: mean colours by height and intensity class.
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
                # A few members more of the overall mean keep small classes from being odd.
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
    """Colour unobserved points from seen ones nearby, and from ``prior`` [N, 3] where none is near.

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
    """The commonest colour of an object's seen points at about the same height.

    Lamps, plates and reflections are no guide to the rest of a body, its paint is: hence the mode
    and not the mean.

    Args:
        heights: [N] as a fraction of the object's height, 0 at its middle.
        colours: [N, 3] where ``known`` [N].
        prior: [N, 3] for bands of height of which too little was seen.
        edges: where bands end.
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
    """The colour [3] around which most of ``colours`` [N, 3] lie."""
    few = colours[:: -(-len(colours) // 400)]
    distance = np.linalg.norm(few[:, None] - few[None], axis=2)
    votes = np.exp(-0.5 * (distance / COLOUR_SIGMA) ** 2)
    winner = votes[votes.sum(axis=1).argmax()]
    return np.asarray((few * winner[:, None]).sum(axis=0) / winner.sum(), dtype=np.float32)


def fill_from_mirror(
    points: NDArray[np.float32], colours: Colours, known: Known
) -> tuple[Colours, Known]:
    """Colour unobserved points of an object from its other side, across y = 0.

    Vehicles look alike from the left and the right: the observed side is the best prior for the
    other one.
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
    """Colour unobserved ground points from the observed ground around, ever smoother inwards."""
    if known.all() or not known.any():
        return np.where(known[:, None], colours, GREY)
    shape = surface.heights.shape
    cell = np.floor((points[:, :2] - surface.origin) / surface.cell).astype(np.int64)
    rows, columns = np.clip(cell, 0, np.array(shape) - 1).T
    flat = np.asarray(np.ravel_multi_index((rows, columns), shape))
    counts = np.bincount(flat[known], minlength=shape[0] * shape[1])
    sums = np.stack(
        [np.bincount(flat[known], colours[known, c], shape[0] * shape[1]) for c in range(3)], -1
    )
    mean = (sums / np.maximum(counts, 1)[:, None]).astype(np.float32).reshape(*shape, 3)
    weights = np.minimum(counts / 2, 1).astype(np.float32).reshape(shape)
    raster = pull_push(mean, weights)
    return np.where(known[:, None], colours, raster.reshape(-1, 3)[flat])
