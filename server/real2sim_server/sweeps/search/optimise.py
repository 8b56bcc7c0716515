"""The search itself: spread points, then CMA-ES where they were most critical, then variations of
what was found.

Everything random is drawn from the seed, so that the same search finds the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...console import CommandError
from ..sampling import spread
from .archive import Archive
from .evaluation import Evaluation, Evaluator

Point = NDArray[np.float64]
Report = Callable[[int, int], None]

POPULATION = 8
STEP = 0.25
"""Standard deviation that CMA-ES begins with, of a range."""
STALE = 6
"""Generations without anything better after which it begins elsewhere."""
SHARE_OF_START = 0.12
"""Of the episodes, for the spread points."""
ISO, LINE = 0.05, 0.3
"""Of a variation: isotropic, and along the line to another (Vassiliades and Mouret 2018)."""


@dataclass(frozen=True)
class SearchBudget:
    """How much is driven.

    Attributes:
        episodes: of the tested planner, in all.
        seed: of points.
        stop_at_first: end with the first avoidable failure.
    """

    episodes: int = 300
    seed: int = 0
    stop_at_first: bool = False


@dataclass
class SearchState:
    """What a search has seen.

    Attributes:
        evaluations: all, in their order.
        archive: of failures.
    """

    evaluations: list[Evaluation] = field(default_factory=list)
    archive: Archive = field(default_factory=Archive)

    def add(self, found: Evaluation) -> bool:
        """Keep an evaluation; whether the archive gained."""
        self.evaluations.append(found)
        return self.archive.add(found, len(self.evaluations))


def search(
    evaluate: Evaluator, budget: SearchBudget, *, on_progress: Report = lambda _d, _t: None
) -> SearchState:
    """Look for avoidable failures.

    Raises:
        CommandError: the package cmaes is not installed.
    """
    state, rng = SearchState(), np.random.default_rng(budget.seed)
    for point in _points(evaluate, state, budget, rng):
        state.add(evaluate(*point))
        on_progress(len(state.evaluations), budget.episodes)
        if len(state.evaluations) >= budget.episodes:
            break
        if budget.stop_at_first and state.archive.first is not None:
            break
    return state


def random_search(
    evaluate: Evaluator, budget: SearchBudget, *, on_progress: Report = lambda _d, _t: None
) -> SearchState:
    """The same budget spent on independent points, spaces by turns: what a search is held to."""
    state, rng = SearchState(), np.random.default_rng(budget.seed)
    for k in range(budget.episodes):
        space = k % len(evaluate.spaces)
        state.add(evaluate(space, rng.random(evaluate.dimensions(space))))
        on_progress(k + 1, budget.episodes)
        if budget.stop_at_first and state.archive.first is not None:
            break
    return state


def _points(
    evaluate: Evaluator, state: SearchState, budget: SearchBudget, rng: np.random.Generator
) -> Iterator[tuple[int, Point]]:
    """Points to drive next, each asked for once the one before is in the state."""
    yield from _start(evaluate, budget)
    while True:
        yield from _descend(evaluate, state, rng)
        if state.archive.elites:
            yield from _variations(evaluate, state, rng)


def _start(evaluate: Evaluator, budget: SearchBudget) -> Iterator[tuple[int, Point]]:
    """Spread points of every space, spaces by turns."""
    spaces = len(evaluate.spaces)
    each = max(round(SHARE_OF_START * budget.episodes / spaces), 4)
    clouds = [
        spread("sobol", each, evaluate.dimensions(k), seed=budget.seed) for k in range(spaces)
    ]
    for row in range(each):
        for k, cloud in enumerate(clouds):
            yield k, cloud[row]


def _descend(
    evaluate: Evaluator, state: SearchState, rng: np.random.Generator
) -> Iterator[tuple[int, Point]]:
    """CMA-ES from a point that was critical and is no failure known already, until it finds nothing
    better, or a failure in a new cell."""
    begin = _begin(evaluate, state, rng)
    optimiser = _cma(begin, seed=int(rng.integers(2**31)))
    best, stale = -np.inf, 0
    while stale < STALE and not optimiser.should_stop():
        told: list[tuple[Point, float]] = []
        gained = False
        for _ in range(optimiser.population_size):
            before = len(state.archive.elites)
            point = optimiser.ask()
            yield begin.space, point
            told.append((point, -state.evaluations[-1].score))
            gained = gained or len(state.archive.elites) > before
        optimiser.tell(told)
        top = max(-value for _, value in told)
        stale = 0 if top > best + 1e-3 else stale + 1
        best = max(best, top)
        if gained:
            return


def _begin(evaluate: Evaluator, state: SearchState, rng: np.random.Generator) -> Evaluation:
    """One of the most critical points, more likely the more critical, without failures: they are
    varied elsewhere. Spaces take turns where several are searched."""
    alive = [e for e in state.evaluations if not e.is_failure] or state.evaluations
    if len(evaluate.spaces) > 1:
        turn = int(rng.integers(len(evaluate.spaces)))
        alive = [e for e in alive if e.space == turn] or alive
    ranked = sorted(alive, key=lambda e: -e.score)
    found = {e.space for e in state.archive.elites.values()}
    if not found:
        return ranked[min(int(rng.exponential(1.0)), len(ranked) - 1)]
    return ranked[min(int(rng.exponential(3.0)), len(ranked) - 1)]


def _cma(begin: Evaluation, *, seed: int) -> Any:
    try:
        from cmaes import CMA
    except ImportError as error:
        raise CommandError(
            f"a search needs the search extra: pip install 'real2sim[search]' ({error})"
        ) from error
    dimensions = len(begin.point)
    return CMA(
        mean=np.clip(np.array(begin.point), 0.05, 0.95),
        sigma=STEP,
        bounds=np.array([[0.0, 1.0]] * dimensions),
        population_size=POPULATION,
        seed=seed,
    )


def _variations(
    evaluate: Evaluator, state: SearchState, rng: np.random.Generator
) -> Iterator[tuple[int, Point]]:
    """As many as a generation, each of a failure, towards another of its space."""
    for _ in range(2 * POPULATION):
        elites = _by_space(state.archive.ordered())
        space = list(elites)[int(rng.integers(len(elites)))]
        own = elites[space]
        one = np.array(own[int(rng.integers(len(own)))].point)
        other = np.array(own[int(rng.integers(len(own)))].point)
        step = ISO * rng.standard_normal(len(one)) + LINE * rng.standard_normal() * (other - one)
        if len(own) == 1:
            step *= 3.0
        yield space, np.clip(one + step, 0.0, 1.0)


def _by_space(elites: Sequence[Evaluation]) -> dict[int, list[Evaluation]]:
    found: dict[int, list[Evaluation]] = {}
    for elite in elites:
        found.setdefault(elite.space, []).append(elite)
    return found
