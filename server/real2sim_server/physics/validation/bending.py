"""A clamped beam: how far it bends, and how fast it oscillates (Euler and Bernoulli)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ...geometry.rotation import Float
from ..body import Body
from ..colliders import Box
from ..materials import FixedCorotated
from ..solver import Solver
from .check import Check, ReferenceCurve, block, placed, solve

LENGTH, HEIGHT, DX = 2.0, 0.2, 0.05
MATERIAL = FixedCorotated(young=1e6, poisson=0.0, density=1000)
BENDING = MATERIAL.young * HEIGHT**4 / 12
"""E I [N m^2]."""
SHEARING = 5 / 6 * MATERIAL.shear_modulus * HEIGHT**2
"""k G A [N]."""
LINE_DENSITY = MATERIAL.density * HEIGHT**2
"""Mass per length [kg/m]."""


def cantilever(backend: str) -> list[Check]:
    """First mode of a beam, (1.875^2 / 2 pi) sqrt(E I / rho A L^4)."""
    still = _beam()
    x = still.particles.positions[:, 0]
    velocity = np.zeros((len(x), 3))
    velocity[:, 2] = 0.05 * np.clip(x / LENGTH, 0, None) ** 2
    gradient = np.zeros((len(x), 3, 3))
    gradient[:, 2, 0] = 0.1 * np.clip(x, 0, None) / LENGTH**2
    body = replace(still, particle_velocities=velocity, particle_gradients=gradient)
    exact = 1.875104**2 / (2 * np.pi) * math.sqrt(BENDING / LINE_DENSITY) / LENGTH**2
    solver = solve([body], [_clamp()], backend=backend, dx=DX)
    times, heights = _follow_tip(solver, x > LENGTH - 0.1, 0.01 / exact, 0.6 / exact)
    falls = (heights[1:] < 0) & (heights[:-1] >= 0) & (times[1:] > 0.2 / exact)
    i = int(np.flatnonzero(falls)[0])
    fraction = heights[i] / (heights[i] - heights[i + 1])
    half = times[i] + fraction * (times[i + 1] - times[i])
    oscillation = heights.max() * np.sin(2 * np.pi * exact * times)
    curve = ReferenceCurve(
        times.tolist(), heights.tolist(), oscillation.tolist(), "time [s]", "tip [m]"
    )
    return [Check("cantilever: frequency", 0.5 / half, exact, 0.05 * exact, "Hz", curve)]


def loaded_beam(backend: str, *, length: float | None = None) -> list[Check]:
    """A weight on the tip bends the beam by P L^3 / 3 E I, its own by what a line load does.

    Let go at rest it oscillates about that bend: the mean from rest to the lowest point. Shear adds
    (P + q L / 2) L / k G A with k = 5/6 (Timoshenko). On the reference, which is slow, the beam is
    half as long by default.
    """
    L = length or (LENGTH / 2 if backend == "reference" else LENGTH)
    tip_mass, gravity, piece = LINE_DENSITY * L / 2, 0.025 * (LENGTH / L) ** 3, 0.05
    beam = _beam(L)
    x = beam.particles.positions[:, 0]
    tip = x > L - piece
    masses = np.where(tip, beam.particles.masses + tip_mass / tip.sum(), beam.particles.masses)
    body = replace(beam, particles=replace(beam.particles, masses=masses))
    a = L - piece / 2
    point = tip_mass * gravity * a**3 / (3 * BENDING)
    shape = a**2 * (6 * L**2 - 4 * L * a + a**2) / (24 * BENDING)
    shear = (tip_mass * a + LINE_DENSITY * (L * a - a**2 / 2)) * gravity / SHEARING
    exact = point + LINE_DENSITY * gravity * shape + shear
    # Rayleigh's estimate is near enough to know when to expect the lowest point.
    swinging = tip_mass + 33 / 140 * LINE_DENSITY * L
    half = math.pi * math.sqrt(swinging * a**3 / (3 * BENDING))
    solver = solve([body], [_clamp()], backend=backend, dx=DX, gravity=(0, 0, -gravity))
    times, heights = _follow_tip(solver, tip, half / 60, 1.15 * half)
    lowest = int(np.argmin(heights))
    bend = -float(np.trapezoid(heights[: lowest + 1], times[: lowest + 1]) / times[lowest])
    oscillation = -exact * (1 - np.cos(np.pi * times / times[lowest]))
    curve = ReferenceCurve(
        times.tolist(), heights.tolist(), oscillation.tolist(), "time [s]", "tip [m]"
    )
    return [Check("cantilever: bend under load", bend, exact, 0.05 * exact, "m", curve)]


def _beam(length: float = LENGTH) -> Body:
    return block(
        MATERIAL,
        size=(length + 0.2, HEIGHT, HEIGHT),
        spacing=DX / 2,
        at=(length / 2 - 0.1, 0, 0),
    )


def _clamp() -> Box:
    """Holds all of the beam at x < 0."""
    return Box(
        name="clamp",
        T_world_box=placed(-1.0),
        size=(2, 4, 4),
        friction=math.inf,
        separable=False,
    )


def _follow_tip(
    solver: Solver, tip: np.ndarray, every: float, duration: float
) -> tuple[Float, Float]:
    """Times and mean heights of the tip from its start."""
    start = float(solver.particles().positions[tip, 2].mean())
    times, heights = [0.0], [0.0]
    while solver.time < duration:
        solver.step(every)
        times.append(solver.time)
        heights.append(float(solver.particles().positions[tip, 2].mean()) - start)
    return np.array(times), np.array(heights)
