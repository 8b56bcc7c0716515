"""Which backend draws, decided once and logged with its reason."""

from __future__ import annotations

import functools
import importlib.util
import logging
import shutil
from dataclasses import dataclass

import torch

from ..types import RenderError
from .base import Backend

BACKENDS = ("cpu", "cuda", "reference")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can be used here.

    Attributes:
        name: ``cpu``, ``cuda`` or ``reference``.
        usable: whether select_backend() would return it.
        reason: why, or why not.
        remedy: what to do to make it usable; empty when it is.
    """

    name: str
    usable: bool
    reason: str
    remedy: str = ""


@functools.cache
def select_backend(name: str = "auto") -> Backend:
    """The one backend of that name, made on first use.

    Args:
        name: ``cpu``, ``cuda``, ``reference``, or ``auto``: cuda where it is usable, else cpu.

    Raises:
        RenderError: unknown, or not usable here; the message says what to do.
    """
    if name == "auto":
        status = _cuda_status()
        chosen = "cuda" if status.usable else "cpu"
        _log.info("render backend %s chosen: %s", chosen, status.reason)
        return select_backend(chosen)
    if name not in BACKENDS:
        raise RenderError(f"unknown backend {name!r}; allowed are 'auto' and {list(BACKENDS)}")
    for status in describe_backends():
        if status.name == name and not status.usable:
            raise RenderError(f"backend {name!r} is not usable: {status.reason}; {status.remedy}")
    return _make(name)


def describe_backends() -> list[BackendStatus]:
    """Status of every backend, best first."""
    return [_cuda_status(), _cpu_status(), BackendStatus("reference", True, "plain torch, slow")]


def _make(name: str) -> Backend:
    if name == "cuda":
        from .cuda.backend import CudaBackend

        return CudaBackend()
    if name == "cpu":
        from .cpu.backend import CpuBackend

        return CpuBackend()
    from .reference import ReferenceBackend

    return ReferenceBackend()


def _cpu_status() -> BackendStatus:
    if importlib.util.find_spec("numba") is None:
        return BackendStatus(
            "cpu", False, "numba is not installed", "pip install 'real2sim[server]'"
        )
    import numba

    return BackendStatus(
        "cpu", True, f"numba {numba.__version__}, {numba.get_num_threads()} threads"
    )


def _cuda_status() -> BackendStatus:
    if not torch.cuda.is_available():
        return BackendStatus(
            "cuda", False, "torch sees no CUDA device", "install a CUDA build of torch and a driver"
        )
    if importlib.util.find_spec("gsplat") is None:
        return BackendStatus(
            "cuda", False, "gsplat is not installed", "pip install 'real2sim[server,cuda]'"
        )
    if importlib.util.find_spec("numba.cuda") is None:
        return BackendStatus(
            "cuda", False, "numba-cuda is not installed", "pip install 'real2sim[server,cuda]'"
        )
    if importlib.util.find_spec("gsplat.csrc") is None and shutil.which("nvcc") is None:
        return BackendStatus(
            "cuda",
            False,
            "gsplat is not compiled and there is no nvcc to compile it",
            "install the CUDA toolkit, or a gsplat wheel built for this torch",
        )
    return BackendStatus("cuda", True, f"gsplat on {torch.cuda.get_device_name()}")
