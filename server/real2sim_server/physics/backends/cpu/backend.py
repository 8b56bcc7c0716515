"""The CPU backend: Numba kernels on all cores, bitwise independent of the number of threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np

from ....geometry import Float
from ...colliders import Collider
from ...model import TOTALS, Measure, Model, ParticleArrays, SolverDiverged, pack_colliders
from ...stress import LAW
from ..layout import BLOCK, CHUNKS, COLLIDER_MARGIN, Int, Layout, arrange
from . import particle as columns
from .deform import SCRATCH
from .kernels import advance, measure_blocks
from .particle import COLUMNS, NODES, TILE, ParticleState, StepParameters, Workspace

# Particles in blocks: loading, sorting, sums, contact totals and saving.


@dataclass(frozen=True, eq=False)
class _Saved:
    """The complete mutable state; layouts are immutable and may be shared."""

    state: ParticleState
    blocks: Int
    order: Int
    layout: Layout
    by_collider: Float
    by_thin: Float
    by_body: Float
    totals: tuple[Float, Float]


class WorkspaceShapes(NamedTuple):
    """Shapes of :class:`Workspace` for one layout."""

    tiles: tuple[int, ...]
    moments: tuple[int, ...]
    velocity: tuple[int, ...]
    offset: tuple[int, ...]
    by_collider: tuple[int, ...]
    by_thin: tuple[int, ...]
    by_body: tuple[int, ...]


class BlockSimulation:
    """A running simulation. Particles are sorted by block; see ``layout``."""

    def __init__(self, model: Model, colliders: Sequence[Collider]) -> None:
        self._model = model
        self._dtype = model.dtype
        self._space: dict[str, Any] = {}
        bodies = model.bodies
        self._totals = (
            np.zeros((bodies, len(colliders), TOTALS)),
            np.zeros((bodies, bodies, TOTALS)),
        )
        self._moved = 0.0
        # int16 is sorted in linear time.
        self._laws = model.table[model.material, LAW].astype(np.int16)
        self._set_params(colliders)
        self._load(model.start)
        self._arrange(colliders)
        self._substeps(0, self._dtype(0))

    def _substeps(self, steps: int, dt: Any) -> tuple[int, bool]:
        """Make up to ``steps`` substeps; return their number, and whether sorting is needed.

        With 0 steps, compute stress and energy of the current particles.
        """
        raise NotImplementedError

    def _measure_blocks(self) -> tuple[Float, Int]:
        """Rows of sums [R, COLUMNS], see ``cpu.particle``, and the block [R] of each."""
        raise NotImplementedError

    def _load_state(self, state: ParticleState) -> ParticleState:
        """The state on the backend's device."""
        raise NotImplementedError

    def _sort_state(self, state: ParticleState, xi: Any, order: Int) -> ParticleState:
        """The state in another order, with new positions from the host."""
        raise NotImplementedError

    def _copy_state(self, state: ParticleState) -> ParticleState:
        """A copy on the backend's device."""
        raise NotImplementedError

    def _fetch(self, array: Any) -> Any:
        """An array on the host; read-only."""
        raise NotImplementedError

    def _make_work(self, layout: Layout) -> Workspace:
        """Work space for a layout, contact totals at zero."""
        raise NotImplementedError

    def _allocate(self, size: int) -> Any:
        """Uninitialised array [size] on the backend's device."""
        raise NotImplementedError

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps; sort particles whenever one leaves its block's reach."""
        if any(c.moving for c in colliders):
            for step in range(steps):
                self._follow([c.after(step * dt) for c in colliders], dt)
                self._run(1, dt, colliders)
            return
        self._run(steps, dt, colliders)

    def _run(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        step = self._dtype(dt)
        while steps > 0:
            done, needs_resort = self._substeps(steps, step)
            steps -= done
            if needs_resort:
                self._arrange(colliders)

    def _follow(self, colliders: Sequence[Collider], dt: float) -> None:
        """Update collider poses; rebuild the layout before a collider leaves its margin."""
        self._set_params(colliders)
        self._moved += dt * max(c.fastest_point for c in colliders)
        if self._moved > COLLIDER_MARGIN / 2 * self._model.dx:
            self._arrange(colliders)

    def measure(self) -> Measure:
        """Sums in float64, in the order of blocks."""
        layout, bodies = self._layout, self._model.bodies
        rows, block = self._measure_blocks()
        # The middle one of the fields around a block is the block's own.
        body = layout.field_body[layout.block_fields[block, 13]]
        sums = np.zeros((bodies, columns.SUMS))
        np.add.at(sums, body, rows[:, : columns.SUMS])
        mass = sums[:, columns.MASS]
        return Measure(
            mass=mass,
            centre=sums[:, columns.CENTRE : columns.MOMENTUM] / mass[:, None],
            momentum=sums[:, columns.MOMENTUM : columns.SPIN],
            angular_momentum=sums[:, columns.SPIN : columns.KINETIC],
            kinetic=sums[:, columns.KINETIC],
            elastic=sums[:, columns.ELASTIC],
            max_speed=float(np.sqrt(rows[:, columns.SPEED_SQUARE].max())),
            max_wave_speed=float(np.sqrt(rows[:, columns.WAVE_SQUARE].max())),
            min_volume_ratio=float(rows[:, columns.VOLUME_RATIO].min()),
        )

    def particles(self) -> ParticleArrays:
        """A copy in the model's order, float64."""
        s, n = self._state, len(self._order)
        cells = self._blocks * BLOCK + self._fetch(s.xi).astype(np.float64)
        elastic = self._unsorted(s.F).reshape(n, 3, 3)
        total = elastic.copy()
        if len(s.F_total):
            plastic = self._model.plastic
            total[plastic] = self._unsorted(s.F_total).reshape(n, 3, 3)[plastic]
        return ParticleArrays(
            positions=self._in_model_order(cells * self._model.dx),
            velocities=self._unsorted(s.v),
            gradients=self._unsorted(s.L).reshape(n, 3, 3),
            F_elastic=elastic,
            F_total=total,
            history=self._unsorted(s.history),
        )

    def contacts(self) -> tuple[Float, Float]:
        """Totals over all layouts so far."""
        self._flush()
        return self._totals[0].copy(), self._totals[1].copy()

    def save(self) -> _Saved:
        """Copy the mutable state."""
        return _Saved(
            self._copy_state(self._state),
            self._blocks.copy(),
            self._order,
            self._layout,
            np.array(self._fetch(self._work.by_collider)),
            np.array(self._fetch(self._work.by_thin)),
            np.array(self._fetch(self._work.by_body)),
            (self._totals[0].copy(), self._totals[1].copy()),
        )

    def restore(self, saved: _Saved) -> None:
        """Restore a saved state bitwise."""
        self._state = self._copy_state(saved.state)
        self._blocks, self._order = saved.blocks.copy(), saved.order
        self._layout = saved.layout
        self._work = self._make_work(saved.layout)
        for held, kept in (
            (self._work.by_collider, saved.by_collider),
            (self._work.by_thin, saved.by_thin),
            (self._work.by_body, saved.by_body),
        ):
            if kept.size:
                held[:] = kept
        self._totals = (saved.totals[0].copy(), saved.totals[1].copy())
        # Saved states have no collider poses, so moving colliders rebuild the layout.
        self._moved = np.inf

    def _load(self, start: ParticleArrays) -> None:
        """Particles in the model's order, each in the block of its first node."""
        model, dtype = self._model, self._dtype
        n = len(start.positions)
        plastic = bool(model.plastic.any())
        cells = start.positions / model.dx
        self._blocks = _block_of(cells)
        self._order = np.arange(n)
        state = ParticleState(
            xi=(cells - self._blocks * BLOCK).astype(dtype),
            v=start.velocities.astype(dtype),
            L=start.gradients.reshape(n, 9).astype(dtype),
            F=start.F_elastic.reshape(n, 9).astype(dtype),
            F_total=start.F_total.reshape(n, 9).astype(dtype)[: n if plastic else 0],
            tau=np.zeros((n, 6), dtype),
            energy=np.zeros(n, dtype),
            history=start.history.astype(dtype),
            mass=model.masses.astype(dtype),
            volume=model.volumes.astype(dtype),
            material=model.material.astype(np.int32),
        )
        self._state = self._load_state(state)

    def _arrange(self, colliders: Sequence[Collider]) -> None:
        """Sort the particles by block and find neighbours."""
        s = self._state
        at = self._fetch(s.xi)
        if not (np.isfinite(at).all() and np.isfinite(self._fetch(s.v)).all()):
            raise SolverDiverged
        if hasattr(self, "_work"):
            self._flush()
        shift = _block_of(at)
        # A particle that crosses more than a few blocks at once means that the solver diverges.
        if np.abs(shift).max() > 1 << 10:
            raise SolverDiverged
        xi = (at - (shift * BLOCK).astype(self._dtype)).astype(self._dtype)
        blocks = self._blocks + shift
        bodies = self._model.body[self._order]
        laws = self._laws[self._order]
        order, self._layout = arrange(blocks, bodies, laws, self._model.dx, colliders)
        self._state = self._sort_state(s, xi, order)
        self._blocks, self._order = blocks[order], self._order[order]
        self._work = self._make_work(self._layout)
        self._moved = 0.0

    def _shapes(self, layout: Layout) -> WorkspaceShapes:
        blocks, fields = len(layout.block_coordinates), len(layout.field_coordinates)
        bodies = self._model.bodies
        return WorkspaceShapes(
            tiles=(blocks, TILE, 4),
            moments=(int(layout.block_moment.max(initial=-1)) + 1, TILE, 4),
            velocity=(fields, NODES, 4),
            offset=(fields, NODES, 4),
            by_collider=(len(layout.contact_collider), TOTALS),
            by_thin=(len(layout.thin_collider), TOTALS),
            by_body=(fields if bodies > 1 else 0, bodies, TOTALS),
        )

    def _array(self, name: str, shape: tuple[int, ...]) -> Any:
        """Uninitialised work space, reused across layouts."""
        size = int(np.prod(shape))
        held = self._space.get(name)
        if held is None or held.size < size:
            held = self._space[name] = self._allocate(size + size // 4)
        return held[:size].reshape(shape)

    def _flush(self) -> None:
        """Move the contact sums of this layout to the totals, in the order of fields."""
        layout, work = self._layout, self._work
        field = np.repeat(np.arange(len(layout.field_body)), np.diff(layout.contact_start))
        np.add.at(
            self._totals[0],
            (layout.field_body[field], layout.contact_collider),
            self._fetch(work.by_collider),
        )
        if work.by_collider.size:
            work.by_collider[:] = 0
        if work.by_thin.size:
            block = np.repeat(np.arange(len(layout.thin_start) - 1), np.diff(layout.thin_start))
            # The middle one of the fields around a block is the block's own.
            body = layout.field_body[layout.block_fields[block, 13]]
            np.add.at(self._totals[0], (body, layout.thin_collider), self._fetch(work.by_thin))
            work.by_thin[:] = 0
        if work.by_body.size:
            np.add.at(self._totals[1], layout.field_body, self._fetch(work.by_body))
            work.by_body[:] = 0

    def _set_params(self, colliders: Sequence[Collider]) -> None:
        rows, heights = pack_colliders(colliders, self._model.dx)
        model, dtype = self._model, self._dtype
        self._params = StepParameters(
            table=model.table.astype(dtype),
            dx=dtype(model.dx),
            gravity=np.asarray(model.gravity, dtype),
            friction=model.friction,
            collider_rows=rows,
            heights=heights,
        )

    def _unsorted(self, values: Any) -> Float:
        return self._in_model_order(self._fetch(values))

    def _in_model_order(self, values: Any) -> Float:
        out = np.empty(values.shape, np.float64)
        out[self._order] = values
        return out


def _block_of(cells: Any) -> Int:
    """Block [N, 3] of the first node of particles at ``cells`` [N, 3]."""
    blocks: Int = np.floor((cells - 0.5) / BLOCK).astype(np.int64)
    return blocks


PARTICLES_PER_THREAD = 5000
"""Minimum number of particles per thread. More threads gain little and wait for each other on a
busy machine."""


class CpuSolverBackend:
    """Solver for any CPU."""

    name = "cpu"

    def start(self, model: Model, colliders: Sequence[Collider]) -> CpuSimulation:
        """Load a model in its precision."""
        return CpuSimulation(model, colliders)


class CpuSimulation(BlockSimulation):
    """A running simulation on the CPU cores."""

    def _substeps(self, steps: int, dt: Any) -> tuple[int, bool]:
        with self._threads():
            done = advance(steps, dt, self._state, self._layout, self._work, self._params)
        return done, bool(self._work.needs_resort.any())

    @contextmanager
    def _threads(self) -> Iterator[None]:
        """Limit threads to the available work; results do not depend on it."""
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
