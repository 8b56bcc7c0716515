"""How the small numerics of scenes, edits and worlds are compiled."""

from __future__ import annotations

from numba import njit

compiled = njit(cache=True, error_model="numpy")
"""For functions that take microseconds: kept on disk, divisions as in NumPy.

Without ``nogil``, since whoever gives up the interpreter's lock may have to wait milliseconds to
get it back. Such a function calls none of another file: Numba's disk cache looks at the file that
a function is in and at no other, so it would go on with what that other file once said.
"""
