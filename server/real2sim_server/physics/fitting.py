"""Least squares over a handful of factors on what a simulation was given, by runs alone.

Simulations are no smooth functions: contact comes a substep sooner or later. So slopes are taken by
differences over a span that is wide against such stairs, and steps are those of Levenberg and
Marquardt. What a result may be wrong by has two parts: what the observations leave open, and what
the cells do. The latter is how far the result moves when the same observations are explained on
coarser cells, continued to none (Richardson 1911, first order).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.rotation import Float
from .errors import PhysicsError, SolverError

SPANS = (0.2, 0.1, 0.05)
"""Of the logarithm of a factor, between the runs of a slope: the first, and after steps failed."""
DAMPING, CALMER, BOLDER = 1e-3, 6.0, 0.2
LONGEST_STEP = 0.5
"""Of the logarithm of a factor, in one step."""
SETTLED = 2e-3
"""Steps shorter than this, as a fraction of what is uncertain or of the factor, end the search."""
KNOWN_BEFORE = 3.0
"""Standard deviation of the logarithm of a factor before anything was observed."""
TOLD = 1.0
"""Standard deviation of the logarithm from which on observations are said to tell nothing."""
COARSER = (1.5, 2.0)
"""Cells on which the result is looked at again, against those that it was found on."""
LEAST_COARSER = 1.25
"""Where bodies are too thin for those."""
CHORDS = 2
"""Steps with the same slopes on coarser cells."""

Residuals = Callable[[Mapping[str, float], float], Float]
"""(factor by parameter, size of cells against the usual) -> differences over what each is known
to."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What was found.

    Attributes:
        factors: by parameter; 1 for what observations do not tell.
        uncertainty: by parameter, standard deviation of one factor as a fraction: of what follows,
            the root of the sum of squares; infinite for what observations do not tell.
        observation: the part that observations leave open.
        discretisation: the part that is due to cells.
        residual: root mean square of the differences over what each is known to, at the start and
            after each step that was kept.
        runs: of the simulation.
    """

    factors: dict[str, float]
    uncertainty: dict[str, float]
    observation: dict[str, float]
    discretisation: dict[str, float]
    residual: tuple[float, ...]
    runs: int

    @property
    def untold(self) -> list[str]:
        """Parameters that observations do not tell."""
        return [name for name, u in self.uncertainty.items() if math.isinf(u)]


def fit(residuals: Residuals, parameters: Sequence[str], *, steps: int = 12) -> Fit:
    """Find the factors that explain observations best.

    Args:
        residuals: simulates and compares.
        parameters: names.
        steps: tried at most.

    Raises:
        SolverError: when the first run leaves the numbers, or nothing is told about any parameter.
    """
    search = _Search(residuals, tuple(dict.fromkeys(parameters)))
    told = search.determined(search.slopes(SPANS[0]))
    search.keep(told)
    search.descend(steps)
    # Where it ended it may be seen that some are told by nothing; the others are found without.
    for _ in parameters:
        told = search.determined(search.slopes(SPANS[-1]))
        if told.all():
            break
        search.keep(told)
        search.descend(steps)
    return search.result()


class _Search:
    """Logarithms of factors, on their way to the least squares."""

    def __init__(self, residuals: Residuals, names: tuple[str, ...]) -> None:
        self._residuals = residuals
        self._names = self._left = names
        self._logs = np.zeros(len(names))
        self._runs = 0
        self._off = self._run(self._logs)
        if not np.isfinite(self._off).all():
            raise SolverError("the simulation with the initial values leaves the numbers")
        self._history = [_size(self._off)]
        self._J = np.zeros((len(self._off), len(names)))

    def _run(self, logs: Float, coarser: float = 1.0) -> Float:
        self._runs += 1
        factors = dict.fromkeys(self._names, 1.0)
        factors |= dict(zip(self._left, np.exp(logs).tolist(), strict=True))
        return self._residuals(factors, coarser)

    def slopes(self, span: float) -> Float:
        """[M, K] by central differences, where the search is now."""
        columns = []
        for step in np.eye(len(self._logs)) * span / 2:
            columns.append((self._run(self._logs + step) - self._run(self._logs - step)) / span)
        self._J = np.stack(columns, axis=1)
        return self._J

    def determined(self, J: Float) -> np.ndarray:
        """[K] bool, whether observations tell anything about each parameter.

        Raises:
            SolverError: when they tell nothing at all.
        """
        told: np.ndarray = np.sqrt(np.diag(_covariance(J))) * self._scatter() < TOLD
        if not told.any():
            raise SolverError(
                f"these observations do not tell {', '.join(self._names)}: whatever they are, the "
                "simulation is the same within what they are known to; observe what the values "
                "change (a dent, a bounce, a slide), more often or more exactly"
            )
        return told

    def keep(self, told: np.ndarray) -> None:
        """Go on with some of the parameters; the others are as they were given."""
        if told.all():
            return
        self._left = tuple(n for n, known in zip(self._left, told, strict=True) if known)
        self._logs, self._J = self._logs[told], self._J[:, told]
        self._off = self._run(self._logs)
        self._history = [*self._history[:1], _size(self._off)]

    def descend(self, steps: int) -> None:
        """Take steps until they no longer help."""
        damping, spans = DAMPING, list(SPANS[1:])
        for _ in range(steps):
            step = _step(self._J, self._off, damping)
            if np.abs(step).max() < SETTLED:
                break
            off = self._run(self._logs + step)
            if np.isfinite(off).all() and _size(off) < self._history[-1]:
                # The slopes nearest to the old ones that explain this step, too (Broyden 1965).
                change = off - self._off - self._J @ step
                self._J = self._J + np.outer(change, step) / float(step @ step)
                self._logs, self._off = self._logs + step, off
                self._history.append(_size(off))
                damping = damping * BOLDER
            elif damping > DAMPING * CALMER and not spans:
                break
            elif damping > DAMPING:
                damping = DAMPING
                if spans:
                    self.slopes(spans.pop(0))
            else:
                damping *= CALMER

    def result(self) -> Fit:
        """With what it may be wrong by, in both ways."""
        covariance = _covariance(self._J)
        observation = np.sqrt(np.diag(covariance)) * self._scatter()
        moved = self._discretisation(covariance)
        factors = dict.fromkeys(self._names, 1.0)
        open_, cells = dict.fromkeys(self._names, math.inf), dict.fromkeys(self._names, math.inf)
        for k, name in enumerate(self._left):
            factors[name] = math.exp(self._logs[k])
            open_[name], cells[name] = float(observation[k]), float(moved[k])
        total = {name: math.hypot(open_[name], cells[name]) for name in self._names}
        return Fit(factors, total, open_, cells, tuple(self._history), self._runs)

    def _discretisation(self, covariance: Float) -> Float:
        """[K] how far the logarithms are from those on cells of no size."""
        moved: dict[float, Float] = {}
        for coarser in (*COARSER, LEAST_COARSER):
            if moved and coarser == LEAST_COARSER:
                break
            logs = self._logs.copy()
            try:
                for _ in range(CHORDS):
                    off = self._run(logs, coarser)
                    if np.isfinite(off).all():
                        step = -covariance @ (self._J.T @ off)
                        logs = logs + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            except PhysicsError:
                continue
            moved[coarser] = logs - self._logs
        return continued(moved) if moved else np.full(len(self._logs), math.inf)

    def _scatter(self) -> float:
        """By how much differences are larger than said, where they are."""
        free = max(len(self._off) - len(self._logs), 1)
        return max(1.0, math.sqrt(float(self._off @ self._off) / free))


def continued(moved: Mapping[float, Float]) -> Float:
    """[K] how far a result is from that on cells of no size, by how far it moves on coarser cells.

    Of first order, by least squares over all of these: a body that lies differently on the grid
    moves it as well, and from one alone that would count several times.

    Args:
        moved: [K] by size of cells against the usual.
    """
    over = np.array([coarser - 1 for coarser in moved])
    slope = over @ np.abs(np.stack(list(moved.values()))) / float(over @ over)
    return np.asarray(slope, dtype=np.float64)


def _covariance(J: Float) -> Float:
    """[K, K] of logarithms, given what each is known to and what was known before."""
    covariance = np.linalg.inv(J.T @ J + np.eye(J.shape[1]) / KNOWN_BEFORE**2)
    return np.asarray(covariance, dtype=np.float64)


def _step(J: Float, off: Float, damping: float) -> Float:
    """One damped step of the logarithms, at most LONGEST_STEP."""
    normal = J.T @ J
    normal = normal + np.diag(damping * np.diag(normal) + 1e-12)
    step = np.linalg.solve(normal, -(J.T @ off))
    bounded = step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-30))
    return np.asarray(bounded, dtype=np.float64)


def _size(off: Float) -> float:
    return float(np.sqrt(np.mean(off * off)))
