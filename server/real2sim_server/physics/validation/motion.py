"""Motion and contact with exact answers: free fall, shear, spin, friction, rebound, gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from .. import stress
from ..backends.reference import TorchParameters, TorchState, substep, torch_model, with_stress
from ..body import Body, ball_particles
from ..colliders import Plane
from ..fitting import fit_restitution
from ..materials import FixedCorotated, Metal
from ..solver import SolverOptions
from .check import Check, ReferenceCurve, block, placed, solve

GRAVITY = 9.81


def free_fall(backend: str, *, edge: float = 0.4, steps: int = 100) -> list[Check]:
    """A falling block: symplectic Euler gives z0 - g t (t + dt) / 2, and F stays I."""
    dt = 1e-4
    body = block(FixedCorotated(young=2e6), size=(edge,) * 3)
    solver = solve([body], gravity=(0, 0, -GRAVITY), backend=backend, dt_max=dt)
    solver.step(steps * dt)
    fallen = float(solver.measure.centre[0, 2])
    F = solver.particles().F_elastic
    exact = -GRAVITY * steps * dt * (steps + 1) * dt / 2
    return [
        Check("free fall: height", fallen, exact, 1e-6, "m"),
        Check("free fall: |F - I|", float(np.abs(F - np.eye(3)).max()), 0, 1e-6),
    ]


def affine_patch(backend: str, *, edge: float = 0.4) -> list[Check]:
    """v = A x on a block without stiffness: C = A, F = (I + dt A)^n.

    The first step is exact. Later ones differ by O(dt^2): the field v = A x is advected, and
    particle gradients lag behind by a step.
    """
    A = np.array([[0.3, -0.2, 0.1], [0.5, -0.4, 0.2], [-0.1, 0.6, 0.2]])
    size = (edge,) * 3
    still = block(FixedCorotated(young=1e-9), size=size)
    x = still.particles.positions
    moving = block(
        FixedCorotated(young=1e-9),
        size=size,
        particle_velocities=x @ A.T,
        particle_gradients=np.tile(A, (len(x), 1, 1)),
    )
    solver = solve([moving], backend=backend, dt_max=1e-3)
    solver.step(1e-3)
    error_C = float(np.abs(solver.particles().gradients - A).max())
    first = float(np.abs(solver.particles().F_elastic - np.eye(3) - 1e-3 * A).max())
    solver.step(4e-3)
    F = np.linalg.matrix_power(np.eye(3) + 1e-3 * A, 5)
    later = float(np.abs(solver.particles().F_elastic - F).max())
    return [
        Check("affine patch: |C - A|", error_C, 0, 1e-12),
        Check("affine patch: |F - (I + dt A)|", first, 0, 1e-12),
        Check("affine patch: |F - (I + dt A)^5|", later, 0, 10 * 1e-6),
    ]


def spin(backend: str, *, edge: float = 0.48, turns: float = 1.0) -> list[Check]:
    """A free block at 60 rad/s keeps its angular momentum and energy for a revolution."""
    material = FixedCorotated(young=2e6, poisson=0.4)
    body = block(material, size=(edge,) * 3, spacing=0.06, angular_velocity=(0, 0, 60.0))
    solver = solve([body], backend=backend, dx=0.12)
    start = solver.measure
    solver.step(turns * 2 * np.pi / 60)
    end = solver.measure
    turn = float(end.angular_momentum[0, 2] / start.angular_momentum[0, 2])
    kinetic = float(end.kinetic[0] / start.kinetic[0])
    return [
        Check("spin: angular momentum kept", turn, 1, 1e-6),
        Check("spin: kinetic energy kept", kinetic, 1, 0.02),
    ]


def invariants(backend: str, *, edge: float = 0.4, parts: int = 10) -> list[Check]:
    """Two blocks that collide in free space: mass, momentum, angular momentum, energy."""
    material = FixedCorotated(young=2e5, poisson=0.3)
    size, away = (edge,) * 3, 0.625 * edge
    bodies = [
        block(material, size=size, at=(-away, 0, 0), velocity=(1.5, 0, 0), name="left"),
        block(
            material, size=size, at=(away, edge / 4, edge / 8), velocity=(-1.5, 0, 0), name="right"
        ),
    ]
    solver = solve(bodies, backend=backend)
    start, energy = solver.measure, solver.energies().total
    highest = energy
    for _ in range(parts):
        solver.step(0.006)
        highest = max(highest, solver.energies().total)
    end = solver.measure
    scale = float(np.abs(start.momentum).sum())
    drift = float(np.abs(end.momentum.sum(0) - start.momentum.sum(0)).max()) / scale
    spins = end.angular_momentum.sum(0) - start.angular_momentum.sum(0)
    pushed = sum(float(np.linalg.norm(c.impulse)) for c in solver.contacts)
    return [
        Check("invariants: mass", float(end.mass.sum() / start.mass.sum()), 1, 1e-12),
        Check("invariants: momentum", drift, 0, 1e-12),
        Check("invariants: angular momentum", float(np.abs(spins).max()) / scale, 0, 1e-12, "m"),
        Check("invariants: energy gained", max(highest / energy - 1, 0), 0, 1e-3),
        Check("invariants: they did collide", float(pushed > 0.1 * scale), 1, 0),
    ]


def scale_invariance(backend: str) -> list[Check]:
    """Lengths times 2, E / rho times 4, g and v times 2: the same motion."""
    ends = []
    for s in (1.0, 2.0):
        body = block(
            FixedCorotated(young=2e5 * s**2, poisson=0.4),
            size=(0.4 * s,) * 3,
            spacing=0.05 * s,
            at=(0.01 * s, 0.02 * s, 0.21 * s),
            velocity=(0.5 * s, 0, -1.0 * s),
        )
        solver = solve(
            [body],
            [Plane(name="ground")],
            dx=0.1 * s,
            gravity=(0, 0, -GRAVITY * s),
            backend=backend,
            dt_max=5e-4,
        )
        solver.step(0.05)
        ends.append(solver.particles().positions / s)
    error = float(np.abs(ends[1] - ends[0]).max())
    return [Check("scale invariance: positions", error, 0, 1e-9, "m")]


def reproducibility(backend: str) -> list[Check]:
    """Equal runs are bitwise identical; another particle order gives the same motion."""
    body = block(
        FixedCorotated(young=2e5, poisson=0.4), at=(0.01, 0.02, 0.21), velocity=(0.5, 0, -2)
    )
    shuffled = np.random.default_rng(0).permutation(len(body.particles))
    first, again, other = (
        _drop(replace(body, particles=body.particles.take(order)), backend)
        for order in (np.arange(len(shuffled)), np.arange(len(shuffled)), shuffled)
    )
    moved = float(np.abs(first - body.particles.positions).max())
    differing = float((first.view(np.uint64) != again.view(np.uint64)).sum())
    return [
        Check("reproducibility: numbers that differ in a second run", differing, 0, 0),
        Check(
            "reproducibility: particles in another order",
            float(np.abs(other - first[shuffled]).max()),
            0,
            1e-9 * moved,
            "m",
        ),
    ]


def _drop(body: Body, backend: str) -> np.ndarray:
    """[N, 3] particle positions of a body after it has hit the ground [m]."""
    solver = solve([body], [Plane(name="ground")], gravity=(0, 0, -GRAVITY), backend=backend)
    solver.step(0.03)
    return solver.particles().positions


# Gradients through the reference backend against central differences.

STEPS, DT = 60, 5e-4


def gradients(backend: str = "reference") -> list[Check]:
    """Derivatives of a bounce by stiffness, yield stress, viscosity, friction and speed."""
    metal = Metal(young=2e5, poisson=0.3, yield_stress=4e3, hardening=1e4, viscosity=50)
    body = block(
        metal, size=(0.2, 0.2, 0.2), at=(0.013, 0.027, 0.12), velocity=(1, 0.2, -2), friction=0.3
    )
    state, params = torch_model(solve([body], backend="reference").model)
    names = ("stiffness", "yield stress", "viscosity", "friction", "speed")
    knobs = torch.zeros(len(names), dtype=torch.float64, requires_grad=True)
    outcome = _outcome(state, params)
    [slopes] = torch.autograd.grad(outcome(knobs), [knobs])
    checks = []
    for i, name in enumerate(names):
        step = torch.zeros_like(knobs)
        step[i] = 1e-5
        with torch.no_grad():
            slope = float((outcome(knobs + step) - outcome(knobs - step)) / 2e-5)
        checks.append(Check(f"gradient: {name}", float(slopes[i]), slope, 1e-3 * abs(slope)))
    return checks


def _outcome(state: TorchState, params: TorchParameters) -> Callable[[Tensor], Tensor]:
    """Final motion as one number, as a function of the logarithms of factors on five parameters."""

    def run(knobs: Tensor) -> Tensor:
        factor = knobs.exp()
        ones = torch.ones_like(factor[0])
        columns = [ones] * stress.MATERIAL_ROW
        columns[stress.MU] = columns[stress.LAMBDA] = factor[0]
        columns[stress.A], columns[stress.VISCOSITY] = factor[1], factor[2]
        changed = replace(
            params,
            rows=params.rows * torch.stack(columns),
            friction=params.friction * factor[3],
        )
        now = with_stress(replace(state, v=state.v * factor[4]), changed)
        for _ in range(STEPS):
            now, _ = substep(now, changed, [Plane(name="ground")], DT)
        momentum = (params.mass[:, None] * now.v).sum(0)
        return momentum @ torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)

    return run


# Contact: friction, rebound, impulse.

RUBBER = FixedCorotated(young=2e5, poisson=0.2, viscosity=200)
"""Damped material, so that a block placed on a surface comes to rest and stays in contact."""


def incline(backend: str, *, duration: float = 5.0) -> list[Check]:
    """A block on a slope of 24 degrees slides at g (sin - mu cos), or sticks (Matter's test)."""
    slope = math.radians(24)
    gravity = (GRAVITY * math.sin(slope), 0.0, -GRAVITY * math.cos(slope))
    checks = []
    for name, mu, lasts in (("slides", math.tan(math.radians(15)), duration), ("sticks", 0.6, 0.5)):
        body = block(RUBBER, size=(0.6, 0.6, 0.3), at=(0, 0, 0.15), friction=mu)
        solver = solve([body], [Plane(name="slope")], gravity=gravity, backend=backend)
        # The block first settles against the slope.
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
    """A sliding block stops after v^2 / (2 mu g) and v / (mu g)."""
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
    """A block hits a wall and slides: the impulse is inclined by mu, and delta-v agrees."""
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
    """Two pressed blocks that slide with mu = 0 keep their slip, touch, and separate.

    They are stiff enough that edges do not dig in, as this would brake them.
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
    """Requested and achieved restitution, in an impact after the fit, without energy gain."""
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
    """A bar into a heavier one of the same length and speed of sound: elastic delta-v of both.

    Waves of both bars return to the contact at the same time, 2 L / c after it began, so no
    vibration remains (Johnson 1985, 11.1): delta-v is 2 m2 / (m1 + m2) times the speed.
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
    """A block dropped on the ground comes to rest: no gap, no sinking, force equal to weight."""
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
    """A ball set down sliding starts to roll after losing 2/7 of its speed, for any mu.

    The elastic ball twists back and forth a little while it sticks, so mean values are compared.
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
