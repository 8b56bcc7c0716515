"""A second process that compiles kernels; on the first run it begins before libraries are loaded.

Numba compiles one function at a time in a process, so a second one beside the worker halves the
wait on two cores. It imports what the worker imports, which takes seconds: so ``real2sim serve``
lets it begin first, where nothing of an earlier run lies on disk.
"""

from __future__ import annotations

import asyncio
import contextlib
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
    work. It writes a line of two numbers for each kernel: those that are ready, and all."""
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(niceness), package, function, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
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
        process.communicate()


class Counter:
    """How many kernels a process of :func:`compile_beside` has made ready.

    Attributes:
        done: so far.
        expected: of all; 0 before it begins.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        self._output = process.stdout.fileno()
        os.set_blocking(self._output, False)
        self._rest = b""
        self.done = self.expected = 0

    def read(self) -> None:
        """Take in what it has written."""
        with contextlib.suppress(BlockingIOError, ValueError):
            while part := os.read(self._output, 4096):
                *lines, self._rest = (self._rest + part).split(b"\n")
                if lines:
                    self.done, self.expected = map(int, lines[-1].split())


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
from real2sim_server import _numba
_numba.Made.tell = lambda made: print(made.done, made.expected, flush=True)
getattr(importlib.import_module("real2sim_server." + package), function)(*arguments)
"""
