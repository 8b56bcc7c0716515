"""Which backend computes."""

from __future__ import annotations

import functools

from ..errors import SolverError
from .base import Backend

BACKENDS = ("cpu", "cuda", "reference")


@functools.cache
def select_backend(name: str = "auto") -> Backend:
    """The one backend of that name.

    Args:
        name: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``: a device is used only
            when asked for, as its sums differ in the last bits from run to run.

    Raises:
        SolverError: for an unknown name, or for ``cuda`` where no device is usable.
    """
    if name in ("auto", "cpu"):
        from .cpu.backend import CpuBackend

        return CpuBackend()
    if name == "cuda":
        from .cuda.backend import CudaBackend

        return CudaBackend()
    if name == "reference":
        from .reference.backend import ReferenceBackend

        return ReferenceBackend()
    raise SolverError(f"unknown backend {name!r}; allowed are 'auto' and {list(BACKENDS)}")
