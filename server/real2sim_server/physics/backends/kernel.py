"""Options of the solver's kernels; how they are kept on disk is in ``_numba``."""

from __future__ import annotations

import functools
from typing import Any

from ..._numba import func, kernel
from ..numerics.device import FASTMATH

inner: Any = functools.partial(func, fastmath=FASTMATH)
"""Compiles functions that only entry points call; they are kept as part of those."""

entry: Any = functools.partial(kernel, nogil=True, fastmath=FASTMATH)
"""Compiles what Python calls: kept on disk, without the interpreter's lock."""
