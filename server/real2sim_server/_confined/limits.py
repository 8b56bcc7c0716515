"""What a confined process may use, and how it gives up the rest."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import sys
from dataclasses import dataclass
from pathlib import Path

MIB = 1024**2
NICENESS = 10
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAPBSET_DROP = 24
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_CAPABILITY_VERSION_3 = 0x20080522
_CAPABILITIES = 64
_READ_AND_WRITE_OTHERS = 0b110
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: root goes on to reach the files it was given."""


@dataclass(frozen=True)
class Limits:
    """What one confined call may use.

    Attributes:
        memory_bytes: address space beyond that of the program itself; files that are mapped count.
        seconds: until it is ended; also of processor time.
        written_bytes: largest file it may write; with 0 it writes none.
        open_files: descriptors.
    """

    memory_bytes: int = 2048 * MIB
    seconds: float = 60.0
    written_bytes: int = 0
    open_files: int = 64


def apply_limits(limits: Limits) -> None:
    """Give up everything beyond ``limits``, for good.

    What the system does not offer is passed over: limits of address space outside of Linux,
    a network of its own where namespaces are refused.
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
    """Leave the capabilities of the mask ``kept`` (all below 32) and no others."""
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    held = (ctypes.c_uint32 * 6)()
    if libc.capget(header, held) != 0:
        return
    remaining = [held[k] & kept for k in range(2)]
    sets = (ctypes.c_uint32 * 6)(remaining[0], remaining[1], 0, 0, 0, 0)
    libc.capset(header, sets)
