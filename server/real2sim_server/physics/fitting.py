"""Fitting of simulation inputs: factors by least squares, viscosity by rebound tests.

Simulations are not smooth, because contacts start a substep earlier or later. Derivatives are
therefore differences over a span that is wide compared with such jumps, and the search follows
Levenberg and Marquardt. The uncertainty of a result has two parts: observation error and
discretisation error. The latter is the change of the result on coarser cells, extrapolated to cell
size zero (Richardson 1911, first order).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import Float
from .body import Body
from .colliders import Collider, Plane
from .errors import PhysicsError, SolverError
from .solver import Solver, SolverOptions

SPANS = (0.2, 0.1, 0.05)
"""Spans of central differences, in the logarithm of a factor; the first, and smaller ones after
failed steps."""
DAMPING, CALMER, BOLDER = 1e-3, 6.0, 0.2
MAX_STEP = 0.5
"""Maximum change of a factor's logarithm in one step."""
SETTLED = 2e-3
"""Relative step length, compared with the uncertainty or the factor, below which the search ends.
"""
KNOWN_BEFORE = 3.0
"""Prior standard deviation of the logarithm of a factor."""
MAX_UNCERTAINTY = 1.0
"""Standard deviation of the logarithm above which a factor counts as undetermined."""
COARSER = (1.5, 2.0)
"""Cell sizes for the estimate of the discretisation error, relative to those of the fit."""
MIN_COARSER = 1.25
"""Relative cell size if bodies are too thin for COARSER."""
CHORDS = 2
"""Number of steps on coarser cells, with unchanged slopes."""

Residuals = Callable[[Mapping[str, float], float], Float]
"""(factors by parameter, relative cell size) -> normalised residuals."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Attributes:
        factors: by parameter; 1 if the observations do not determine it.
        uncertainty: by parameter, relative standard deviation of the factor: the root of the sum of
            squares of the next two; infinite if the observations do not determine it.
        observation: part due to observation errors.
        discretisation: part due to the cell size.
        residual: RMS of the normalised residuals, at the start and after each accepted step.
        runs: number of simulations.
    """

    factors: dict[str, float]
    uncertainty: dict[str, float]
    observation: dict[str, float]
    discretisation: dict[str, float]
    residual: tuple[float, ...]
    runs: int

    @property
    def undetermined(self) -> list[str]:
        """Parameters that the observations do not determine."""
        return [name for name, u in self.uncertainty.items() if math.isinf(u)]


def fit(residuals: Residuals, parameters: Sequence[str], *, steps: int = 12) -> Fit:
    """Find the factors that best explain the observations.

    Args:
        residuals: function that simulates and compares.
        parameters: names of the parameters.
        steps: maximum number of steps.

    Raises:
        SolverError: if the first run diverges, or the observations determine no parameter.
    """
    search = _Search(residuals, tuple(dict.fromkeys(parameters)))
    known = search.determined(search.slopes(SPANS[0]))
    search.keep(known)
    search.descend(steps)
    # If the observations do not determine some parameters, the others are fitted without them.
    for _ in parameters:
        known = search.determined(search.slopes(SPANS[-1]))
        if known.all():
            break
        search.keep(known)
        search.descend(steps)
    return search.result()


class _Search:
    """The search over logarithms of factors."""

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
        """[M, K] slopes at the current point, by central differences."""
        columns = []
        for step in np.eye(len(self._logs)) * span / 2:
            columns.append((self._run(self._logs + step) - self._run(self._logs - step)) / span)
        self._J = np.stack(columns, axis=1)
        return self._J

    def determined(self, J: Float) -> np.ndarray:
        """[K] bool, whether the observations determine each parameter.

        Raises:
            SolverError: if they determine none.
        """
        known: np.ndarray = np.sqrt(np.diag(_covariance(J))) * self._scatter() < MAX_UNCERTAINTY
        if not known.any():
            raise SolverError(
                f"these observations do not determine {', '.join(self._names)}: for all values the "
                "simulation agrees with them within their accuracy; add observations that depend "
                "on it (a dent, a bounce, a slide), or more accurate ones"
            )
        return known

    def keep(self, known: np.ndarray) -> None:
        """Continue with the ``known`` parameters; the others keep their given values."""
        if known.all():
            return
        self._left = tuple(n for n, is_known in zip(self._left, known, strict=True) if is_known)
        self._logs, self._J = self._logs[known], self._J[:, known]
        self._off = self._run(self._logs)
        self._history = [*self._history[:1], _size(self._off)]

    def descend(self, steps: int) -> None:
        """Take steps until they no longer reduce the residual."""
        damping, spans = DAMPING, list(SPANS[1:])
        for _ in range(steps):
            step = _step(self._J, self._off, damping)
            if np.abs(step).max() < SETTLED:
                break
            off = self._run(self._logs + step)
            if np.isfinite(off).all() and _size(off) < self._history[-1]:
                # The slopes closest to the old ones that also explain this step (Broyden 1965).
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
        """The fit with both parts of its uncertainty."""
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
        """[K] distance of the logarithms to those at cell size zero."""
        moved: dict[float, Float] = {}
        for coarser in (*COARSER, MIN_COARSER):
            if moved and coarser == MIN_COARSER:
                break
            logs = self._logs.copy()
            try:
                for _ in range(CHORDS):
                    off = self._run(logs, coarser)
                    if np.isfinite(off).all():
                        step = -covariance @ (self._J.T @ off)
                        logs = logs + np.clip(step, -MAX_STEP, MAX_STEP)
            except PhysicsError:
                continue
            moved[coarser] = logs - self._logs
        return continued(moved) if moved else np.full(len(self._logs), math.inf)

    def _scatter(self) -> float:
        """Factor by which residuals exceed their stated errors, at least 1."""
        free = max(len(self._off) - len(self._logs), 1)
        return max(1.0, math.sqrt(float(self._off @ self._off) / free))


def continued(moved: Mapping[float, Float]) -> Float:
    """[K] distance of a result to that at cell size zero, from its change on coarser cells.

    First order, by least squares over several cell sizes, because the position of a body on the
    grid also affects the result.

    Args:
        moved: [K] changes by relative cell size.
    """
    over = np.array([coarser - 1 for coarser in moved])
    slope = over @ np.abs(np.stack(list(moved.values()))) / float(over @ over)
    return np.asarray(slope, dtype=np.float64)


def _covariance(J: Float) -> Float:
    """[K, K] covariance of the logarithms, from the observation errors and the prior."""
    covariance = np.linalg.inv(J.T @ J + np.eye(J.shape[1]) / KNOWN_BEFORE**2)
    return np.asarray(covariance, dtype=np.float64)


def _step(J: Float, off: Float, damping: float) -> Float:
    """One damped step of the logarithms, at most MAX_STEP."""
    normal = J.T @ J
    normal = normal + np.diag(damping * np.diag(normal) + 1e-12)
    step = np.linalg.solve(normal, -(J.T @ off))
    bounded = step * min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-30))
    return np.asarray(bounded, dtype=np.float64)


def _size(off: Float) -> float:
    return float(np.sqrt(np.mean(off * off)))


# Restitution by dissipation: the viscosity with which a body rebounds as requested. An elastic body
# on a grid always rebounds too well, so removing energy is enough. Kelvin-Voigt damping of the
# first mode, omega = pi c / 2L, gives e = e0 exp(-pi zeta / sqrt(1 - zeta^2)), zeta = eta omega / 2
# (lambda + 2 mu). This is the first guess; test impacts of the body refine it. The rebound depends
# on the position of the wall relative to grid nodes: an elastic block of six cells keeps 0.64 of
# its speed on a wall through nodes and 0.88 on a wall just below them. The test impacts therefore
# use the actual wall if it is given.

TOLERANCE = 0.015
"""Maximum difference between achieved and requested restitution at which a fit stops."""
IMPACTS_MAX = 14
"""Maximum number of test impacts of a fit."""


@dataclass(frozen=True, eq=False)
class RestitutionFit:
    """Requested and reached restitution, and the fitted viscosity.

    Attributes:
        body: the body with the fitted viscosity in all its materials.
        requested, achieved: coefficient of restitution against a rigid wall.
        elastic: restitution without added viscosity, the maximum.
        viscosity: viscosity added to the materials [Pa s].
        speed: speed of the test impacts [m/s].
        impacts: number of test impacts.
    """

    body: Body
    requested: float
    achieved: float
    elastic: float
    viscosity: float
    speed: float
    impacts: int


def fit_restitution(
    body: Body,
    requested: float,
    *,
    speed: float,
    normal: ArrayLike = (0.0, 0.0, 1.0),
    wall: Plane | None = None,
    collider: Collider | None = None,
    options: SolverOptions | None = None,
) -> RestitutionFit:
    """Fit viscosity so that ``body`` bounces off a rigid wall with ``requested``.

    Args:
        body: the body; its velocity and position are ignored.
        requested: coefficient of restitution, in [0, 1].
        speed: approach speed of the test impacts [m/s]; restitution depends on it.
        normal: [3] outward normal of a wall just below the body, if no ``wall`` is given.
        wall: the wall that the body will hit; the body is placed in front of it.
        collider: collider at rest to use instead of the wall; ``wall`` is its face.
        options: options of the target solver; cell size and precision matter.

    Returns:
        The fit; ``achieved`` is below ``requested`` if the body cannot rebound that well.

    Raises:
        SolverError: for a request outside [0, 1] or a speed that is not positive.
    """
    if not 0 <= requested <= 1:
        raise SolverError(f"restitution must be in [0, 1], not {requested!r}")
    if wall is not None:
        normal = wall.normal

    def rebound(viscosity: float) -> float:
        trial = with_viscosity(body, viscosity)
        return impact(
            trial, speed=speed, normal=normal, wall=wall, collider=collider, options=options
        )

    elastic = rebound(0.0)
    low, high = 0.0, math.inf
    tried, achieved, impacts = 0.0, elastic, 1
    best = (abs(elastic - requested), 0.0, elastic)
    while elastic > requested + TOLERANCE and best[0] > TOLERANCE and impacts < IMPACTS_MAX:
        if achieved > requested:
            low = tried
        else:
            high = tried
        if impacts == 1:
            tried = _first_guess(body, requested / elastic, normal)
        else:
            tried = _between(low, high, tried)
        achieved = rebound(tried)
        impacts += 1
        best = min(best, (abs(achieved - requested), tried, achieved))
    return RestitutionFit(
        with_viscosity(body, best[1]), requested, best[2], elastic, best[1], speed, impacts
    )


def impact(
    body: Body,
    *,
    speed: float,
    normal: ArrayLike = (0.0, 0.0, 1.0),
    wall: Plane | None = None,
    collider: Collider | None = None,
    options: SolverOptions | None = None,
) -> float:
    """Coefficient of restitution of one impact on a rigid wall, without gravity.

    Arguments as in :func:`fit_restitution`. Separation over approach speed of the centre of mass;
    0 if the body does not separate again.
    """
    if not (math.isfinite(speed) and speed > 0):
        raise SolverError(f"speed of an impact must be positive [m/s], not {speed!r}")
    if wall is None:
        wall = _wall_below(body, normal)
    n = np.asarray(wall.normal)
    lowest = float((body.particles.positions @ n).min()) - float(np.asarray(wall.point) @ n)
    pose = np.eye(4)
    pose[:3, 3] = (1.5 * _half_spacing(body) - lowest) * n
    particles = body.particles.moved(pose)
    thrown = replace(body, particles=particles, velocity=-speed * n, angular_velocity=np.zeros(3))
    options = replace(options or SolverOptions(), gravity=(0.0, 0.0, 0.0))
    solver = Solver([thrown], [wall if collider is None else collider], options)
    crossing = _length(body, n) / body.materials[0].wave_speed
    limit = 60 * (crossing + solver.dx / speed)
    while solver.time < limit:
        before = solver.measure.momentum[0] @ n
        solver.step(crossing)
        after = solver.measure.momentum[0] @ n
        # Away from the wall, the momentum no longer changes.
        if after > 0 and abs(after - before) < 1e-4 * speed * body.particles.mass:
            break
    return max(float(solver.measure.momentum[0] @ n) / (speed * body.particles.mass), 0.0)


def _wall_below(body: Body, normal: ArrayLike) -> Plane:
    """A wall just below the body at its current position."""
    n = np.asarray(normal, dtype=np.float64)
    n = n / np.linalg.norm(n)
    lowest = float((body.particles.positions @ n).min())
    return Plane(name="wall", point=(lowest - 1.5 * _half_spacing(body)) * n, normal=n)


def _half_spacing(body: Body) -> float:
    """Distance from the outermost particles to the surface [m]."""
    return 0.5 * float(np.cbrt(body.particles.volumes).mean())


def with_viscosity(body: Body, viscosity: float) -> Body:
    """The body with ``viscosity`` [Pa s] added to each of its materials."""
    return replace(
        body,
        material=[replace(m, viscosity=m.viscosity + viscosity) for m in body.materials],
    )


def _first_guess(body: Body, fraction: float, normal: ArrayLike) -> float:
    """Viscosity [Pa s] that lets ``fraction`` of the rebound through, by the formula above."""
    drop = -math.log(max(fraction, 0.02))
    zeta = drop / math.hypot(math.pi, drop)
    material = body.materials[0]
    n = np.asarray(normal, dtype=np.float64)
    omega = math.pi * material.wave_speed / (2 * _length(body, n))
    return 2 * material.wave_modulus * zeta / omega


def _between(low: float, high: float, tried: float) -> float:
    """Halve a bracket in the logarithm; widen it while one end is open."""
    if math.isinf(high):
        return 1.6 * tried
    if low == 0.0:
        return tried / 1.6
    return math.sqrt(low * high)


def _length(body: Body, n: Float) -> float:
    """Extent of the body along a direction [m]."""
    along = body.particles.positions @ (n / np.linalg.norm(n))
    return float(along.max() - along.min()) + float(np.cbrt(body.particles.volumes).mean())
