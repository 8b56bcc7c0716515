"""Options of the renderer's kernels; how they are kept on disk is in ``_numba``."""

from __future__ import annotations

import functools
from typing import Any

from ...._numba import func
from ...._numba import kernel as cached_kernel

kernel: Any = functools.partial(cached_kernel, nogil=True)
"""For entry points: they take long enough to let other threads of Python run."""

inlined: Any = functools.partial(func, forceinline=True, _nrt=False)
"""For what kernels call for each Gaussian; may not allocate.

Without ``_nrt=False`` each array that is passed or sliced is counted up and down by atomic
instructions, which take several times as long as the work itself.
"""
