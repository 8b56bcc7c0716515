"""The search itself: spread points, then those that a surrogate expects to be more critical; once
something is found, CMA-ES and variations of it for other kinds.

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
from .gaussian_process import GaussianProcess

Point = NDArray[np.float64]
Report = Callable[[int, int], None]

POPULATION = 8
STEP = 0.25
"""Standard deviation that CMA-ES begins with, of a range."""
STALE = 3
"""Generations without anything better after which it begins elsewhere."""
START, LEAST_START = 8, 4
"""Spread points in all, and of each space."""
BATCH = 8
"""Points by the surrogate before spaces are weighed again."""
OPTIMISM = (2.0, 0.5, 1.0)
"""Standard deviations that are added to what the surrogate expects, by turns."""
REFIT = 4
"""Points after which the surrogate's length scales are fitted anew."""
MOST_SEEN = 160
"""Points that it goes through: the most critical ones, and the latest."""
UNIFORM, NEAR, AROUND = 600, 60, 6
"""Places that are looked at: anywhere, and around each of so many of the most critical points."""
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
    spent = np.zeros((len(evaluate.spaces), 2))
    while True:
        space = _space(spent, rng)
        before = len(state.archive.elites), len(state.evaluations)
        mine = any(e.space == space for e in state.archive.elites.values())
        if not mine or rng.random() < 0.25:
            yield from _guided(evaluate, state, rng, space)
        elif rng.random() < 0.5:
            yield from _descend(state, rng, space)
        else:
            yield from _variations(state, rng, space)
        gained, driven = len(state.archive.elites), len(state.evaluations)
        spent[space] += gained - before[0], (driven - before[1]) / BATCH


def _start(evaluate: Evaluator, budget: SearchBudget) -> Iterator[tuple[int, Point]]:
    """Spread points of every space, spaces by turns."""
    spaces = len(evaluate.spaces)
    each = max(START // spaces, LEAST_START)
    clouds = [
        spread("sobol", each, evaluate.dimensions(k), seed=budget.seed) for k in range(spaces)
    ]
    for row in range(each):
        for k, cloud in enumerate(clouds):
            yield k, cloud[row]


def _space(spent: NDArray[np.float64], rng: np.random.Generator) -> int:
    """Where to go on: more likely where more kinds of failures came of what was driven (Thompson
    sampling of rates).

    Args:
        spent: [S, 2] kinds found and batches driven, of each space.
        rng: draws.
    """
    return int(np.argmax(rng.gamma(spent[:, 0] + 1.0) / (spent[:, 1] + 1.0)))


def _guided(
    evaluate: Evaluator, state: SearchState, rng: np.random.Generator, space: int
) -> Iterator[tuple[int, Point]]:
    """Points at which a Gaussian process through all episodes of a space hopes for most."""
    scales = None
    for k in range(BATCH):
        mine = _telling([e for e in state.evaluations if e.space == space])
        if len(mine) < 2:
            yield space, rng.random(evaluate.dimensions(space))
            continue
        points = np.array([e.point for e in mine])
        values = _compressed(np.array([e.score for e in mine]))
        model = GaussianProcess.fitted(points, values, scales=scales if k % REFIT else None)
        scales = model.scales
        places = _places(points[np.argsort(-values, kind="stable")[:AROUND]], rng)
        means, spreads = model.at(places)
        yield space, places[int(np.argmax(means + OPTIMISM[k % len(OPTIMISM)] * spreads))]


def _telling(seen: Sequence[Evaluation]) -> list[Evaluation]:
    """The most critical ones and the latest, in their order."""
    if len(seen) <= MOST_SEEN:
        return list(seen)
    ranked = sorted(range(len(seen)), key=lambda k: -seen[k].score)[: MOST_SEEN // 2]
    return [seen[k] for k in sorted({*ranked, *range(len(seen) - MOST_SEEN // 2, len(seen))})]


def _compressed(scores: Point) -> Point:
    """Scores so that a second near a collision is worth as much as half of the way to it."""
    found: Point = np.where(scores < 0.0, -np.log1p(np.maximum(-scores, 0.0)), scores)
    return found


def _places(best: Point, rng: np.random.Generator) -> Point:
    """[N, D] anywhere, and near the best [K, D]: moved a little, a lot, or in few coordinates."""
    dimensions = best.shape[1]
    near = np.repeat(best, NEAR, axis=0)
    step = rng.choice([0.02, 0.08, 0.25], size=(len(near), 1)) * rng.standard_normal(near.shape)
    kept = rng.random(near.shape) < rng.choice([0.0, 0.6], size=(len(near), 1))
    found = [rng.random((UNIFORM, dimensions)), np.clip(near + np.where(kept, 0.0, step), 0.0, 1.0)]
    return np.concatenate(found)


def _descend(
    state: SearchState, rng: np.random.Generator, space: int
) -> Iterator[tuple[int, Point]]:
    """CMA-ES from a point that was critical and is no failure known already, until it finds nothing
    better, or a failure in a new cell."""
    begin = _begin(state, rng, space)
    optimiser = _cma(begin, seed=int(rng.integers(2**31)))
    best, stale = -np.inf, 0
    while stale < STALE and not optimiser.should_stop():
        told: list[tuple[Point, float]] = []
        gained = False
        for _ in range(optimiser.population_size):
            before = len(state.archive.elites)
            point = optimiser.ask()
            yield space, point
            told.append((point, -state.evaluations[-1].score))
            gained = gained or len(state.archive.elites) > before
        optimiser.tell(told)
        top = max(-value for _, value in told)
        stale = 0 if top > best + 1e-3 else stale + 1
        best = max(best, top)
        if gained:
            return


def _begin(state: SearchState, rng: np.random.Generator, space: int) -> Evaluation:
    """One of the most critical points of a space, more likely the more critical, without failures:
    they are varied elsewhere."""
    mine = [e for e in state.evaluations if e.space == space]
    ranked = sorted([e for e in mine if not e.is_failure] or mine, key=lambda e: -e.score)
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
    state: SearchState, rng: np.random.Generator, space: int
) -> Iterator[tuple[int, Point]]:
    """Two generations of them, each of a failure, towards another of its space."""
    for _ in range(2 * POPULATION):
        own = [e for e in state.archive.ordered() if e.space == space]
        one = np.array(own[int(rng.integers(len(own)))].point)
        other = np.array(own[int(rng.integers(len(own)))].point)
        step = ISO * rng.standard_normal(len(one)) + LINE * rng.standard_normal() * (other - one)
        if len(own) == 1:
            step *= 3.0
        yield space, np.clip(one + step, 0.0, 1.0)
