"""From bodies to a checked model: precision, grid, memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .backends.base import Model, ParticleArrays
from .body import Body
from .contact.surface import STICKS
from .errors import ParticleError, SolverError
from .materials import Material

PRECISIONS: dict[str, type[np.floating[Any]]] = {"single": np.float32, "double": np.float64}
BODIES_MAX = 4096
"""As many as the grid's block keys can tell apart."""
BYTES_PER_PARTICLE = {"single": 900, "double": 1400}
"""Peak while solving, saved state and float64 copies included; measured."""


def build_model(
    bodies: Sequence[Body], *, dx: float | None, gravity: ArrayLike, precision: str
) -> Model:
    """One model of all bodies.

    Raises:
        SolverError: for settings that are not allowed.
        ParticleError: when there are more particles than memory, or too sparse ones.
    """
    if not 0 < len(bodies) <= BODIES_MAX:
        raise SolverError(f"a solver takes 1 to {BODIES_MAX} bodies, not {len(bodies)}")
    names = [b.name for b in bodies]
    if len(set(names)) < len(names):
        raise SolverError(f"names of bodies must be unique, not {names}")
    if precision not in PRECISIONS:
        raise SolverError(f"unknown precision {precision!r}; allowed are {sorted(PRECISIONS)}")
    g = np.array(gravity, dtype=np.float64)
    if g.shape != (3,) or not np.isfinite(g).all():
        raise SolverError(f"gravity must be 3 finite numbers [m/s^2], not {gravity!r}")
    check_memory(sum(len(b.particles) for b in bodies), precision)
    spacing = max(float(np.median(np.cbrt(b.particles.volumes))) for b in bodies)
    cell = 2 * spacing if dx is None else float(dx)
    if not (np.isfinite(cell) and cell > 0):
        raise SolverError(f"dx must be a positive length [m], not {dx!r}")
    if spacing > cell:
        raise ParticleError(
            f"particles {spacing:.3g} m apart do not see each other on cells of {cell:.3g} m; "
            f"take dx of {2 * spacing:.3g} m, or fill with more particles"
        )
    return _assemble(bodies, cell, g, PRECISIONS[precision])


def check_memory(particles: int, precision: str) -> None:
    """Refuse what would not fit, before anything is allocated.

    Raises:
        ParticleError: with what is needed and what there is.
    """
    needed, free = particles * BYTES_PER_PARTICLE[precision], available_memory()
    if needed > 0.8 * free:
        raise ParticleError(
            f"{particles:,} particles need about {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; take larger cells or fewer bodies"
        )


def available_memory() -> int:
    """Memory this machine has left [bytes]."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _assemble(
    bodies: Sequence[Body], dx: float, gravity: Any, dtype: type[np.floating[Any]]
) -> Model:
    sizes = [len(b.particles) for b in bodies]
    body = np.repeat(np.arange(len(bodies)), sizes)
    materials: list[Material] = []
    index = []
    for b in bodies:
        index.append(np.asarray(b.regions) + len(materials))
        materials.extend(b.materials)
    elastic = np.concatenate([_deformation(b, "deformation") for b in bodies])
    total = np.concatenate([_deformation(b, "total_deformation") for b in bodies])
    positions = np.concatenate([b.particles.positions for b in bodies])
    return Model(
        start=ParticleArrays(
            positions,
            np.concatenate([b.velocities for b in bodies]),
            np.concatenate([b.gradients for b in bodies]),
            elastic,
            total,
            np.concatenate(
                [np.zeros(len(b.particles)) if b.history is None else b.history for b in bodies]
            ),
        ),
        masses=np.concatenate([b.particles.masses for b in bodies]),
        volumes=np.concatenate([b.particles.volumes for b in bodies]),
        material=np.concatenate(index),
        body=body,
        table=np.stack([m.row() for m in materials]),
        friction=np.array([min(b.friction, float(STICKS)) for b in bodies], np.float64),
        dx=dx,
        gravity=gravity,
        dtype=dtype,
    )


def _deformation(body: Body, name: str) -> Any:
    value = getattr(body, name)
    if value is None:
        value = body.deformation
    if value is None:
        return np.tile(np.eye(3), (len(body.particles), 1, 1))
    return value
