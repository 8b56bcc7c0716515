"""The caller's side of a confined call."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import structlog

from .starter import MIB, OUT_OF_MEMORY, REQUEST_BYTES, Limits

MAX_ANSWER_BYTES = 64 * MIB
STARTING_S = 60.0
"""Time to load the modules of a call, on top of the time of the call itself."""
_PROGRAM = "from real2sim_server._confined.starter import main; main()"
_KEPT_VARIABLES = ("TMPDIR", "HOME", "NUMBA_CACHE_DIR")
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

log = structlog.get_logger(__name__)


class ConfinedError(Exception):
    """A confined call did not finish; the message gives the reason.

    Attributes:
        out_of_memory: whether it exceeded its memory limit.
    """

    def __init__(self, reason: str, *, out_of_memory: bool = False) -> None:
        super().__init__(reason)
        self.out_of_memory = out_of_memory


def run_confined(
    target: str,
    arguments: Mapping[str, Any],
    *,
    limits: Limits | None = None,
    errors: tuple[type[Exception], ...] = (),
) -> Any:
    """Call a function in a separate process and return its value. Blocks; thread-safe.

    Args:
        target: ``module:function`` of this program.
        arguments: keywords of the function, JSON values; paths absolute.
        limits: resource limits.
        errors: exceptions of the function, built from one message, that are re-raised here.

    Raises:
        ConfinedError: out of memory or time, crashed, or an exception not among ``errors``.
    """
    limits = limits or Limits()
    request = {"target": target, "arguments": dict(arguments), "limits": asdict(limits)}
    lines = _STARTER.answer(json.dumps(request).encode(), limits.seconds + STARTING_S)
    try:
        told = [json.loads(line) for line in lines]
    except (ValueError, RecursionError) as error:
        raise ConfinedError("the process that read it returned no JSON") from error
    ended = told[-1]
    if ended["late"] or ended["exit"] == -signal.SIGXCPU:
        raise ConfinedError(f"exceeded the time limit of {limits.seconds:g} s")
    if len(told) != 2:
        raise ConfinedError(f"the process that read it ended with {_ending(ended['exit'])}")
    return _value(told[0], limits, errors)


def _value(told: Mapping[str, Any], limits: Limits, errors: tuple[type[Exception], ...]) -> Any:
    kind = told.get("error")
    if kind is None:
        return told["value"]
    if kind == OUT_OF_MEMORY:
        reason = f"needs more than {limits.memory_bytes // MIB} MiB of memory"
        raise ConfinedError(reason, out_of_memory=True)
    for error in errors:
        if kind == error.__name__:
            raise error(told["message"])
    log.error("confined call failed", error=kind, trace=told.get("trace"))
    raise ConfinedError(f"{kind}: {told['message']}")


def _ending(status: int) -> str:
    if status >= 0:
        return f"exit code {status}"
    try:
        return f"signal {signal.Signals(-status).name}"
    except ValueError:
        return f"signal {-status}"


class _Starter:
    """The starter's process, started on the first call and restarted if it ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._owner = 0

    def answer(self, request: bytes, seconds: float) -> list[bytes]:
        """Lines from child and starter: the outcome, if any, and the exit of the child.

        Raises:
            ConfinedError: the request or answer is too long, or there is no answer.
        """
        if len(request) > REQUEST_BYTES:
            raise ConfinedError(f"a request of {len(request)} bytes is too long")
        mine, theirs = socket.socketpair()
        with mine:
            with theirs:
                self._send(request, theirs)
            mine.settimeout(seconds)
            try:
                told = _read_all(mine)
            except TimeoutError:
                self.close()
                raise ConfinedError("the process that reads it does not answer") from None
        lines = told.splitlines()
        if not lines or not told.endswith(b"\n"):
            self.close()
            raise ConfinedError("the process that reads it has ended")
        return lines

    def _send(self, request: bytes, theirs: socket.socket) -> None:
        with self._lock:
            try:
                socket.send_fds(self._connected(), [request], [theirs.fileno()])
            except OSError:
                # The starter has ended; an operator may have killed it.
                self._stop()
                socket.send_fds(self._connected(), [request], [theirs.fileno()])

    def _connected(self) -> socket.socket:
        if self._control is None or self._owner != os.getpid():
            mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", _PROGRAM],
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=_environment(),
                    cwd="/",
                    start_new_session=True,
                )
            self._control, self._owner = mine, os.getpid()
        return self._control

    def close(self) -> None:
        """End the starter and its children."""
        with self._lock:
            self._stop()

    def _stop(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _environment() -> dict[str, str]:
    """Environment of the child: only the module paths."""
    kept = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
    paths = [os.path.abspath(entry) for entry in sys.path]
    return kept | dict.fromkeys(_ONE_THREAD, "1") | {"PYTHONPATH": os.pathsep.join(paths)}


def _read_all(stream: socket.socket) -> bytes:
    parts: list[bytes] = []
    total = 0
    while part := stream.recv(1 << 16):
        total += len(part)
        if total > MAX_ANSWER_BYTES:
            raise ConfinedError(f"its answer is longer than {MAX_ANSWER_BYTES} bytes")
        parts.append(part)
    return b"".join(parts)


_STARTER = _Starter()


@atexit.register
def _at_exit() -> None:
    with contextlib.suppress(Exception):
        _STARTER.close()
