"""Elastic bodies: waves, bending, stiffness, contact of balls."""

from __future__ import annotations

import numpy as np

from ..colliders import Box, Plane
from ..materials import FixedCorotated
from ..solver import Solver
from .check import Check, ReferenceCurve, block, placed, solve


def vibrating_bar(backend: str) -> list[Check]:
    """First mode of a bar, clamped at x = 0: v_cm = 2 v0 / pi cos(omega t).

    L = 25 m, E = 100 Pa, rho = 1 kg/m^3, nu = 0, v = 0.1 sin(pi x / 2L) m/s. The clamp is the
    middle of a bar of twice the length.
    """
    material = FixedCorotated(young=100, poisson=0, density=1)
    still = block(material, size=(50, 2, 2), spacing=0.5)
    x = still.particles.positions[:, 0]
    velocity = np.zeros((len(x), 3))
    velocity[:, 0] = 0.1 * np.sin(np.pi * x / 50)
    gradient = np.zeros((len(x), 3, 3))
    gradient[:, 0, 0] = 0.1 * np.pi / 50 * np.cos(np.pi * x / 50)
    body = block(
        material,
        size=(50, 2, 2),
        spacing=0.5,
        particle_velocities=velocity,
        particle_gradients=gradient,
    )
    solver = solve([body], backend=backend, dx=1.0)
    times, found = [], []
    for _ in range(20):
        solver.step(0.5)
        times.append(solver.time)
        found.append(float(solver.particles().velocities[x > 0, 0].mean()))
    exact = 0.2 / np.pi * np.cos(np.pi * 10 / 50 * np.array(times))
    worst = float(np.abs(found - exact).max()) / (0.2 / np.pi)
    curve = ReferenceCurve(times, found, exact.tolist(), "time [s]", "velocity of the centre [m/s]")
    return [Check("vibrating bar: v_cm over a period", worst, 0, 0.02, curve=curve)]


def bar_on_wall(backend: str) -> list[Check]:
    """A bar on a rigid wall: stress rho c v there, for 2 L / c, then it comes off whole."""
    material = FixedCorotated(young=1e6, poisson=0, density=1000)
    length, speed, dx = 2.0, 0.3, 0.05
    c, area = material.wave_speed, 0.1**2
    t, J, rebound = _bar_run(backend, material, (length, 0.1, 0.1), speed, dx)
    _, _, coarse = _bar_run(backend, material, (length, 0.2, 0.2), speed, 2 * dx)
    middle = (t > 0.6 * length / c) & (t < 1.8 * length / c)
    force = float(np.polyfit(t[middle], J[middle], 1)[0])
    stress = material.density * c * speed
    # Impulse over plateau force is how long the wall was pushed.
    lasted = float(J[-1]) / force
    pushes = np.gradient(J, t) / area
    curve = ReferenceCurve(
        t.tolist(),
        pushes.tolist(),
        np.where(t < 2 * length / c, stress, 0.0).tolist(),
        "time [s]",
        "stress on the wall [Pa]",
    )
    return [
        Check("bar on wall: stress", force / area, stress, 0.03 * stress, "Pa", curve),
        Check("bar on wall: duration", lasted, 2 * length / c, 0.06 * length / c, "s"),
        Check("bar on wall: restitution", rebound, 1.0, 0.08),
        Check("bar on wall: it rises on smaller cells", float(rebound > coarse), 1, 0),
    ]


def _bar_run(
    backend: str,
    material: FixedCorotated,
    size: tuple[float, float, float],
    speed: float,
    dx: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, impulses of the wall until then, and the restitution."""
    length, c = size[0], material.wave_speed
    at = (length / 2 + 0.2 * dx, 0, 0)
    body = block(material, size=size, spacing=dx / 2, at=at, velocity=(-speed, 0, 0))
    wall = Plane(name="wall", normal=(1, 0, 0), friction=0)
    solver = solve([body], [wall], backend=backend, dx=dx)
    times, impulses = [], []
    while solver.time < 3.2 * length / c:
        solver.step(0.05 * length / c)
        times.append(solver.time)
        impulses.append(float(solver.contacts[0].impulse[0]) if solver.contacts else 0.0)
    rebound = float(solver.measure.momentum[0, 0] / solver.measure.mass[0]) / speed
    return np.array(times), np.array(impulses), rebound


def confined_compression(backend: str) -> list[Check]:
    """A block in a smooth box under a slow piston: pressure on the walls over squeeze inside.

    Mean pressure over loss of volume is the bulk modulus, differences give the shear modulus. The
    squeeze is read in the middle of the block, as surfaces give way by part of a cell.
    """
    material = FixedCorotated(young=1e6, poisson=0.3, density=1000, viscosity=2000)
    edge, speed, window = 0.8, 0.1, 0.04
    body = block(material, size=(edge,) * 3, spacing=0.05)
    middle = np.abs(body.particles.positions).max(axis=1) < edge / 8
    walls = [
        Plane(
            name=f"wall {axis}{side:+d}",
            point=_axis(axis, side * edge / 2),
            normal=_axis(axis, -side),
            friction=0,
        )
        for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1))
    ]
    piston = Box(
        name="piston",
        T_world_box=placed(0, 0, edge),
        size=(4, 4, edge),
        velocity=(0, 0, -speed),
        friction=0,
    )
    solver = solve([body], [*walls, piston], backend=backend)
    solver.step(0.4)
    before = _pushes(solver)
    solver.step(window / 2)
    stretch = solver.particles().F_elastic[middle].mean(axis=0).diagonal()
    solver.step(window / 2)
    force = (_pushes(solver) - before) / window
    stress = force / (edge**2 * stretch.prod() / stretch)
    K = float(stress.mean() / (1 - stretch.prod()))
    mu = float((stress[2] - stress[0]) / (2 * (stretch[0] - stretch[2])))
    bulk = material.lame_lambda + 2 / 3 * material.shear_modulus
    shear = material.shear_modulus
    return [
        Check("confined compression: bulk modulus", K, bulk, 0.03 * bulk, "Pa"),
        Check("confined compression: shear modulus", mu, shear, 0.05 * shear, "Pa"),
    ]


def _axis(axis: int, length: float) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = length
    return vector


def _pushes(solver: Solver) -> np.ndarray:
    """[3] impulse of the walls inwards so far, mean of both sides of each axis [N s]."""
    impulses = np.array([np.abs(c.impulse) for c in solver.contacts])
    mean: np.ndarray = impulses.sum(axis=0) / 2
    return mean
