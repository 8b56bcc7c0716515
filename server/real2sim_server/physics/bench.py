"""``real2sim bench physics``: particle-substeps per second, and what they depend on."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np

from ..scene.io.atomic import atomic_file
from .body import Body
from .colliders import Plane
from .materials import Jelly, Material, NeoHookean
from .particles import box_particles
from .solver import Solver, SolverOptions

SIZES = (10_000, 100_000, 1_000_000)
MATERIALS: dict[str, Material] = {
    "fixed_corotated": Jelly(young=2e6, poisson=0.4),
    "neo_hookean": NeoHookean(young=2e6, poisson=0.4),
}
PARTICLES_PER_CELL = 14
SPACING = 0.05
REPEATS = 8
"""The best of this many runs counts: other work on the machine only ever makes them slower."""
SECONDS_PER_RUN = 0.3
REFERENCE_PARTICLES = 2_000
TARGETS = {"fixed_corotated": 10e6, "neo_hookean": 13e6}
"""Particle-substeps per second of 100,000 particles on two cores."""


def run(*, peers: bool = False, json_path: Path | None = None) -> dict[str, Any]:
    """Measure the solver and return the figures; written to ``json_path``, too, when given.

    ``rate`` is in particle-substeps per second, elapsed, the best of REPEATS runs; ``cpu_rate`` is
    per second of processor time and thread, which says what an otherwise idle machine would do.
    """
    report = {
        "threads": numba.get_num_threads(),
        "cores": os.cpu_count(),
        "particles_per_cell": PARTICLES_PER_CELL,
        "repeats": REPEATS,
        "speed": [_speed(m, n) for m in MATERIALS for n in SIZES],
        "domain": _domain(),
        "reference": _reference(),
        "targets": TARGETS,
    }
    if json_path is not None:
        with atomic_file(json_path) as file:
            file.write(json.dumps(report, indent=2).encode() + b"\n")
    return report


def _speed(material: str, particles: int) -> dict[str, Any]:
    """Rate of a turning, falling block of about that many particles."""
    solver = Solver([_block(material, particles)], [Plane(name="ground")], _options())
    elapsed, processor = _time_substep(solver)
    count = len(solver.model.masses)
    return {
        "material": material,
        "particles": count,
        "rate": count / elapsed,
        "cpu_rate": count / processor,
        "substep_ms": 1e3 * elapsed,
    }


def _domain() -> list[dict[str, Any]]:
    """Two blocks of 50,000 particles, ever further apart: the cost stays."""
    rows = []
    for distance in (4.0, 100.0, 2_000.0):
        blocks = [_block("fixed_corotated", 50_000, x, str(x)) for x in (0.0, distance)]
        solver = Solver(blocks, (), _options())
        elapsed, processor = _time_substep(solver)
        rows.append(
            {
                "distance": distance,
                "rate": len(solver.model.masses) / elapsed,
                "cpu_rate": len(solver.model.masses) / processor,
            }
        )
    return rows


def _reference() -> dict[str, Any]:
    """How many times faster than plain torch."""
    rates = {}
    for backend in ("cpu", "reference"):
        body = _block("fixed_corotated", REFERENCE_PARTICLES)
        solver = Solver([body], (), _options(backend))
        elapsed, _ = _time_substep(solver)
        rates[backend] = len(body.particles) / elapsed
    return {"particles": REFERENCE_PARTICLES, **rates, "ratio": rates["cpu"] / rates["reference"]}


def _block(material: str, particles: int, x: float = 0.0, name: str = "block") -> Body:
    edge = SPACING * round(particles ** (1 / 3))
    kind = MATERIALS[material]
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, edge / 2 + 5.0
    matter = box_particles([edge] * 3, spacing=SPACING, density=kind.density).moved(pose)
    return Body(
        name=name, particles=matter, material=kind, velocity=(0, 0, -2), angular_velocity=(1, 0, 0)
    )


def _options(backend: str = "cpu") -> SolverOptions:
    return SolverOptions(dx=SPACING * PARTICLES_PER_CELL ** (1 / 3), backend=backend)


def _time_substep(solver: Solver) -> tuple[float, float]:
    """Shortest elapsed time of a substep [s], and processor time per thread [s]; guard left out."""
    simulation, dt = solver.simulation, solver.time_step()
    simulation.advance(2, dt, solver.colliders)
    begin = time.perf_counter()
    simulation.advance(1, dt, solver.colliders)
    steps = max(int(SECONDS_PER_RUN / (time.perf_counter() - begin)), 1)
    best = [float("inf"), float("inf")]
    for _ in range(REPEATS):
        begin, used = time.perf_counter(), time.process_time()
        simulation.advance(steps, dt, solver.colliders)
        taken = time.perf_counter() - begin, time.process_time() - used
        best[0] = min(best[0], taken[0] / steps)
        best[1] = min(best[1], taken[1] / steps / numba.get_num_threads())
    return best[0], best[1]
