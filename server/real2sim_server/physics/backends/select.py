"""Which backend computes."""

from __future__ import annotations

import functools

from ..errors import SolverError
from .base import Backend

BACKENDS = ("cpu", "reference")


@functools.cache
def select_backend(name: str = "auto") -> Backend:
    """The one backend of that name.

    Args:
        name: ``cpu``, ``reference``, or ``auto``, which is the fastest usable here.

    Raises:
        SolverError: for an unknown name.
    """
    if name in ("auto", "cpu"):
        from .cpu import CpuBackend

        return CpuBackend()
    if name == "reference":
        from .reference import ReferenceBackend

        return ReferenceBackend()
    raise SolverError(f"unknown backend {name!r}; allowed are 'auto' and {list(BACKENDS)}")
