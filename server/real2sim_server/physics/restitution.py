"""Rebound by dissipation: viscosity is fitted so that a body bounces as requested.

An elastic body on a grid bounces too well, never too badly, so taking energy away is enough and
nothing is ever injected. Kelvin-Voigt damping of the first mode, omega = pi c / 2L, gives
e = e0 exp(-pi zeta / sqrt(1 - zeta^2)), zeta = eta omega / 2 (lambda + 2 mu); that is the first
guess, and canned impacts of the body itself do the rest.

How well a body bounces depends on where the wall lies between the nodes of the grid: an elastic
block of six cells keeps 0.64 of its speed on a wall that runs through nodes and 0.88 on one just
below them, from wherever it comes. So the canned impacts are made on the very wall the body is
meant for, where it is given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.rotation import Float
from .body import Body
from .colliders import Collider, Plane
from .errors import SolverError
from .solver import Solver, SolverOptions

TOLERANCE = 0.015
"""A fit stops when achieved and requested are this near."""
IMPACTS_MAX = 14
"""A fit makes at most this many canned impacts."""


@dataclass(frozen=True, eq=False)
class RestitutionFit:
    """What was requested, what was reached, and with what.

    Attributes:
        body: the body with the fitted viscosity in all its materials.
        requested, achieved: coefficient of restitution against a rigid wall.
        elastic: what the body does without added viscosity; no more can be reached.
        viscosity: added to the materials [Pa s].
        speed: of the canned impacts [m/s].
        impacts: how many were made.
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
        body: its velocity and place do not matter.
        requested: coefficient of restitution, in [0, 1].
        speed: approach of the canned impacts [m/s]; restitution depends on it.
        normal: [3] out of the wall, where no ``wall`` is given; it then lies just below the body.
        wall: the one the body will hit; the body is put in front of it.
        collider: what acts in place of the wall, whose face ``wall`` then is; at rest.
        options: of the solver the body is meant for; cells and precision matter.

    Returns:
        The fit; ``achieved`` falls short of ``requested`` where the body cannot bounce so well.

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

    Arguments are those of :func:`fit_restitution`. Separation over approach speed of the centre
    of mass; 0 when it does not come off again.
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
        # Off the wall nothing changes the momentum any more.
        if after > 0 and abs(after - before) < 1e-4 * speed * body.particles.mass:
            break
    return max(float(solver.measure.momentum[0] @ n) / (speed * body.particles.mass), 0.0)


def _wall_below(body: Body, normal: ArrayLike) -> Plane:
    """A wall that the body, where it is, nearly touches."""
    n = np.asarray(normal, dtype=np.float64)
    n = n / np.linalg.norm(n)
    lowest = float((body.particles.positions @ n).min())
    return Plane(name="wall", point=(lowest - 1.5 * _half_spacing(body)) * n, normal=n)


def _half_spacing(body: Body) -> float:
    """From the outermost particles to the surface [m]."""
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
