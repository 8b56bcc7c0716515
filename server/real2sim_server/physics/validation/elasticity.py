"""Elastic bodies: waves, bending, stiffness, contact of balls."""

from __future__ import annotations

import math

import numpy as np

from ..body import Body
from ..colliders import Box, Plane
from ..materials import Jelly, Metal, NeoHookean
from ..particles import ball_particles
from .check import Check, block, placed, solve


def vibrating_bar(backend: str) -> list[Check]:
    """First mode of a bar, clamped at x = 0: v_cm = 2 v0 / pi cos(omega t).

    L = 25 m, E = 100 Pa, rho = 1 kg/m^3, nu = 0, v = 0.1 sin(pi x / 2L) m/s. The clamp is the
    middle of a bar of twice the length.
    """
    material = Jelly(young=100, poisson=0, density=1)
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
    worst = 0.0
    for _ in range(10):
        solver.step(1.0)
        mean = float(solver.particles().velocities[x > 0, 0].mean())
        exact = 0.2 / np.pi * math.cos(np.pi * 10 / 50 * solver.time)
        worst = max(worst, abs(mean - exact))
    return [Check("vibrating bar: v_cm over a period", worst / (0.2 / np.pi), 0, 0.02)]


def bar_on_wall(backend: str) -> list[Check]:
    """A bar on a rigid wall: stress rho c v there, for 2 L / c, then it comes off."""
    material = Jelly(young=1e6, poisson=0, density=1000)
    length, speed, dx = 2.0, 0.3, 0.05
    c, area = material.wave_speed, 0.1**2
    gap = 0.2 * dx
    body = block(
        material,
        size=(length, 0.1, 0.1),
        spacing=0.025,
        at=(length / 2 + gap, 0, 0),
        velocity=(-speed, 0, 0),
    )
    wall = Plane(name="wall", normal=(1, 0, 0), friction=0)
    solver = solve([body], [wall], backend=backend, dx=dx)
    times, impulses = [], []
    while solver.time < 3.2 * length / c:
        solver.step(0.05 * length / c)
        times.append(solver.time)
        impulses.append(float(solver.contacts[0].impulse[0]) if solver.contacts else 0.0)
    t, J = np.array(times), np.array(impulses)
    middle = (t > 0.6 * length / c) & (t < 1.8 * length / c)
    force = float(np.polyfit(t[middle], J[middle], 1)[0])
    rebound = float(solver.measure.momentum[0, 0] / solver.measure.mass[0]) / speed
    stress = material.density * c * speed
    # Impulse over plateau force is how long the wall was pushed.
    lasted = float(J[-1]) / force
    return [
        Check("bar on wall: stress", force / area, stress, 0.03 * stress, "Pa"),
        Check("bar on wall: duration", lasted, 2 * length / c, 0.06 * length / c, "s"),
        Check("bar on wall: restitution", rebound, 1.0, 0.08),
    ]


def two_balls(backend: str) -> list[Check]:
    """Sulsky's discs as balls: they touch when their surfaces do, swap velocities, and part."""
    material = Jelly(young=1000, poisson=0.3, density=1000)
    offset, speed, radius, dx = 0.3, 0.1, 0.2, 0.05
    direction = np.array([1, 1, 0]) / math.sqrt(2)
    matter = ball_particles(radius, spacing=dx / 2, density=1000)
    bodies = [
        Body(
            name=name,
            particles=matter.moved(placed(*(side * offset * direction))),
            material=material,
            velocity=-side * math.sqrt(2) * speed * direction,
        )
        for name, side in (("left", -1), ("right", 1))
    ]
    solver = solve(bodies, backend=backend, dx=dx)
    expected = (2 * offset - 2 * radius) / (2 * math.sqrt(2) * speed)
    touched = math.nan
    kinetic = float(solver.measure.kinetic.sum())
    while solver.time < 2.2:
        solver.step(0.02)
        if math.isnan(touched) and solver.contacts:
            touched = solver.time
    apart = float((solver.measure.centre[1] - solver.measure.centre[0]) @ direction)
    velocity = solver.measure.momentum[0] @ direction / solver.measure.mass[0]
    return [
        # Half a cell, as surfaces are that well known, and one step of looking.
        Check("two balls: touch", touched, expected, 0.5 * dx / (2.8 * speed) + 0.02, "s"),
        Check("two balls: rebound", -velocity / (math.sqrt(2) * speed), 0.8, 0.2),
        Check("two balls: kept energy", float(solver.measure.kinetic.sum()) / kinetic, 0.7, 0.3),
        Check("two balls: parted", float(apart > 2 * radius), 1, 0),
    ]


def hertz(backend: str) -> list[Check]:
    """A ball on a rigid wall: t_c = 2.87 (m^2 / (R E*^2 v))^(1/5) (Johnson 1985, 11.24)."""
    material = Jelly(young=1e6, poisson=0.3, density=1000)
    radius, speed, dx = 0.5, 0.5, 0.05
    matter = ball_particles(radius, spacing=dx / 2, density=1000)
    body = Body(
        name="ball",
        particles=matter.moved(placed(0, 0, radius + 0.1 * dx)),
        material=material,
        velocity=(0, 0, -speed),
    )
    solver = solve([body], [Plane(name="wall", friction=0)], backend=backend, dx=dx)
    stiffness = material.young / (1 - material.poisson**2)
    exact = 2.87 * (matter.mass**2 / (radius * stiffness**2 * speed)) ** 0.2
    times, impulses = [0.0], [0.0]
    while solver.time < 2.5 * exact:
        solver.step(exact / 40)
        times.append(solver.time)
        impulses.append(float(solver.contacts[0].impulse[2]) if solver.contacts else 0.0)
    J = np.array(impulses) / impulses[-1]
    # The force law is symmetric: the middle 98 % of the impulse take 0.85 of the contact.
    inner = float(np.interp(0.99, J, times) - np.interp(0.01, J, times))
    force = np.diff(impulses).max() / (exact / 40)
    depth = (15 * matter.mass * speed**2 / (16 * math.sqrt(radius) * stiffness)) ** 0.4
    peak = 4 / 3 * stiffness * math.sqrt(radius) * depth**1.5
    share = _hertz_share(0.01)
    return [
        Check("hertz: contact time", inner / share, exact, 0.1 * exact, "s"),
        Check("hertz: peak force", float(force), peak, 0.15 * peak, "N"),
    ]


def _hertz_share(tail: float) -> float:
    """Share of the contact time in which all but ``tail`` at each end of the impulse passes."""
    t = np.linspace(0, 1, 2001)
    # Hertz's indentation is close to sin(pi t)^(1.07), its force to the power 3/2 of that.
    J = np.cumsum(np.sin(np.pi * t) ** (1.5 * 1.07))
    J /= J[-1]
    return float(np.interp(1 - tail, J, t) - np.interp(tail, J, t))


def cantilever(backend: str) -> list[Check]:
    """First bending frequency of a clamped beam, Timoshenko's correction included."""
    material = Jelly(young=1e6, poisson=0.0, density=1000)
    height, dx = 0.2, 0.05
    length = 2.0
    body = block(
        material,
        size=(length + 0.2, height, height),
        spacing=dx / 2,
        at=(length / 2 - 0.1, 0, 0),
    )
    x = body.particles.positions[:, 0]
    velocity = np.zeros((len(x), 3))
    velocity[:, 2] = 0.05 * np.clip(x / length, 0, None) ** 2
    gradient = np.zeros((len(x), 3, 3))
    gradient[:, 2, 0] = 0.1 * np.clip(x, 0, None) / length**2
    body = block(
        material,
        size=(length + 0.2, height, height),
        spacing=dx / 2,
        at=(length / 2 - 0.1, 0, 0),
        particle_velocities=velocity,
        particle_gradients=gradient,
    )
    clamp = Box(
        name="clamp",
        T_world_box=placed(-1.0),
        size=(2, 4, 4),
        friction=math.inf,
        separable=False,
    )
    solver = solve([body], [clamp], backend=backend, dx=dx)
    slenderness = height**2 / 12 / length**2
    exact = 1.875104**2 / (2 * np.pi) * math.sqrt(material.young / material.density * slenderness)
    exact /= length
    tip = x > length - 0.1
    times, heights = [0.0], [0.0]
    while solver.time < 0.8 / exact:
        solver.step(0.01 / exact)
        times.append(solver.time)
        heights.append(float(solver.particles().positions[tip, 2].mean()))
    z = np.array(heights)
    crossing = np.flatnonzero((z[1:] < 0) & (z[:-1] >= 0) & (np.array(times[1:]) > 0.2 / exact))
    i = int(crossing[0])
    half = times[i] + z[i] / (z[i] - z[i + 1]) * (times[i + 1] - times[i])
    return [Check("cantilever: frequency", 0.5 / half, exact, 0.05 * exact, "Hz")]


def bulk_modulus(backend: str) -> list[Check]:
    """Energy of small squeeze: 9/2 K s^2 on all sides, (lambda + 2 mu) s^2 / 2 on one."""
    checks = []
    strain = 1e-3
    for material in (
        Jelly(young=1e6, poisson=0.3),
        NeoHookean(young=1e6, poisson=0.3),
        Metal(young=1e6, poisson=0.3, yield_stress=1e6),
    ):
        mu, lam = material.shear_modulus, material.lame_lambda
        squeezes = {
            "bulk": (np.eye(3) * (1 - strain), 4.5 * (lam + 2 * mu / 3)),
            "confined": (np.diag([1 - strain, 1, 1]), (lam + 2 * mu) / 2),
        }
        for name, (F, modulus) in squeezes.items():
            still = block(material)
            n = len(still.particles)
            body = block(material, deformation=np.tile(F, (n, 1, 1)))
            energy = float(solve([body], backend=backend).measure.elastic[0])
            volume = float(still.particles.volumes.sum())
            found = energy / (volume * strain**2)
            label = f"{name} modulus: {type(material).__name__}"
            checks.append(Check(label, found, modulus, 0.03 * modulus, "Pa"))
    return checks
