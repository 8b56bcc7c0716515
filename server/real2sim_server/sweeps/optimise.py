"""The search: space-filling points first, then points with high expected criticality.

A surrogate predicts the criticality. After the first finding, CMA-ES and variations of the finding
search for other kinds of failures. All random numbers depend on the seed, so the search is
reproducible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..console import CommandError
from .evaluation import Cell, Evaluation, Evaluator
from .parameters import spread

# --- Archive -------------------------------------------------------------------------------------

# The worst failure of each cell (MAP-Elites, Mouret and Clune 2015).


@dataclass
class Archive:
    """Cells, each with its elite.

    Attributes:
        elites: avoidable failures with the highest score, by cell.
        first: number of the first evaluation with a failure, from 1; None without a failure.
    """

    elites: dict[Cell, Evaluation] = field(default_factory=dict)
    first: int | None = None

    def add(self, found: Evaluation, number: int) -> bool:
        """Add a failure if its cell is new or its score is higher than that of the cell's elite.

        Returns whether it was added.
        """
        if not found.is_failure or found.cell is None:
            return False
        self.first = number if self.first is None else self.first
        there = self.elites.get(found.cell)
        if there is not None and there.score >= found.score:
            return False
        self.elites[found.cell] = found
        return True

    def ordered(self) -> list[Evaluation]:
        """Elites, worst first."""
        return sorted(self.elites.values(), key=lambda e: (-e.score, e.cell or ()))


# --- Surrogate -----------------------------------------------------------------------------------

# A Gaussian process (Rasmussen and Williams 2006).

Array = NDArray[np.float64]

SHORTEST, LONGEST = 0.05, 5.0
"""Limits of length scales, as fractions of the range."""
NOISE = 1e-3
"""Unexplained variance, relative to the variance of the values: episodes change discontinuously."""


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on points.

    Attributes:
        scales: [D] length scales of the kernel (Matern 5/2).
        points: [N, D].
        factor: [N, N] Cholesky factor of their covariance.
        weights: [N].
        mean, spread: mean and spread of the values.
    """

    scales: Array
    points: Array
    factor: Array
    weights: Array
    mean: float
    spread: float

    @classmethod
    def fitted(
        cls, points: Array, values: Array, *, scales: Array | None = None
    ) -> GaussianProcess:
        """Fit to points [N, D] in the unit cube and values [N].

        Args:
            points, values: observations; at least two.
            scales: length scales; None uses the most likely ones.
        """
        mean, spread = float(values.mean()), max(float(values.std()), 1e-9)
        unit = (values - mean) / spread
        found = _likeliest(points, unit) if scales is None else scales
        factor = _factor(points, found)
        return cls(found, points, factor, _solved(factor, unit), mean, spread)

    def at(self, points: Array) -> tuple[Array, Array]:
        """Means and standard deviations [M] at points [M, D]."""
        from scipy.linalg import solve_triangular

        between = _covariance(points, self.points, self.scales)
        half = solve_triangular(self.factor, between.T, lower=True, check_finite=False)
        left = np.maximum(1.0 - (half * half).sum(axis=0), 1e-12)
        return self.mean + self.spread * (between @ self.weights), self.spread * np.sqrt(left)


def _covariance(a: Array, b: Array, scales: Array) -> Array:
    """[A, B] Matern 5/2 covariance of variance 1."""
    from scipy.spatial.distance import cdist

    r = np.sqrt(5.0) * cdist(a / scales, b / scales)
    found: Array = (1.0 + r + r * r / 3.0) * np.exp(-r)
    return found


def _factor(points: Array, scales: Array) -> Array:
    noisy = _covariance(points, points, scales) + NOISE * np.eye(len(points))
    return np.asarray(np.linalg.cholesky(noisy), np.float64)


def _solved(factor: Array, values: Array) -> Array:
    from scipy.linalg import cho_solve

    found: Array = cho_solve((factor, True), values, check_finite=False)
    return found


def _likeliest(points: Array, unit: Array) -> Array:
    """Length scales by the marginal likelihood, with a weak preference for about half a range."""
    from scipy.optimize import minimize

    def cost(logs: Array) -> float:
        scales = np.exp(logs)
        factor = _factor(points, scales)
        fit = 0.5 * float(unit.dot(_solved(factor, unit))) + np.log(np.diag(factor)).sum()
        return float(fit + 0.5 * ((logs - np.log(0.5)) ** 2).sum())

    bounds = [(np.log(SHORTEST), np.log(LONGEST))] * points.shape[1]
    options: Any = {"maxiter": 20}
    start = np.full(points.shape[1], np.log(0.5))
    found = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options=options)
    # Rounding gives the same result for different summation orders on other threads.
    scales: Array = np.round(np.exp(found.x), 3)
    return scales


Point = NDArray[np.float64]
Report = Callable[[int, int], None]

POPULATION = 8
STEP = 0.25
"""Initial standard deviation of CMA-ES, as a fraction of the range."""
STALE = 3
"""Generations without improvement before a restart elsewhere."""
START, MIN_START = 8, 4
"""Number of initial points: total, and minimum per space."""
BATCH = 8
"""Points from the surrogate before a space is selected again."""
OPTIMISM = (2.0, 0.5, 1.0)
"""Standard deviations added to the surrogate's mean, in turn."""
REFIT = 4
"""Points between fits of the surrogate's length scales."""
MAX_SEEN = 160
"""Maximum number of points for the surrogate: the most critical ones, and the latest."""
UNIFORM, NEAR, AROUND = 600, 60, 6
"""Number of candidates anywhere, of the most critical points, and of candidates around each."""
ISO, LINE = 0.05, 0.3
"""Size of a variation: isotropic, and along the line to another (Vassiliades and Mouret 2018)."""


@dataclass(frozen=True)
class SearchBudget:
    """The budget of a search.

    Attributes:
        episodes: total number of episodes of the tested planner.
        seed: seed of the points.
        stop_at_first: end with the first avoidable failure.
    """

    episodes: int = 300
    seed: int = 0
    stop_at_first: bool = False


@dataclass
class SearchState:
    """The state of a search.

    Attributes:
        evaluations: all evaluations, in order.
        archive: archive of failures.
    """

    evaluations: list[Evaluation] = field(default_factory=list)
    archive: Archive = field(default_factory=Archive)

    def add(self, found: Evaluation) -> bool:
        """Add an evaluation; returns whether the archive improved."""
        self.evaluations.append(found)
        return self.archive.add(found, len(self.evaluations))


def search(
    evaluate: Evaluator, budget: SearchBudget, *, on_progress: Report = lambda _d, _t: None
) -> SearchState:
    """Search for avoidable failures.

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
    """Baseline of a search: spend the same budget on independent points of alternating spaces."""
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
    """Points to drive, each requested after the previous one is in the state."""
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
    """Initial points, alternating between spaces."""
    spaces = len(evaluate.spaces)
    each = max(START // spaces, MIN_START)
    clouds = [
        spread("sobol", each, evaluate.dimensions(k), seed=budget.seed) for k in range(spaces)
    ]
    for row in range(each):
        for k, cloud in enumerate(clouds):
            yield k, cloud[row]


def _space(spent: NDArray[np.float64], rng: np.random.Generator) -> int:
    """Select a space by Thompson sampling of the kinds of failures per batch.

    Args:
        spent: [S, 2] numbers of kinds of failures and of batches, per space.
        rng: random generator.
    """
    return int(np.argmax(rng.gamma(spent[:, 0] + 1.0) / (spent[:, 1] + 1.0)))


def _guided(
    evaluate: Evaluator, state: SearchState, rng: np.random.Generator, space: int
) -> Iterator[tuple[int, Point]]:
    """Points with the best expected score in a Gaussian process of all episodes of a space."""
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
    """The most critical and the latest evaluations, in order."""
    if len(seen) <= MAX_SEEN:
        return list(seen)
    ranked = sorted(range(len(seen)), key=lambda k: -seen[k].score)[: MAX_SEEN // 2]
    return [seen[k] for k in sorted({*ranked, *range(len(seen) - MAX_SEEN // 2, len(seen))})]


def _compressed(scores: Point) -> Point:
    """Compress scores, to resolve small margins near a collision better than large ones."""
    found: Point = np.where(scores < 0.0, -np.log1p(np.maximum(-scores, 0.0)), scores)
    return found


def _places(best: Point, rng: np.random.Generator) -> Point:
    """[N, D] random points: anywhere, and near the best [K, D].

    The latter are small moves, large moves, and moves in a few coordinates.
    """
    dimensions = best.shape[1]
    near = np.repeat(best, NEAR, axis=0)
    step = rng.choice([0.02, 0.08, 0.25], size=(len(near), 1)) * rng.standard_normal(near.shape)
    kept = rng.random(near.shape) < rng.choice([0.0, 0.6], size=(len(near), 1))
    found = [rng.random((UNIFORM, dimensions)), np.clip(near + np.where(kept, 0.0, step), 0.0, 1.0)]
    return np.concatenate(found)


def _descend(
    state: SearchState, rng: np.random.Generator, space: int
) -> Iterator[tuple[int, Point]]:
    """CMA-ES from a critical point outside known failures.

    Ends when it stops improving, or after a failure in a new cell.
    """
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
    """One of the most critical points of a space; more critical ones are more likely.

    Excludes failures, which are varied elsewhere.
    """
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
    """Two generations of variations, each from a failure towards another one of the same space."""
    for _ in range(2 * POPULATION):
        own = [e for e in state.archive.ordered() if e.space == space]
        one = np.array(own[int(rng.integers(len(own)))].point)
        other = np.array(own[int(rng.integers(len(own)))].point)
        step = ISO * rng.standard_normal(len(one)) + LINE * rng.standard_normal() * (other - one)
        if len(own) == 1:
            step *= 3.0
        yield space, np.clip(one + step, 0.0, 1.0)
