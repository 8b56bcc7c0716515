"""A second process that compiles kernels; on the first run it begins before libraries are loaded.

Numba compiles one function at a time in a process, so a second one beside the worker halves the
wait on two cores. It imports what the worker imports, which takes seconds: so ``real2sim serve``
lets it begin first, where nothing of an earlier run lies on disk.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

KEPT = "entries.advance_vehicle-*.nbi"
"""Index of the kernel that takes longest, as Numba names it."""

SERVER = Path(__file__).parents[1]
LOWEST_PRIORITY = 19
POLL_S = 0.05

_begun: list[subprocess.Popen[bytes]] = []


def begin_compiling() -> None:
    """Let the second process begin if no earlier run has left kernels. Reads no kernel's sources:
    whether those on disk are still good is found out later."""
    if (os.cpu_count() or 1) > 1 and not _any_on_disk():
        _begun.append(compile_beside("warm_up"))


def take_begun() -> subprocess.Popen[bytes] | None:
    """The process of :func:`begin_compiling`, for whoever waits for it; None if it began none."""
    return _begun.pop() if _begun else None


def compile_beside(
    function: str, *arguments: str, package: str = "world", niceness: int = 0
) -> subprocess.Popen[bytes]:
    """A process that runs a warm-up of ``package``. Its failure is left to those who load its
    work."""
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(niceness), package, function, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@asynccontextmanager
async def awaited(process: subprocess.Popen[bytes]) -> AsyncIterator[None]:
    """A process beside the block, which is waited for at its end and does not outlive it."""
    try:
        yield
        while process.poll() is None:
            await asyncio.sleep(POLL_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def _any_on_disk() -> bool:
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    beside = SERVER / "world" / "driving" / "__pycache__"
    found = Path(elsewhere).rglob(KEPT) if elsewhere else beside.glob(KEPT)
    return any(found)


_PROGRAM = """
import gc, importlib, os, sys
gc.disable()
niceness, package, function, *arguments = sys.argv[1:]
os.nice(int(niceness))
getattr(importlib.import_module("real2sim_server." + package), function)(*arguments)
"""
