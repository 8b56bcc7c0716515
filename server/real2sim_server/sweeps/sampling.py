"""Which points of a space are driven: a grid, or as many as wanted, spread or weighted."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from real2sim_proto.sweeps import MOST_POINTS, GridMethod, ImportanceMethod, SpreadMethod

from .parameters import Drawn

Points = NDArray[np.float64]

Method = Annotated[GridMethod | SpreadMethod | ImportanceMethod, Field(discriminator="kind")]


def points_of(
    method: GridMethod | SpreadMethod | ImportanceMethod, drawn: Mapping[str, Drawn]
) -> tuple[Points, Points]:
    """Points [N, D] with coordinates from 0 to 1, and their weights [N], 1 where all are alike.

    Raises:
        ValueError: too many points, or a parameter that is none.
    """
    if isinstance(method, GridMethod):
        points = _grid(method, drawn)
        return points, np.ones(len(points))
    if isinstance(method, ImportanceMethod):
        return _weighted(method, drawn)
    points = spread(method.kind, method.count, len(drawn), seed=method.seed)
    return points, np.ones(len(points))


def spread(kind: str, count: int, dimensions: int, *, seed: int) -> Points:
    """[count, dimensions] in [0, 1); the first of them are those of a longer sequence, but for
    Latin hypercubes."""
    from scipy.stats import qmc

    if dimensions == 0:
        return np.zeros((count, 0))
    if kind == "random":
        return np.random.default_rng(seed).random((count, dimensions))
    if kind == "sobol":
        engine = qmc.Sobol(dimensions, rng=seed)
        # A whole power of two is drawn, which is what its balance holds for.
        whole = engine.random_base2(max(math.ceil(math.log2(count)), 0))
        return np.asarray(whole[:count], np.float64)
    makers = {"latin_hypercube": qmc.LatinHypercube, "halton": qmc.Halton}
    return np.asarray(makers[kind](dimensions, rng=seed).random(count), np.float64)


def _grid(method: GridMethod, drawn: Mapping[str, Drawn]) -> Points:
    levels = method.levels
    given = levels if isinstance(levels, dict) else dict.fromkeys(drawn, levels)
    _check_names(given, drawn)
    axes = [p.levels(max(given.get(name, 5), 1)) for name, p in drawn.items()]
    if (count := math.prod(len(a) for a in axes)) > MOST_POINTS:
        raise ValueError(f"a grid of {count} points; {MOST_POINTS} are the most")
    return np.array(list(itertools.product(*axes)), np.float64).reshape(count, len(drawn))


def _weighted(method: ImportanceMethod, drawn: Mapping[str, Drawn]) -> tuple[Points, Points]:
    """In coordinates the nominal density is 1, whatever a parameter's distribution."""
    _check_names(method.towards, drawn)
    rng, names = np.random.default_rng(method.seed), list(drawn)
    points = rng.random((method.count, len(names)))
    aimed = rng.random(method.count) >= method.defensive
    density = np.ones(method.count)
    for name, bump in method.towards.items():
        k, parameter = names.index(name), drawn[name]
        centre = parameter.coordinate(bump.mean)
        width = abs(parameter.coordinate(bump.mean + bump.std) - centre)
        points[aimed, k] = _cut_normal(points[aimed, k], centre, width)
        density *= _cut_density(points[:, k], centre, width)
    weights: Points = 1.0 / (method.defensive + (1.0 - method.defensive) * density)
    return points, weights


def _cut_normal(u: Points, centre: float, width: float) -> Points:
    from scipy.special import ndtr, ndtri

    low, high = ndtr((0.0 - centre) / width), ndtr((1.0 - centre) / width)
    found: Points = np.clip(centre + width * ndtri(low + (high - low) * u), 0.0, 1.0)
    return found


def _cut_density(x: Points, centre: float, width: float) -> Points:
    from scipy.special import ndtr

    share = ndtr((1.0 - centre) / width) - ndtr((0.0 - centre) / width)
    z = (x - centre) / width
    found: Points = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * width * share)
    return found


def _check_names(given: Sequence[str] | Mapping[str, object], drawn: Mapping[str, Drawn]) -> None:
    if unknown := sorted(set(given) - set(drawn)):
        raise ValueError(f"{unknown[0]!r} is no drawn parameter; there are {', '.join(drawn)}")
