"""The CPU backend: Numba kernels on all cores, same bits for any number of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numba
import numpy as np

from ....geometry.rotation import Float
from ...colliders import Collider
from ..base import Model
from ..blocks import BlockSimulation
from ..layout import CHUNKS, Int, Layout
from ..particle import COLUMNS, ParticleState, Workspace
from .deform import SCRATCH
from .kernels import advance
from .measure import measure_blocks

PARTICLES_PER_THREAD = 5000
"""With fewer, threads gain little, and wait long for each other where others compute as well."""


class CpuSolverBackend:
    """Solver for any CPU."""

    name = "cpu"

    def start(self, model: Model, colliders: Sequence[Collider]) -> CpuSimulation:
        """Load a model in its precision."""
        return CpuSimulation(model, colliders)


class CpuSimulation(BlockSimulation):
    """A model in motion on the cores of this machine."""

    def _substeps(self, steps: int, dt: Any) -> tuple[int, bool]:
        with self._threads():
            done = advance(steps, dt, self._state, self._layout, self._work, self._params)
        return done, bool(self._work.needs_resort.any())

    @contextmanager
    def _threads(self) -> Iterator[None]:
        """No more threads than there is work for; the bits do not depend on it."""
        before = numba.get_num_threads()
        wanted = len(self._state.mass) // PARTICLES_PER_THREAD
        numba.set_num_threads(min(max(wanted, 1), before))
        try:
            yield
        finally:
            numba.set_num_threads(before)

    def _measure_blocks(self) -> tuple[Float, Int]:
        blocks = len(self._layout.block_coordinates)
        rows = np.empty((blocks, COLUMNS))
        with self._threads():
            measure_blocks(self._state, self._layout, self._params, rows)
        return rows, np.arange(blocks)

    def _load_state(self, state: ParticleState) -> ParticleState:
        return state

    def _sort_state(self, state: ParticleState, xi: Any, order: Int) -> ParticleState:
        moved = state._replace(xi=xi)
        return ParticleState(*(np.take(a, order, axis=0) if len(a) else a for a in moved))

    def _copy_state(self, state: ParticleState) -> ParticleState:
        return ParticleState(*(a.copy() for a in state))

    def _fetch(self, array: Any) -> Any:
        return array

    def _make_work(self, layout: Layout) -> Workspace:
        shapes = self._shapes(layout)
        return Workspace(
            tiles=self._array("tiles", shapes.tiles),
            moments=self._array("moments", shapes.moments),
            velocity=self._array("velocity", shapes.velocity),
            offset=self._array("offset", shapes.offset),
            scratch=self._array("scratch", (CHUNKS, SCRATCH)),
            needs_resort=np.zeros(len(layout.block_coordinates), np.bool_),
            by_collider=np.zeros(shapes.by_collider),
            by_thin=np.zeros(shapes.by_thin),
            by_body=np.zeros(shapes.by_body),
        )

    def _allocate(self, size: int) -> Any:
        return np.empty(size, self._dtype)
