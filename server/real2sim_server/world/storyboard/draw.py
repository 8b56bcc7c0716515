"""Values of parameters that the seed of an episode draws from their distributions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import (
    DRAWN,
    Choice,
    Histogram,
    Normal,
    Poisson,
    Storyboard,
    Uniform,
)

from ..draws import Draws
from ..errors import WorldError

TRIES = 1000
"""Of a draw that has to fall within a range."""


def drawn_values(board: Storyboard, draws: Draws | None) -> tuple[Storyboard, Mapping[str, float]]:
    """The storyboard with drawn values of the parameters that have a stochastic distribution, and
    those that are numbers by name. Without ``draws`` as it is.

    Raises:
        WorldError: INVALID_REQUEST, a range in which nothing falls.
    """
    stochastic = {k: d for k, d in board.distributions.items() if isinstance(d, DRAWN)}
    if draws is None or not stochastic:
        return board, {}
    values = {name: _drawn(d, name, draws) for name, d in stochastic.items()}
    named = {
        f"storyboard.parameters.{k}": float(v)
        for k, v in values.items()
        if isinstance(v, int | float)
    }
    return board.model_copy(update={"parameters": {**board.parameters, **values}}), named


def _drawn(distribution: Any, name: str, draws: Draws) -> Any:
    what = f"storyboard.{name}"
    if isinstance(distribution, Uniform):
        u = draws.uniform(what)[0]
        return distribution.low + (distribution.high - distribution.low) * u
    if isinstance(distribution, Choice):
        weights = [v.weight for v in distribution.values]
        return distribution.values[_picked(weights, draws.uniform(what)[0])].value
    if isinstance(distribution, Histogram):
        u, v = draws.uniform(what, count=2)
        chosen = distribution.bins[_picked([b.weight for b in distribution.bins], u)]
        return chosen.low + (chosen.high - chosen.low) * v
    for attempt in range(TRIES):
        value = _unbounded(distribution, what, draws, attempt)
        low, high = distribution.low, distribution.high
        if (low is None or value >= low) and (high is None or value <= high):
            return value
    raise WorldError(
        ErrorCode.INVALID_REQUEST,
        f"nothing drawn for storyboard parameter {name!r} falls within its range",
        hint="widen the range of its distribution",
    )


def _unbounded(distribution: Normal | Poisson, what: str, draws: Draws, attempt: int) -> float:
    if isinstance(distribution, Normal):
        value = (
            distribution.mean + math.sqrt(distribution.variance) * (draws.normal(what, attempt)[0])
        )
        return math.exp(value) if distribution.log else value
    # By the sum of waiting times (Knuth 1969), in pieces that do not underflow.
    left, count, number = distribution.mean, 0, 0
    while True:
        u = draws.uniform(what, attempt, number)[0]
        number += 1
        left += math.log(max(1.0 - u, 1e-300))
        if left <= 0.0:
            return float(count)
        count += 1


def _picked(weights: list[float], u: float) -> int:
    left = u * sum(weights)
    for k, weight in enumerate(weights):
        if left < weight:
            return k
        left -= weight
    return len(weights) - 1
