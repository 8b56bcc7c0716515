"""Solver kernels whose disk cache cannot be stale.

Numba's cache knows only the file that defines a kernel, not the laws it is made of: after an
upgrade that changes one of those it would run the old machine code. So the name of each entry
point carries a fingerprint of all sources.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from ..._numba import fingerprint
from ..constitutive.shared import FASTMATH

FOLDERS = (Path(__file__).parent, Path(__file__).parents[1] / "constitutive")
inner: Any = functools.partial(numba.njit, error_model="numpy", fastmath=FASTMATH)
"""Compiles functions that only entry points call; they are cached as part of those."""


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` for what Python calls: cached on disk, without the interpreter's lock."""

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ = f"{function.__qualname__}_{source_fingerprint()}"
        compiled = numba.njit(
            cache=True, nogil=True, error_model="numpy", fastmath=FASTMATH, **options
        )
        return compiled(function)

    return decorate


@functools.cache
def source_fingerprint() -> str:
    """Eight hexadecimal digits that change with any source a kernel is made of."""
    return fingerprint(path for folder in FOLDERS for path in sorted(folder.rglob("*.py")))
