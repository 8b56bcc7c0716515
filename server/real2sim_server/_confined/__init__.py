"""Run functions on untrusted files in a separate process with limits.

An untrusted file can crash a parser, fill the memory or never finish. :func:`run_confined` isolates
this in a child process: it has no environment and cannot gain privileges, its memory, time and
written bytes are limited, and it can return only JSON or the files of a given folder. In every case
the caller gets a value or an error with the reason.
"""

from .run import ConfinedError, run_confined
from .starter import Limits

__all__ = ["ConfinedError", "Limits", "run_confined"]
