"""Which backend computes."""

from __future__ import annotations

import functools

from ..errors import SolverError
from .base import SolverBackend

BACKENDS = ("cpu", "cuda", "reference")


@functools.cache
def select_backend(name: str = "auto") -> SolverBackend:
    """The one backend of that name.

    Args:
        name: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``: a device is used only
            when asked for, as its last bits are not the CPU's.

    Raises:
        SolverError: for an unknown name, or for ``cuda`` where no device is usable.
    """
    if name in ("auto", "cpu"):
        from .cpu.backend import CpuSolverBackend

        return CpuSolverBackend()
    if name == "cuda":
        from .cuda.backend import CudaSolverBackend

        return CudaSolverBackend()
    if name == "reference":
        from .reference.backend import ReferenceSolverBackend

        return ReferenceSolverBackend()
    raise SolverError(f"unknown backend {name!r}; allowed are 'auto' and {list(BACKENDS)}")
