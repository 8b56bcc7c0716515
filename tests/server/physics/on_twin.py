"""CUDA-backend solvers whose kernels run on the CPU, see ``kernel_twin``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

from real2sim_server.physics import Solver, solver
from real2sim_server.physics.backends.cuda.backend import CudaSolverBackend

from .kernel_twin import TwinLauncher


def on_twin(make: Callable[[], Solver], launcher: Callable[[str], Any] = TwinLauncher) -> Solver:
    """What ``make`` returns when every backend it asks for is CUDA."""
    backend = CudaSolverBackend(launcher)
    with mock.patch.object(solver, "select_backend", return_value=backend):
        return make()
