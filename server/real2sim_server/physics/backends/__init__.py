"""Solver backends, which implement one Protocol."""

from __future__ import annotations

import functools

from ..errors import SolverError
from ..model import Measure, Model, ParticleArrays, Simulation, SolverBackend

__all__ = [
    "BACKENDS",
    "Measure",
    "Model",
    "ParticleArrays",
    "Simulation",
    "SolverBackend",
    "select_backend",
]

BACKENDS = ("cpu", "cuda", "reference")


@functools.cache
def select_backend(name: str = "auto") -> SolverBackend:
    """Return the backend with this name.

    Args:
        name: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``. A GPU is only used on
            request, because its results differ from the CPU's in the last bits.

    Raises:
        SolverError: for an unknown name, or for ``cuda`` without a usable device.
    """
    if name in ("auto", "cpu"):
        from .cpu.backend import CpuSolverBackend

        return CpuSolverBackend()
    if name == "cuda":
        from .cuda.backend import CudaSolverBackend

        return CudaSolverBackend()
    if name == "reference":
        from .reference import ReferenceSolverBackend

        return ReferenceSolverBackend()
    raise SolverError(f"unknown backend {name!r}; allowed are 'auto' and {list(BACKENDS)}")
