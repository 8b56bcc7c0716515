"""What a search's episodes say of a space: which parameters matter, and how often it fails."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Probability:
    """How often drawn points fail, with an interval of 95 %.

    Attributes:
        value, low, high: estimate and interval.
        how: in words.
        episodes: that it took.
    """

    value: float
    low: float
    high: float
    how: str
    episodes: int


def wilson(failures: int, episodes: int) -> Probability:
    """Of independent episodes (Wilson 1927).

    Examples:
        >>> found = wilson(0, 100)
        >>> found.low, round(found.high, 3)
        (0.0, 0.037)
    """
    p, n, z = failures / episodes, episodes, NORMAL_95
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    low = 0.0 if failures == 0 else max(middle - half, 0.0)
    high = 1.0 if failures == episodes else min(middle + half, 1.0)
    return Probability(p, low, high, "independent episodes, Wilson", episodes)


def splitting(
    score: Callable[[Array], float],
    dimensions: int,
    *,
    level: float = 0.0,
    particles: int = 50,
    seed: int = 0,
    most_episodes: int = 2000,
    moves: int = 3,
) -> Probability:
    """Adaptive multilevel splitting (Cerou and Guyader 2007): for what is too rare to be drawn.

    The lowest tenth of the particles is replaced by others that go on from there at random above
    its level, until all are above ``level``. Moves keep the uniform distribution of the space.

    Args:
        score: of a point from 0 to 1; higher is nearer to failing.
        dimensions: of points.
        level: from which on a point fails.
        particles: at least 10.
        seed: of all that is random.
        most_episodes: after which the estimate is an upper bound.
        moves: tries for each new particle.
    """
    from scipy.special import ndtr, ndtri

    rng, used = np.random.default_rng(seed), 0

    def scored(z: Array) -> float:
        nonlocal used
        used += 1
        return score(np.asarray(ndtr(z), np.float64))

    places = np.asarray(ndtri(rng.random((particles, dimensions))), np.float64)
    values = np.array([scored(z) for z in places])
    logarithm, step, lowest = 0.0, 0.5, max(particles // 10, 1)
    while used < most_episodes and (values < level).any():
        threshold = min(float(np.sort(values)[lowest - 1]), level)
        out = values <= threshold if threshold < level else values < level
        if out.all():
            break
        logarithm += math.log1p(-out.sum() / particles)
        alive = np.flatnonzero(~out)
        for k in np.flatnonzero(out):
            source = int(rng.choice(alive))
            z, value, accepted = places[source], values[source], 0
            for _ in range(moves):
                # A Crank-Nicolson step leaves the normal distribution as it is.
                tried = math.sqrt(1 - step * step) * z + step * rng.standard_normal(dimensions)
                if (found := scored(tried)) > threshold:
                    z, value, accepted = tried, found, accepted + 1
            places[k], values[k] = z, value
            step = min(max(step * (1.1 if accepted > moves / 2 else 0.95), 0.05), 0.9)
    share = float((values >= level).mean())
    estimate = math.exp(logarithm) * share
    spread = NORMAL_95 * math.sqrt(max(-logarithm, 1e-9) / particles)
    how = "adaptive multilevel splitting"
    if share == 0.0:
        bound = math.exp(logarithm)
        return Probability(0.0, 0.0, bound, f"{how}, not reached: an upper bound", used)
    low, high = estimate * math.exp(-spread), min(estimate * math.exp(spread), 1.0)
    return Probability(estimate, low, high, how, used)


def sobol_indices(
    points: Sequence[Sequence[float]],
    scores: Sequence[float],
    names: Sequence[str],
    *,
    seed: int = 0,
) -> dict[str, tuple[float, float]]:
    """First-order and total Sobol indices of a surrogate through episodes, by parameter.

    The surrogate is a smoothed thin-plate spline through what was driven; where that lies unevenly,
    as after a search, indices are of what it knows. Empty where too few were driven.
    """
    from scipy import stats
    from scipy.interpolate import RBFInterpolator

    where, values = np.array(points), np.array(scores)
    where, first = np.unique(where.round(9), axis=0, return_index=True)
    values = values[first]
    if len(where) < 4 * len(names) + 4 or np.ptp(values) < 1e-9 or not names:
        return {}
    surrogate = RBFInterpolator(where, values, smoothing=1e-2, neighbors=min(len(where), 100))
    indices = stats.sobol_indices(
        func=lambda x: surrogate(np.clip(x.T, 0.0, 1.0)).reshape(1, -1),
        n=512,
        dists=[stats.uniform()] * len(names),
        rng=np.random.default_rng(seed),
    )
    both = np.clip(
        np.stack([np.ravel(indices.first_order), np.ravel(indices.total_order)], axis=1), 0.0, 1.0
    )
    return {n: (float(f), float(t)) for n, (f, t) in zip(names, both, strict=True)}
