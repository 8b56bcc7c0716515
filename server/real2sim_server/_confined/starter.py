"""The starter process: forks a confined child for each request and reads no file.

A process with loaded modules forks in milliseconds; a new interpreter takes seconds to start. The
starter has one thread and one socket to its parent process, and ends when the parent ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import json
import math
import os
import resource
import select
import signal
import socket
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Limits of a confined process, and how it gives up its privileges.

MIB = 1024**2
NICENESS = 10
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAPBSET_DROP = 24
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_CAPABILITY_VERSION_3 = 0x20080522
_CAPABILITIES = 64
_READ_AND_WRITE_OTHERS = 0b110
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: root can still read and write its input files."""


@dataclass(frozen=True)
class Limits:
    """Limits of one confined call.

    Attributes:
        memory_bytes: address space beyond that of the program itself; mapped files count.
        seconds: wall-clock limit; also of processor time.
        written_bytes: maximum size of a written file; 0 prohibits writing.
        open_files: descriptors.
    """

    memory_bytes: int = 2048 * MIB
    seconds: float = 60.0
    written_bytes: int = 0
    open_files: int = 64


def apply_limits(limits: Limits) -> None:
    """Irrevocably give up everything beyond ``limits``.

    Unsupported limits are skipped: address space outside Linux, a separate network where namespaces
    are refused.
    """
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    if sys.platform == "linux":
        _give_up_privileges()
        _limit(resource.RLIMIT_AS, _address_space() + limits.memory_bytes)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_NOFILE, limits.open_files)
    _limit(resource.RLIMIT_FSIZE, limits.written_bytes)
    _limit(resource.RLIMIT_CPU, max(1, math.ceil(limits.seconds)))


def _limit(which: int, value: int) -> None:
    _, highest = resource.getrlimit(which)
    if highest != resource.RLIM_INFINITY:
        value = min(value, highest)
    resource.setrlimit(which, (value, value))


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * resource.getpagesize()


def _give_up_privileges() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "privileges cannot be given up")
    if os.geteuid() == 0:
        libc.unshare(_CLONE_NEWNET)
        for capability in range(_CAPABILITIES):
            libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
        _keep_capabilities(libc, _READ_AND_WRITE_OTHERS)
    else:
        libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET)
        _keep_capabilities(libc, 0)


def _keep_capabilities(libc: ctypes.CDLL, kept: int) -> None:
    """Drop all capabilities except those of the mask ``kept`` (all below 32)."""
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    held = (ctypes.c_uint32 * 6)()
    if libc.capget(header, held) != 0:
        return
    remaining = [held[k] & kept for k in range(2)]
    sets = (ctypes.c_uint32 * 6)(remaining[0], remaining[1], 0, 0, 0, 0)
    libc.capset(header, sets)


REQUEST_BYTES = 1 << 16
OUT_OF_MEMORY = "out of memory"
_MEMORY = ("allocate memory", "failed to map segment", "bad_alloc")
"""Message fragments for a lack of memory, for libraries without an exception type for it."""


@dataclass
class _Child:
    """A running child.

    Attributes:
        answer: the caller's socket.
        deadline: monotonic time at which the child is killed.
        late: whether it was killed for that.
    """

    answer: int
    deadline: float
    late: bool = False


def main() -> None:
    """Serve requests on standard input, a socket, until it is closed."""
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
    """Report the exit of finished children to their callers."""
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
    """Start one child; False if the caller has closed its socket."""
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
    """Load a module of the program before the fork; children then share its memory.

    Late imports of its functions are listed in its ``LOADED_EARLY``.
    """
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
    """Close all descriptors except ``kept``, which moves to 3; standard streams are discarded."""
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
    """Whether an error, or its cause, is a lack of memory. torch has no exception type for it."""
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
