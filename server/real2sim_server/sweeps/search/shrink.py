"""How far a failure is from safe: each parameter moved alone, to where the episode goes well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..parameters import Value, drawn_parameters, values_at
from .evaluation import Evaluation, Evaluator

HALVINGS = 5
"""A boundary is known to 1/32 of the way from the failure to the end that is safe."""


@dataclass(frozen=True)
class Boundary:
    """Where a failure ends along one parameter.

    Attributes:
        parameter: name.
        failing: the value of the failure.
        last_fail, first_pass: the two that the boundary is between.
        share: way to ``first_pass``, as a share of the range.
    """

    parameter: str
    failing: Value
    last_fail: Value
    first_pass: Value
    share: float


def boundaries(evaluate: Evaluator, failure: Evaluation) -> list[Boundary]:
    """The nearest boundary of each parameter that leads to safety alone, the nearest first.

    Both ends of a parameter are tried; where one goes well, the way to it is halved.
    """
    names = list(drawn_parameters(evaluate.spaces[failure.space].parameters))
    found = []
    for k, name in enumerate(names):
        sides = [_towards(evaluate, failure, (k, name), end) for end in (0.0, 1.0)]
        safe = [b for b in sides if b is not None]
        if safe:
            found.append(min(safe, key=lambda b: b.share))
    return sorted(found, key=lambda b: b.share)


def _towards(
    evaluate: Evaluator, failure: Evaluation, parameter: tuple[int, str], end: float
) -> Boundary | None:
    """The boundary on the way to an end; None where that fails as well."""
    k, name = parameter

    def fails(u: float) -> bool:
        return evaluate(failure.space, _moved(failure, k, u)).at_fault

    if abs(end - failure.point[k]) < 1e-6 or fails(end):
        return None
    bad, good = failure.point[k], end
    for _ in range(HALVINGS):
        middle = (bad + good) / 2
        if fails(middle):
            bad = middle
        else:
            good = middle
    parameters = evaluate.spaces[failure.space].parameters

    def value(u: float) -> Value:
        return values_at(parameters, _moved(failure, k, u))[name]

    share = abs(good - failure.point[k])
    return Boundary(name, failure.values[name], value(bad), value(good), share)


def _moved(failure: Evaluation, k: int, u: float) -> list[float]:
    point = np.array(failure.point)
    point[k] = u
    moved: list[float] = point.tolist()
    return moved
