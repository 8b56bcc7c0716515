"""What a figure was measured with: without it, figures of two runs cannot be compared."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = ("real2sim", "numpy", "torch", "numba", "llvmlite")
"""Those that decide how fast the code runs."""


def environment() -> dict[str, str | int]:
    """Versions of Python and of the libraries that compute, the operating system and the CPU.

    Returns:
        ``python``, one entry for each of LIBRARIES ("not installed" where it is absent),
        ``system``, ``cpu`` (model) and ``cpu_threads``, those that this process may use.
    """
    return {
        "python": platform.python_version(),
        **{library: _version(library) for library in LIBRARIES},
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cpu_threads": _cpu_threads(),
    }


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def _cpu_model() -> str:
    """The processor's name as Linux tells it, else what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _cpu_threads() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
