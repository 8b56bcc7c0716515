"""The process that starts confined ones: it forks a child for each request and reads no file.

A program that has its modules loaded forks in milliseconds, where a new interpreter takes seconds.
The starter has one thread and one socket to the process that began it, and ends with that one.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import select
import signal
import socket
import time
import traceback
from dataclasses import dataclass
from typing import Any

from .limits import Limits, apply_limits

REQUEST_BYTES = 1 << 16
OUT_OF_MEMORY = "out of memory"
_MEMORY = ("allocate memory", "failed to map segment", "bad_alloc")
"""Parts of messages of libraries that have no type of error for a lack of memory."""


@dataclass
class _Child:
    """A child at work.

    Attributes:
        answer: the caller's socket.
        deadline: when it is ended, by the monotonic clock.
        late: whether it was.
    """

    answer: int
    deadline: float
    late: bool = False


def main() -> None:
    """Serve the socket that is standard input until it is closed."""
    control = socket.socket(fileno=os.dup(0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    children: dict[int, _Child] = {}
    try:
        while True:
            ready, _, _ = select.select([control.fileno(), woken], [], [], _patience(children))
            with contextlib.suppress(BlockingIOError):
                os.read(woken, 4096)
            _end_late(children)
            _reap(children)
            if control.fileno() in ready and not _serve(control, children):
                return
    finally:
        for pid in children:
            _kill(pid)


def _patience(children: dict[int, _Child]) -> float | None:
    deadlines = [child.deadline for child in children.values() if not child.late]
    return max(0.0, min(deadlines) - time.monotonic()) if deadlines else None


def _end_late(children: dict[int, _Child]) -> None:
    for pid, child in children.items():
        if not child.late and time.monotonic() >= child.deadline:
            child.late = True
            _kill(pid)


def _reap(children: dict[int, _Child]) -> None:
    """Tell callers whose children are over how these ended."""
    while children:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        child = children.pop(pid)
        ended = {"exit": os.waitstatus_to_exitcode(status), "late": child.late}
        with contextlib.suppress(OSError), socket.socket(fileno=child.answer) as answer:
            answer.settimeout(1.0)
            answer.sendall(json.dumps(ended).encode() + b"\n")


def _serve(control: socket.socket, children: dict[int, _Child]) -> bool:
    """Start one child; False once the caller has gone."""
    message, descriptors, _, _ = socket.recv_fds(control, REQUEST_BYTES, 1)
    if not message:
        return False
    request = json.loads(message)
    _load(request["target"].partition(":")[0])
    (answer,) = descriptors
    pid = os.fork()
    if pid == 0:
        _become_child(answer, request)
    children[pid] = _Child(answer, time.monotonic() + request["limits"]["seconds"])
    return True


def _load(name: str) -> None:
    """Load a module of the program before the fork: then children have it, and need no memory for
    it. What its functions import late stands in its ``LOADED_EARLY``."""
    with contextlib.suppress(ImportError):
        module = importlib.import_module(name)
        for late in getattr(module, "LOADED_EARLY", ()):
            importlib.import_module(late)


def _become_child(answer: int, request: dict[str, Any]) -> None:
    """Do the work of a request and end the process."""
    status = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setpgid(0, 0)
        reply = socket.socket(fileno=_only_descriptor(answer))
        apply_limits(Limits(**request["limits"]))
        told = json.dumps(_outcome(request["target"], request["arguments"])).encode()
        reply.sendall(told + b"\n")
        status = 0
    finally:
        os._exit(status)


def _only_descriptor(kept: int) -> int:
    """Close all descriptors but ``kept``, which moves to 3; standard streams lead nowhere."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nowhere, stream)
    if kept != 3:
        os.dup2(kept, 3)
    os.closerange(4, 1 << 16)
    return 3


def _outcome(target: str, arguments: dict[str, Any]) -> dict[str, Any]:
    module, _, name = target.partition(":")
    try:
        return {"value": getattr(importlib.import_module(module), name)(**arguments)}
    except MemoryError:
        return {"error": OUT_OF_MEMORY, "message": ""}
    except Exception as error:
        if _lacks_memory(error):
            return {"error": OUT_OF_MEMORY, "message": ""}
        return {
            "error": type(error).__name__,
            "message": str(error)[:4000],
            "trace": "".join(traceback.format_exception(error))[-4000:],
        }


def _lacks_memory(error: BaseException | None) -> bool:
    """Whether an error, or what it came from, is a lack of memory. torch has no type for it."""
    while error is not None:
        if isinstance(error, MemoryError) or any(sign in str(error) for sign in _MEMORY):
            return True
        if isinstance(error, OSError) and error.errno == errno.ENOMEM:
            return True
        error = error.__cause__ or error.__context__
    return False


def _kill(pid: int) -> None:
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            kill(pid, signal.SIGKILL)
