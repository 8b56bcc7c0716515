"""The kernels of cast() on the CPU: their own source, compiled as C++, see ..kernel_twin."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from real2sim_server.render.cast.cuda import FOLDER

from ...kernel_twin import KernelTwin, compiled_twin

HERE = Path(__file__).parent


@functools.cache
def cast_twin() -> ctypes.CDLL:
    """The compiled kernels."""
    return compiled_twin("cast", HERE / "twin.cpp", sources=FOLDER.iterdir())


class CastTwinLauncher(KernelTwin):
    """A Launcher that runs the kernels of cast() on the CPU."""

    def __init__(self, *, backwards: bool = False) -> None:
        super().__init__(cast_twin, backwards=backwards)

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        raise NotImplementedError("sweeps are waited for")
