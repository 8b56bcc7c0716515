"""Contact: friction, rebound, impulse."""

from __future__ import annotations

import math

import numpy as np

from ..body import Body
from ..colliders import Plane
from ..materials import FixedCorotated
from ..particles import ball_particles
from ..restitution import fit_restitution
from ..solver import SolverOptions
from .check import Check, ReferenceCurve, block, placed, solve

GRAVITY = 9.81
RUBBER = FixedCorotated(young=2e5, poisson=0.2, viscosity=200)
"""Damped, so that a block that is set down comes to rest and stays in contact."""


def incline(backend: str, *, duration: float = 5.0) -> list[Check]:
    """A block on a slope of 24 degrees slides at g (sin - mu cos), or sticks (Matter's test)."""
    slope = math.radians(24)
    gravity = (GRAVITY * math.sin(slope), 0.0, -GRAVITY * math.cos(slope))
    checks = []
    for name, mu, lasts in (("slides", math.tan(math.radians(15)), duration), ("sticks", 0.6, 0.5)):
        body = block(RUBBER, size=(0.6, 0.6, 0.3), at=(0, 0, 0.15), friction=mu)
        solver = solve([body], [Plane(name="slope")], gravity=gravity, backend=backend)
        # Let it settle against the slope first.
        solver.step(0.1)
        x, v = solver.measure.centre[0, 0], solver.measure.momentum[0, 0] / solver.measure.mass[0]
        acceleration = max(GRAVITY * (math.sin(slope) - mu * math.cos(slope)), 0.0)
        times = np.linspace(0, lasts, 21)
        found = [0.0]
        for pause in np.diff(times):
            solver.step(float(pause))
            coasted = v * (solver.time - 0.1) * (acceleration > 0)
            found.append(float(solver.measure.centre[0, 0] - x - coasted))
        exact = acceleration * times**2 / 2
        tolerance = 1e-3 * exact[-1] if acceleration else 2e-3
        curve = ReferenceCurve(times.tolist(), found, exact.tolist(), "time [s]", "way [m]")
        checks.append(Check(f"incline: {name}", found[-1], exact[-1], tolerance, "m", curve))
    return checks


def braking(backend: str, *, speed: float = 10.0) -> list[Check]:
    """A block sliding to rest: v^2 / (2 mu g), after v / (mu g)."""
    mu = 0.7
    body = block(RUBBER, size=(0.8, 0.8, 0.2), at=(0, 0, 0.1), friction=mu, velocity=(speed, 0, 0))
    solver = solve([body], [Plane(name="road")], gravity=(0, 0, -GRAVITY), backend=backend)
    distance, duration = speed**2 / (2 * mu * GRAVITY), speed / (mu * GRAVITY)
    times, ways, speeds = [0.0], [0.0], [speed]
    while solver.time < 1.2 * duration:
        solver.step(duration / 200)
        times.append(solver.time)
        ways.append(float(solver.measure.centre[0, 0]))
        speeds.append(float(solver.measure.momentum[0, 0] / body.particles.mass))
    slow = np.flatnonzero(np.array(speeds) <= 0.005 * speed)
    stopped = times[slow[0]] if len(slow) else math.nan
    sliding = np.minimum(times, duration)
    exact = speed * sliding - mu * GRAVITY * sliding**2 / 2
    curve = ReferenceCurve(times, ways, exact.tolist(), "time [s]", "way [m]")
    return [
        Check("braking: distance", ways[-1], distance, 0.03 * distance, "m", curve),
        Check("braking: time", stopped, duration, 0.03 * duration, "s"),
    ]


def oblique_impact(backend: str) -> list[Check]:
    """A block that hits a wall and slides: the wall's impulse leans by mu, delta-v follows."""
    checks = []
    for mu in (0.1, 0.3):
        body = block(
            FixedCorotated(young=2e6, poisson=0.2),
            size=(0.8, 0.8, 0.2),
            at=(0, 0, 0.11),
            velocity=(6, 0, -2),
            friction=mu,
        )
        solver = solve([body], [Plane(name="wall")], backend=backend)
        solver.step(0.03)
        m = solver.measure
        v = m.momentum[0] / m.mass[0]
        e = float(v[2]) / 2
        checks.append(
            Check(f"oblique impact, mu {mu}", 6 - float(v[0]), mu * (1 + e) * 2, 0.03 * mu * 4)
        )
    return checks


def frictionless_slide(backend: str) -> list[Check]:
    """Two blocks pressed together that slide with mu = 0 keep their slip, touch, and part.

    Stiff enough that edges do not dig in, which would brake them in earnest.
    """
    material = FixedCorotated(young=2e6, poisson=0.2)
    upper = block(material, at=(0.1, 0, 0.205), velocity=(-3, 0, -0.5), friction=0, name="upper")
    lower = block(
        material,
        size=(0.8, 0.6, 0.4),
        at=(0, 0, -0.2),
        velocity=(0, 0, 0.5),
        friction=0,
        name="lower",
    )
    solver = solve([upper, lower], backend=backend)
    solver.step(0.06)
    m = solver.measure
    v = m.momentum / m.mass[:, None]
    pushed = [float(c.impulse[2]) for c in solver.contacts if c.body == "upper"]
    return [
        Check("slide with mu 0: slip kept", float(v[1, 0] - v[0, 0]) / 3, 1, 0.05),
        Check("slide with mu 0: they touched", float(bool(pushed) and pushed[0] > 1), 1, 0),
        Check("slide with mu 0: they part", float(v[0, 2] > v[1, 2]), 1, 0),
    ]


def restitution(backend: str, *, requests: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7)) -> list[Check]:
    """Requested against achieved, by an impact made after the fit, in which no energy appears."""
    checks = []
    dx, speed = 0.08, 2.5
    wall = Plane(name="wall", point=(0, 0, 0.75 * dx))
    options = SolverOptions(dx=dx, backend=backend, gravity=(0.0, 0.0, 0.0))
    body = block(FixedCorotated(young=2e6, poisson=0.4), size=(0.48,) * 3, spacing=0.04)
    for e in requests:
        fit = fit_restitution(body, e, speed=speed, wall=wall, options=options)
        thrown = block(
            fit.body.materials[0],
            size=(0.48,) * 3,
            spacing=0.04,
            at=(0.013, 0.027, 0.26 + 0.75 * dx),
            velocity=(0, 0, -speed),
        )
        solver = solve([thrown], [wall], dx=dx, backend=backend)
        start = highest = solver.energies().total
        while solver.time < 0.05:
            solver.step(0.003)
            highest = max(highest, solver.energies().total)
        m = solver.measure
        checks += [
            Check(f"restitution {e}", float(m.momentum[0, 2] / m.mass[0]) / speed, e, 0.03),
            Check(f"restitution {e}: energy gained", max(highest / start - 1, 0.0), 0, 1e-12),
        ]
    return checks


def collinear_bars(backend: str) -> list[Check]:
    """A bar into a heavier one of its length and speed of sound: both part as if all were elastic.

    Waves of both come back to the contact at once, 2 L / c after it began, so that nothing goes on
    ringing (Johnson 1985, 11.1): delta-v is 2 m2 / (m1 + m2) times the speed.
    """
    speed, size = 0.5, (1.6, 0.2, 0.2)
    light = FixedCorotated(young=1.5e6, poisson=0, density=150)
    heavy = FixedCorotated(young=2.5e6, poisson=0, density=250)
    bodies = [
        block(light, size=size, spacing=0.025, at=(-0.81, 0, 0), velocity=(speed, 0, 0), name="a"),
        block(heavy, size=size, spacing=0.025, at=(0.81, 0, 0), name="b"),
    ]
    solver = solve(bodies, backend=backend, dx=0.05)
    solver.step(0.02 / speed + 4 * size[0] / light.wave_speed)
    m = solver.measure
    v = m.momentum[:, 0] / m.mass
    striker, struck = (2 * float(m.mass[1 - k] / m.mass.sum()) * speed for k in (0, 1))
    return [
        Check("collinear bars: delta-v, striker", speed - v[0], striker, 0.08 * striker, "m/s"),
        Check("collinear bars: delta-v, struck", float(v[1]), struck, 0.08 * struck, "m/s"),
    ]


def rest(backend: str) -> list[Check]:
    """A block dropped on the ground comes to rest on it: no gap, no sinking, the weight held."""
    body = block(RUBBER, size=(0.4, 0.4, 0.4), at=(0, 0, 0.3))
    solver = solve([body], [Plane(name="ground")], gravity=(0, 0, -GRAVITY), backend=backend)
    solver.step(1.5)
    before = float(solver.contacts[0].impulse[2])
    solver.step(0.2)
    force = (float(solver.contacts[0].impulse[2]) - before) / 0.2
    weight = body.particles.mass * GRAVITY
    lowest = float(np.min(solver.particles().positions[:, 2])) - 0.025
    return [
        Check("rest: gap below", lowest, 0, 0.025, "m"),
        Check("rest: weight held", force, weight, 0.02 * weight, "N"),
    ]


def rolling_ball(backend: str) -> list[Check]:
    """A ball set down sliding comes to roll, having lost 2/7 of its speed, whatever mu is.

    Being elastic it winds up and down a little while it sticks, so means over that count.
    """
    radius, speed = 0.5, 2.0
    particles = ball_particles(radius, spacing=0.05, density=1000)
    ball = Body(
        name="ball",
        particles=particles.moved(placed(0, 0, radius)),
        material=FixedCorotated(young=1e7, poisson=0.3, density=1000, viscosity=3000),
        velocity=(speed, 0, 0),
        friction=0.5,
    )
    solver = solve([ball], [Plane(name="road")], gravity=(0, 0, -GRAVITY), backend=backend)
    solver.step(0.15)
    speeds, rims = [], []
    for _ in range(10):
        solver.step(0.01)
        state = solver.state("ball")
        speeds.append(float(state.velocity[0]))
        rims.append(radius * float(state.angular_momentum[1] / particles.inertia[1, 1]))
    lost, rolling = speed - float(np.mean(speeds)), speed * 5 / 7
    return [
        Check("rolling ball: speed lost", lost, speed * 2 / 7, 0.05 * speed, "m/s"),
        Check("rolling ball: speed of the rim", float(np.mean(rims)), rolling, 0.1, "m/s"),
    ]
