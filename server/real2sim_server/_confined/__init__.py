"""Run functions on untrusted files in a separate process with limits.

An untrusted file may crash a parser, fill the memory or never end. :func:`run_confined` lets a
child process have that trouble: it has no environment, no privileges to gain, limits of memory,
time and written bytes, and can tell nothing but JSON or the files of a folder it was given. However
it ends, the caller gets a value or an error that says why.
"""

from .run import ConfinedError, run_confined
from .starter import Limits

__all__ = ["ConfinedError", "Limits", "run_confined"]
