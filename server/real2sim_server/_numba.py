"""How the small numerics of scenes, edits and worlds are compiled."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from numba import njit

compiled = njit(cache=True, error_model="numpy")
"""For functions that take microseconds: kept on disk, divisions as in NumPy.

Without ``nogil``, since whoever gives up the interpreter's lock may have to wait milliseconds to
get it back. Such a function calls none of another file, see :func:`compiled_from`.
"""

inner: Any = partial(njit, error_model="numpy")
"""Compiles functions that only compiled ones call; they are cached as part of those."""


def compiled_from(folder: Path) -> Callable[[Callable[..., Any]], Any]:
    """Like ``compiled``, for functions that call others of their folder.

    Numba's disk cache looks at the file that a function is in and at no other: after an upgrade
    that changes one of those it would go on with the old machine code. So the name of each
    carries a fingerprint of all sources in the folder.
    """
    mark = fingerprint(sorted(folder.glob("*.py")))

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{mark}"
        return compiled(function)

    return decorate


def fingerprint(sources: Iterable[Path]) -> str:
    """Eight hexadecimal digits that change with any of the files."""
    digest = hashlib.sha256()
    for path in sources:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]
