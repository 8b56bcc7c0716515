"""Steps before heavy libraries are loaded: check the arguments, compile kernels."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from ..settings import Settings
from .storage.connection import check_state_folder

# --- Checks ---------------------------------------------------------------------------------------


class SceneFolderError(ValueError):
    """The named scene folder does not exist."""


class AddressError(OSError):
    """The address is not available."""


def check_start(settings: Settings) -> None:
    """Refuse to start if the settings cannot work.

    Raises:
        SceneFolderError: the scene folder is missing.
        StateFolderError: another worker uses the state folder, or it is not writable.
        AddressError: the address is in use, or does not belong to this machine.
    """
    check_scenes(settings)
    check_state_folder(settings.data_dir)
    bind(settings.host, settings.port).close()


def check_scenes(settings: Settings) -> None:
    """Raises SceneFolderError if a named scene folder does not exist."""
    folder = settings.scenes_dir
    if folder is None or folder.is_dir():
        return
    problem = "is not a folder" if folder.exists() else "does not exist"
    raise SceneFolderError(
        f"the scene folder {str(folder)!r} {problem}: name the folder that holds the scene bundles "
        f"with --scenes or REAL2SIM_SCENES_DIR, or make an empty one: mkdir -p {folder}"
    )


def bind(host: str, port: int) -> socket.socket:
    """A socket bound to the address, not yet listening; port 0 uses a free one.

    Raises:
        AddressError: the address cannot be used; the message states the remedy.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise _unusable(host, port, error) from error
    # Only for sockets declared as TCP does asyncio disable Nagle's algorithm. With it, every reply
    # would wait 40 ms for an acknowledgement.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        listener.close()
        raise _unusable(host, port, error) from error
    return listener


def listen(listener: socket.socket) -> None:
    """Accept connections on a bound socket. Raises AddressError if it has been taken since."""
    host, port = listener.getsockname()[:2]
    try:
        listener.listen(2048)
    except OSError as error:
        listener.close()
        raise _unusable(host, port, error) from error


def url_of(host: str, listener: socket.socket) -> str:
    """Address of a bound socket for clients, for example ``http://127.0.0.1:8600``."""
    return f"http://{_in_url(host)}:{listener.getsockname()[1]}"


def _unusable(host: str, port: int, error: OSError) -> AddressError:
    address = f"{_in_url(host)}:{port}"
    if error.errno == errno.EADDRINUSE:
        return AddressError(
            f"{address} is in use already: another program, perhaps another worker, listens on "
            f"port {port}. Stop it, or give another port with --port or REAL2SIM_PORT; 0 picks a "
            "free one"
        )
    return AddressError(
        f"cannot listen on {address}: {error.strerror or error}. Give an address of this machine "
        "with --host or REAL2SIM_HOST, and a port with --port or REAL2SIM_PORT"
    )


def _in_url(host: str) -> str:
    try:
        version = ipaddress.ip_address(host).version
    except ValueError:
        version = 4
    return f"[{host}]" if version == 6 else host


# --- Compiling in a second process ----------------------------------------------------------------

# Numba compiles one function at a time per process, so a second process halves the wait on two
# cores. ``real2sim serve`` starts it before its own imports if no compiled kernels are on disk.

KEPT = "entries.advance_vehicle-*.nbi"
"""Numba's index of the slowest kernel to compile."""

SERVER = Path(__file__).parents[1]
LOWEST_PRIORITY = 19
POLL_S = 0.05

_begun: list[subprocess.Popen[bytes]] = []


def begin_compiling() -> None:
    """Start the second process if no kernels of an earlier run exist. Does not check whether cached
    kernels are valid."""
    if (os.cpu_count() or 1) > 1 and not _any_on_disk():
        _begun.append(compile_in_background("warm_up"))


def take_begun() -> subprocess.Popen[bytes] | None:
    """The process of :func:`begin_compiling` to wait for; None if none was started."""
    return _begun.pop() if _begun else None


def compile_in_background(
    function: str, *arguments: str, package: str = "world", niceness: int = 0
) -> subprocess.Popen[bytes]:
    """A process that runs a warm-up of ``package``. Failures are reported when kernels are loaded.
    For each kernel it writes a line with two numbers: ready kernels, and the total."""
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(niceness), package, function, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


@asynccontextmanager
async def awaited(process: subprocess.Popen[bytes]) -> AsyncIterator[None]:
    """A process that runs during the block; leaving the block waits for it."""
    try:
        yield
        while process.poll() is None:
            await asyncio.sleep(POLL_S)
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


class Counter:
    """Progress of a process of :func:`compile_in_background`.

    Attributes:
        done: number of kernels that are ready.
        expected: total number; 0 before it begins.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        self._output = process.stdout.fileno()
        os.set_blocking(self._output, False)
        self._rest = b""
        self.done = self.expected = 0

    def read(self) -> None:
        """Read the process's new output."""
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
