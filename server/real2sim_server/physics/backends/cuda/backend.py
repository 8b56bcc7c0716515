"""The CUDA backend: the CPU's blocks and functions on an NVIDIA GPU, or in Numba's simulator.

Particles stay on the device; the host sorts them by their positions alone. Sums of floating-point
numbers are made by atomics, so the last bits differ from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numba import cuda

from ....geometry.rotation import Float
from ...colliders import Collider
from ...errors import SolverError
from ..base import Model
from ..blocks import BlockSimulation
from ..layout import Int, Layout
from ..particle import COLUMNS, ParticleState, StepParameters, Workspace
from .kernels import DONE, HALTED, MEASURE_THREADS, NEEDS_RESORT, NODE_THREADS, THREADS, kernels_of

REORDER_THREADS = 256


class CudaSolverBackend:
    """Solver for NVIDIA GPUs.

    Raises:
        SolverError: where there is none that works.
    """

    name = "cuda"

    def __init__(self) -> None:
        try:
            usable = bool(cuda.is_available())
            reason = "no CUDA device was found"
        except Exception as problem:
            usable, reason = False, f"{type(problem).__name__}: {problem}"
        if not usable:
            raise SolverError(
                f"backend 'cuda' is not usable here: {reason}; it needs an NVIDIA GPU with its "
                "driver and the extra `real2sim[cuda]`; take 'cpu'"
            )

    def start(self, model: Model, colliders: Sequence[Collider]) -> CudaSimulation:
        """Load a model in its precision."""
        return CudaSimulation(model, colliders)


class CudaSimulation(BlockSimulation):
    """A model in motion on the device."""

    def __init__(self, model: Model, colliders: Sequence[Collider]) -> None:
        self._kernels = kernels_of(cast("Any", model.dtype))
        self._progress = cuda.to_device(np.zeros(3, np.int64))
        super().__init__(model, colliders)

    def _substeps(self, steps: int, dt: Any) -> tuple[int, bool]:
        k, layout, work, params = (
            self._kernels,
            self._device_layout,
            self._work,
            self._device_params,
        )
        blocks, groups = len(self._layout.block_coordinates), len(self._layout.group_start) - 1
        progress = self._progress
        progress[:] = np.zeros(3, np.int64)
        if steps == 0:
            k.gather[blocks, THREADS](dt, self._state, layout, work, params, progress, False)
        for _ in range(steps):
            k.scatter[blocks, THREADS](dt, self._state, layout, work, params, progress)
            k.collect[groups, NODE_THREADS](dt, layout, work, params, progress)
            k.gather[blocks, THREADS](dt, self._state, layout, work, params, progress, True)
            k.finish[1, 1](progress)
        counted = progress.copy_to_host()
        return int(counted[DONE]), bool(counted[NEEDS_RESORT] or counted[HALTED])

    def _measure_blocks(self) -> tuple[Float, Int]:
        blocks = len(self._layout.block_coordinates)
        rows = cuda.device_array((blocks * MEASURE_THREADS, COLUMNS), np.float64)
        self._kernels.measure[blocks, MEASURE_THREADS](
            self._state, self._device_layout, self._device_params, rows
        )
        return rows.copy_to_host(), np.repeat(np.arange(blocks), MEASURE_THREADS)

    def _load_state(self, state: ParticleState) -> ParticleState:
        return ParticleState(*(cuda.to_device(a) for a in state))

    def _sort_state(self, state: ParticleState, xi: Any, order: Int) -> ParticleState:
        placed = cuda.to_device(order)
        moved = state._replace(xi=cuda.to_device(xi))
        return ParticleState(*(self._sorted(a, placed) for a in moved))

    def _sorted(self, array: Any, order: Any) -> Any:
        if not array.size:
            return array
        out = cuda.device_array(array.shape, array.dtype)
        rows = (len(order), array.size // len(order))
        groups = -(-len(order) // REORDER_THREADS)
        threads = REORDER_THREADS
        self._kernels.reorder[groups, threads](array.reshape(rows), order, out.reshape(rows))
        return out

    def _copy_state(self, state: ParticleState) -> ParticleState:
        return ParticleState(*(_copied(a) for a in state))

    def _fetch(self, array: Any) -> Any:
        return array.copy_to_host()

    def _make_work(self, layout: Layout) -> Workspace:
        self._device_layout = Layout(*(cuda.to_device(np.ascontiguousarray(a)) for a in layout))
        host = self._shapes(layout)
        return Workspace(
            tiles=self._array("tiles", host.tiles),
            moments=self._array("moments", host.moments),
            velocity=self._array("velocity", host.velocity),
            offset=self._array("offset", host.offset),
            scratch=self._array("scratch", (1, 1)),
            needs_resort=self._array("needs_resort", (1,)),
            by_collider=cuda.to_device(np.zeros(host.by_collider)),
            by_thin=cuda.to_device(np.zeros(host.by_thin)),
            by_body=cuda.to_device(np.zeros(host.by_body)),
        )

    def _allocate(self, size: int) -> Any:
        return cuda.device_array(size, self._dtype)

    def _set_params(self, colliders: Sequence[Collider]) -> None:
        super()._set_params(colliders)
        r = self._params
        self._device_params = StepParameters(
            *(a if np.ndim(a) == 0 else cuda.to_device(a) for a in r)
        )


def _copied(array: Any) -> Any:
    """A copy on the device."""
    out = cuda.device_array(array.shape, array.dtype)
    if array.size:
        out.copy_to_device(array)
    return out
