"""The CPU backend: Numba kernels on all cores, same bits for any number of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from ...scene.rotation import Float
from ..colliders import Box, Collider
from ..laws.stress import KIND, VON_MISES
from . import cpu_measure as columns
from .base import TOTALS, Blowup, Measure, Model, ParticleArrays, pack_colliders
from .cpu_deform import SCRATCH
from .cpu_kernels import NODES, TILE, Rules, State, Work, advance
from .cpu_layout import BLOCK, CHUNKS, COLLIDER_MARGIN, Int, Layout, arrange
from .cpu_measure import measure_homes

PARTICLES_PER_THREAD = 5000
"""With fewer, threads gain little, and wait long for each other where others compute as well."""


class CpuBackend:
    """Solver for any CPU."""

    name = "cpu"

    def start(self, model: Model, colliders: Sequence[Collider]) -> CpuSimulation:
        """Load a model in its precision."""
        return CpuSimulation(model, colliders)


@dataclass(frozen=True, eq=False)
class _Saved:
    """All that changes, bit by bit; layouts are never written to and may be shared."""

    state: State
    blocks: Int
    order: Int
    layout: Layout
    by_collider: Float
    by_body: Float
    totals: tuple[Float, Float]


class CpuSimulation:
    """A model in motion. Particles are kept sorted by home block; see ``cpu_layout``."""

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
        self._set_rules(colliders)
        self._load(model.start)
        self._arrange(colliders)
        with self._threads():
            advance(0, self._dtype(0), self._state, self._layout, self._work, self._rules)

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps; sorts particles whenever one has left its home's reach."""
        if any(c.moving for c in colliders):
            for step in range(steps):
                self._follow([c.after(step * dt) for c in colliders], dt)
                self._run(1, dt, colliders)
            return
        self._run(steps, dt, colliders)

    def _run(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        step = self._dtype(dt)
        while steps > 0:
            with self._threads():
                done = advance(steps, step, self._state, self._layout, self._work, self._rules)
            steps -= done
            if self._work.strayed.any():
                self._arrange(colliders)

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

    def _follow(self, colliders: Sequence[Collider], dt: float) -> None:
        """Take over new poses; arrange anew before a collider is out of the margin."""
        self._set_rules(colliders)
        self._moved += dt * max(_fastest_point(c) for c in colliders)
        if self._moved > COLLIDER_MARGIN / 2 * self._model.dx:
            self._arrange(colliders)

    def measure(self) -> Measure:
        """Sums in float64, added up in the order of homes."""
        layout, bodies = self._layout, self._model.bodies
        rows = np.empty((len(layout.home_block), columns.COLUMNS))
        with self._threads():
            measure_homes(self._state, layout, self._rules, rows)
        # The middle one of the fields around a home is its own.
        body = layout.field_body[layout.home_fields[:, 13]]
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
        cells = self._blocks * BLOCK + s.xi.astype(np.float64)
        elastic = self._unsorted(s.F).reshape(n, 3, 3)
        total = elastic.copy()
        if len(s.F_total):
            plastic = self._model.table[self._model.material, KIND] >= VON_MISES
            total[plastic] = self._unsorted(s.F_total).reshape(n, 3, 3)[plastic]
        return ParticleArrays(
            positions=self._unsorted(cells * self._model.dx),
            velocities=self._unsorted(s.v),
            gradients=self._unsorted(s.L).reshape(n, 3, 3),
            F_elastic=elastic,
            F_total=total,
            history=self._unsorted(s.history),
        )

    def contacts(self) -> tuple[Float, Float]:
        """Totals of all arrangements so far."""
        self._flush()
        return self._totals[0].copy(), self._totals[1].copy()

    def save(self) -> _Saved:
        """Copy all that changes."""
        return _Saved(
            State(*(a.copy() for a in self._state)),
            self._blocks.copy(),
            self._order,
            self._layout,
            self._work.by_collider.copy(),
            self._work.by_body.copy(),
            (self._totals[0].copy(), self._totals[1].copy()),
        )

    def restore(self, saved: _Saved) -> None:
        """Go back, to the bit."""
        self._state = State(*(a.copy() for a in saved.state))
        self._blocks, self._order = saved.blocks.copy(), saved.order
        self._layout = saved.layout
        self._work = self._make_work(saved.layout)
        self._work.by_collider[:], self._work.by_body[:] = saved.by_collider, saved.by_body
        self._totals = (saved.totals[0].copy(), saved.totals[1].copy())
        # Where colliders stood when the layout was made is not kept, so count from its margin.
        self._moved = np.inf

    def _load(self, start: ParticleArrays) -> None:
        """Particles in the model's order, each in the block of its first node."""
        model, dtype = self._model, self._dtype
        n = len(start.positions)
        kinds = model.table[model.material, KIND]
        plastic = bool((kinds >= VON_MISES).any())
        cells = start.positions / model.dx
        self._blocks = _block_of(cells)
        self._order = np.arange(n)
        self._state = State(
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

    def _arrange(self, colliders: Sequence[Collider]) -> None:
        """Sort the particles by block and find neighbours."""
        s = self._state
        if not (np.isfinite(s.xi).all() and np.isfinite(s.v).all()):
            raise Blowup
        if hasattr(self, "_work"):
            self._flush()
        shift = _block_of(s.xi)
        # More than a few blocks in one go is no motion but an explosion.
        if np.abs(shift).max() > 1 << 10:
            raise Blowup
        xi = (s.xi - (shift * BLOCK).astype(self._dtype)).astype(self._dtype)
        blocks = self._blocks + shift
        bodies = self._model.body[self._order]
        order, self._layout = arrange(blocks, bodies, self._model.dx, colliders)
        arrays = (np.take(a, order, axis=0) if len(a) else a for a in s._replace(xi=xi))
        self._state = State(*arrays)
        self._blocks, self._order = blocks[order], self._order[order]
        self._work = self._make_work(self._layout)
        self._moved = 0.0

    def _make_work(self, layout: Layout) -> Work:
        homes, fields = len(layout.home_block), len(layout.field_block)
        moments = int(layout.home_moment.max(initial=-1)) + 1
        bodies = self._model.bodies
        pairs = fields if bodies > 1 else 0
        return Work(
            tiles=self._array("tiles", (homes, TILE, 4)),
            moments=self._array("moments", (moments, TILE, 4)),
            velocity=self._array("velocity", (fields, NODES, 4)),
            offset=self._array("offset", (fields, NODES, 4)),
            scratch=self._array("scratch", (CHUNKS, SCRATCH)),
            strayed=np.zeros(homes, np.bool_),
            by_collider=np.zeros((len(layout.touch_collider), TOTALS)),
            by_body=np.zeros((pairs, bodies, TOTALS)),
        )

    def _array(self, name: str, shape: tuple[int, ...]) -> Any:
        """Uninitialised work space that is kept from layout to layout."""
        size = int(np.prod(shape))
        held = self._space.get(name)
        if held is None or held.size < size:
            held = self._space[name] = np.empty(size + size // 4, self._dtype)
        return held[:size].reshape(shape)

    def _flush(self) -> None:
        """Move the contact sums of this layout to the totals, in the order of fields."""
        layout, work = self._layout, self._work
        field = np.repeat(np.arange(len(layout.field_body)), np.diff(layout.touch_start))
        np.add.at(
            self._totals[0], (layout.field_body[field], layout.touch_collider), work.by_collider
        )
        work.by_collider[:] = 0
        if len(work.by_body):
            np.add.at(self._totals[1], layout.field_body, work.by_body)
            work.by_body[:] = 0

    def _set_rules(self, colliders: Sequence[Collider]) -> None:
        rows, heights = pack_colliders(colliders)
        model, dtype = self._model, self._dtype
        self._rules = Rules(
            table=model.table.astype(dtype),
            dx=dtype(model.dx),
            gravity=np.asarray(model.gravity, dtype),
            friction=model.friction,
            obstacles=rows,
            heights=heights,
        )

    def _unsorted(self, values: Any) -> Float:
        out = np.empty(values.shape, np.float64)
        out[self._order] = values
        return out


def _block_of(cells: Any) -> Int:
    """Block [N, 3] of the first node of particles at ``cells`` [N, 3]."""
    return np.floor((cells - 0.5) / BLOCK).astype(np.int64)


def _fastest_point(collider: Collider) -> float:
    """Speed [m/s] no point of a collider exceeds."""
    if not isinstance(collider, Box):
        return 0.0
    reach = float(np.linalg.norm(np.asarray(collider.size))) / 2
    spin = float(np.linalg.norm(np.asarray(collider.angular_velocity)))
    return float(np.linalg.norm(np.asarray(collider.velocity))) + reach * spin
