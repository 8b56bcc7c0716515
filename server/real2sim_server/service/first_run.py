"""A second process that compiles kernels; on the first run it begins before libraries are loaded.

Numba compiles one function at a time in a process, so a second one beside the worker halves the
wait on two cores. It imports what the worker imports, which takes seconds: so ``real2sim serve``
lets it begin first, where nothing of an earlier run lies on disk.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

KEPT = "entries.advance_vehicle-*.nbi"
"""Index of the kernel that takes longest, as Numba names it."""

SERVER = Path(__file__).parents[1]
LOWEST_PRIORITY = 19

_begun: list[subprocess.Popen[bytes]] = []


def begin_compiling() -> None:
    """Let the second process begin if no earlier run has left kernels. Reads no kernel's sources:
    whether those on disk are still good is found out later."""
    if (os.cpu_count() or 1) > 1 and not _any_on_disk():
        _begun.append(compile_beside("warm_up"))


def take_begun() -> subprocess.Popen[bytes] | None:
    """The process of :func:`begin_compiling`, for whoever waits for it; None if it began none."""
    return _begun.pop() if _begun else None


def compile_beside(function: str, *, niceness: int = 0) -> subprocess.Popen[bytes]:
    """A process that runs a function of the world's warm-up. Its failure is left to those who load
    its work."""
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, function, str(niceness)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _any_on_disk() -> bool:
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    beside = SERVER / "world" / "driving" / "__pycache__"
    found = Path(elsewhere).rglob(KEPT) if elsewhere else beside.glob(KEPT)
    return any(found)


_PROGRAM = """
import gc, os, sys
gc.disable()
os.nice(int(sys.argv[2]))
import real2sim_server.world
getattr(real2sim_server.world, sys.argv[1])()
"""
