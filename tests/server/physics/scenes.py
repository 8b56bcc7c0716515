"""Small bodies in motion, for every test of the solver."""

from __future__ import annotations

import numpy as np

from real2sim_server.physics import (
    Body,
    FixedCorotated,
    Plane,
    Solver,
    SolverOptions,
    box_particles,
)

SOFT = FixedCorotated(young=2e5, poisson=0.4)


def at(*position: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def cube(name="cube", position=(0.0, 0.0, 0.0), *, edge=0.3, material=SOFT, **options) -> Body:
    particles = box_particles([edge] * 3, spacing=0.05, density=200).moved(at(*position))
    return Body(name=name, particles=particles, material=material, **options)


def solve(bodies, colliders=(), **options) -> Solver:
    return Solver(bodies, colliders, SolverOptions(**{"dx": 0.1, **options}))


def ground(**options) -> Plane:
    return Plane(name="ground", **options)
