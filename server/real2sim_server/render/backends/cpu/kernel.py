"""Numba kernels whose disk cache cannot be stale.

Numba's cache knows only the file that defines a kernel, not the constants and functions it takes
from other modules: after an upgrade that changes one of those it would run the old machine code.
So the name of each kernel carries a fingerprint of all kernel sources.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from ...._numba import fingerprint

FOLDER = Path(__file__).parent


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` for entry points: cached on disk, free of the GIL, divisions as in NumPy."""

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{source_fingerprint()}"
        return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)

    return decorate


def inlined(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` for what kernels call for each Gaussian; may not allocate.

    Without ``_nrt=False`` each array that is passed or sliced is counted up and down by atomic
    instructions, which take several times as long as the work itself.
    """
    return numba.njit(forceinline=True, error_model="numpy", _nrt=False, **options)


@functools.cache
def source_fingerprint() -> str:
    """Eight hexadecimal digits that change with any source a kernel is made of."""
    return fingerprint((FOLDER.parent / "base.py", *sorted(FOLDER.glob("*.py"))))
