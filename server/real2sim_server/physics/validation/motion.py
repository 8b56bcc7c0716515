"""Motion that has exact answers: falling, shearing, spinning, scaling, conserving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..body import Body
from ..colliders import Plane
from ..materials import FixedCorotated
from .check import Check, block, solve

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

    The first step is exact. Later ones differ by O(dt^2): the field v = A x moves with itself, and
    the gradients particles carry lag behind by a step.
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
    """A free block at 60 rad/s keeps its angular momentum and its energy for a revolution."""
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
    """Two blocks that collide in space: mass, momentum, angular momentum, energy."""
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
    """Everything twice as large, E / rho times 4, g and v times 2: the same motion."""
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
    """The same run twice gives the same bits; particles in another order, the same motion."""
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
    """[N, 3] where the particles of a body are after it hit the ground [m]."""
    solver = solve([body], [Plane(name="ground")], gravity=(0, 0, -GRAVITY), backend=backend)
    solver.step(0.03)
    return solver.particles().positions
