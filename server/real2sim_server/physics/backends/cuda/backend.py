"""The CUDA backend: particles, their order, the grid and all sums stay on an NVIDIA GPU.

Between two checks of the solver, the host queues launches that do not depend on particle motion and
reads one report. A particle that leaves its tile stops the remaining substeps on the device. The
host sees that in the report, sorts all particles and continues. This is rare, because the host
bounds particle motion from the last report and sorts in time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ....geometry import Float
from ....render._cuda.needs import unmet_nvrtc_need
from ...colliders import Collider
from ...contact import AXES, POINT, SPEED, SPIN
from ...errors import ParticleError, SolverError
from ...model import Measure, Model, ParticleArrays, SolverDiverged, pack_colliders
from ..layout import (
    BLOCK,
    BODY_BITS,
    COLLIDER_MARGIN,
    COORDINATE_BITS,
    COORDINATE_LIMIT,
)
from . import launcher as records
from .launcher import CudaLauncher, Launch, Launcher
from .memory import SolverMemory, advancing, arranging, flushing, measuring, substeps

INTERVAL = 16
"""Substeps per queued batch, equal to the solver's check interval; repeated launch sequences are
captured."""
TILE_REACH, SORTED_REACH = 3.0, 2.0
"""Maximum distance of particles from the middle of their block along an axis [cells]: in general,
and after sorting."""
CAUTION = 1.25
"""Safety factor on particle motion at the last reported speed."""


class CudaSolverBackend:
    """Solver for NVIDIA GPUs.

    Args:
        launcher: creates the device launcher for a precision; default: torch's current CUDA device.

    Raises:
        SolverError: without a usable device.
    """

    name = "cuda"

    def __init__(self, launcher: Callable[[str], Launcher] | None = None) -> None:
        need = unmet_nvrtc_need() if launcher is None else None
        if need is not None:
            raise SolverError(
                f"backend 'cuda' is not usable here: {need.found}; {need.remedy}; it needs an "
                "NVIDIA GPU with its driver and the extra `real2sim[cuda]`; take 'cpu'"
            )
        self._launcher = launcher or CudaLauncher

    def start(self, model: Model, colliders: Sequence[Collider]) -> CudaSimulation:
        """Load a model in its precision."""
        precision = "single" if np.dtype(model.dtype).itemsize == 4 else "double"
        return CudaSimulation(self._launcher(precision), model, colliders)


@dataclass(frozen=True, eq=False)
class _Saved:
    """Particles and totals on the device, and the data read from them."""

    particles: Tensor
    totals: Tensor
    report: NDArray[np.uint8]


class CudaSimulation:
    """A running simulation on the device."""

    def __init__(self, launcher: Launcher, model: Model, colliders: Sequence[Collider]) -> None:
        self._launcher, self._model = launcher, model
        rows, heights = pack_colliders(colliders, model.dx)
        self._memory = SolverMemory(launcher, model, rows, heights)
        self._memory.upload(self._memory.sets[0], self._loaded(model.start))
        self._report = np.zeros(len(self._memory.report), np.uint8)
        self._keep = False  # Whether sorting keeps particles in their current blocks.
        self._stale = True  # Whether particles must be sorted before the next substep.
        self._moved = 0.0  # Maximum collider motion since the last sort [m].
        self._memory.upload_step(0.0, False, rows)
        done = 0
        while done == 0:
            begin = [Launch("begin_run", 1), *self._arranged(0)]
            done = self._launch([*begin, *advancing(self._sizes, records.DEFORMS)], 1)

    @property
    def _sizes(self) -> Any:
        return self._memory.sizes

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps, with one wait per INTERVAL; see ``Simulation``.

        Raises:
            SolverDiverged: particles became non-finite, or crossed many blocks at once.
            ParticleError: particles left the reach of the grid.
        """
        for first in range(0, steps, INTERVAL):
            later = [c.after(first * dt) for c in colliders] if first else colliders
            self._interval(min(INTERVAL, steps - first), dt, later)

    def _interval(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        moving = any(c.moving for c in colliders)
        self._memory.upload_step(dt, moving, self._rows(steps if moving else 1, dt, colliders))
        fastest = max((c.fastest_point for c in colliders), default=0.0)
        done = 0
        while done < steps:
            done = self._launch(self._planned(done, steps, dt, fastest), steps)

    def measure(self) -> Measure:
        """Sums and bounds at the end of the last substep."""
        sums = self._memory.measured(self._report)
        mass = sums[:, 0]
        return Measure(
            mass=mass.copy(),
            centre=sums[:, 1:4] / mass[:, None],
            momentum=sums[:, 4:7].copy(),
            angular_momentum=sums[:, 7:10].copy(),
            kinetic=sums[:, 10].copy(),
            elastic=sums[:, 11].copy(),
            max_speed=math.sqrt(_largest(sums[:, 12])),
            max_wave_speed=math.sqrt(_largest(sums[:, 13])),
            min_volume_ratio=float(sums[:, 14].min()),
        )

    def particles(self) -> ParticleArrays:
        """A copy in the model's order, float64."""
        memory = self._memory
        raw = memory.read_set(self._current)
        values, keys = memory.values(raw).astype(np.float64), memory.keys(raw)
        place = memory.words(raw, 1)
        mask = np.uint64((1 << COORDINATE_BITS) - 1)
        blocks = np.stack(
            [
                (keys >> np.uint64(BODY_BITS + axis * COORDINATE_BITS) & mask).astype(np.int64)
                for axis in (2, 1, 0)
            ]
        )
        cells = (blocks - COORDINATE_LIMIT) * BLOCK + values[records.XI : records.VELOCITY]

        def in_order(rows: Float) -> Float:
            out = np.empty((rows.shape[1], rows.shape[0]))
            out[place] = rows.T
            return out

        n = self._sizes.particles
        elastic = in_order(values[records.ELASTIC_F : records.STRESS]).reshape(n, 3, 3)
        total = elastic.copy()
        if memory.numbers > records.TOTAL_F:
            plastic = self._model.plastic
            total[plastic] = in_order(values[records.TOTAL_F :]).reshape(n, 3, 3)[plastic]
        return ParticleArrays(
            positions=in_order(cells * self._model.dx),
            velocities=in_order(values[records.VELOCITY : records.GRADIENT]),
            gradients=in_order(values[records.GRADIENT : records.ELASTIC_F]).reshape(n, 3, 3),
            F_elastic=elastic,
            F_total=total,
            history=in_order(values[records.HISTORY : records.MASS])[:, 0],
        )

    def contacts(self) -> tuple[Float, Float]:
        """Totals since the start; see ``Simulation``."""
        by_collider, by_body = self._memory.totals(self._report)
        return by_collider.copy(), by_body.copy()

    def counts(self) -> dict[str, int]:
        """Number of particles, blocks and fields of the current layout."""
        held = self._memory.held(self._report)
        named = {name: int(held[name]) for name in ("blocks", "fields")}
        return {"particles": self._sizes.particles, **named}

    def save(self) -> _Saved:
        """Copy the mutable state on the device."""
        memory = self._memory
        return _Saved(memory.sets[self._current].clone(), memory.report.clone(), self._report)

    def restore(self, saved: _Saved) -> None:
        """Restore a saved state bitwise; rebuilds lists with the particles in the same blocks."""
        memory, first = self._memory, records.HELD.itemsize
        # The device continues with its last current set.
        memory.sets[self._current].copy_(saved.particles)
        memory.report[first:].copy_(saved.totals[first:])
        current = self._current
        self._report = saved.report.copy()
        self._memory.held(self._report)["current"] = current
        self._keep = self._stale = True

    @property
    def _current(self) -> int:
        return int(self._memory.held(self._report)["current"])

    def _planned(self, done: int, steps: int, dt: float, fastest: float) -> list[Launch]:
        """Launches of the substeps from ``done``, with sorting where it may be needed."""
        speed = math.sqrt(_largest(self._memory.measured(self._report)[:, 12]))
        stride = CAUTION * speed * dt / self._model.dx
        reach = float(self._memory.measured(self._report)[:, records.REACH].max())
        margin = COLLIDER_MARGIN / 2 * self._model.dx
        launches = [Launch("begin_run", 1, done)]
        while done < steps:
            free = _fitting(TILE_REACH - reach, stride)
            free = min(free, _fitting(margin - self._moved, dt * fastest), steps - done)
            if self._stale or free < steps - done:
                launches += [*flushing(self._sizes), *self._arranged(done)]
                reach = SORTED_REACH
                free = _fitting(TILE_REACH - reach, stride)
                free = min(free, _fitting(margin, dt * fastest), steps - done)
            free = max(free, 1)
            launches += substeps(self._sizes, done, done + free)
            reach += free * stride
            self._moved += free * dt * fastest
            done += free
        return launches

    def _arranged(self, step: int) -> list[Launch]:
        launches = arranging(self._sizes, keep=self._keep, step=step)
        self._kept, self._keep, self._stale = self._keep, False, False
        self._moved = 0.0
        return launches

    def _launch(self, launches: list[Launch], steps: int) -> int:
        """Run launches and measure; return the number of completed substeps."""
        ending = [*measuring(self._sizes), *flushing(self._sizes)]
        self._launcher.run((*launches, *ending), self._memory.space)
        self._report = self._memory.read_report()
        held = self._memory.held(self._report)
        fault = int(held["fault"])
        if fault & records.DIVERGED:
            raise SolverDiverged
        if fault & records.TOO_FAR:
            raise self._too_far()
        if fault & records.OVERFLOW:
            self._memory.grow({name: int(held[name]) for name in records.CAPACITIES})
            self._keep, self._stale = self._kept, True
            return int(held["done"])
        self._stale = bool(held["stop_after"])
        return int(held["done"]) if held["stop_after"] else steps

    def _too_far(self) -> ParticleError:
        reach = COORDINATE_LIMIT * BLOCK * self._model.dx
        return ParticleError(
            f"particles must stay within {reach:.0f} m of the origin with cells of "
            f"{self._model.dx} m; move the scene nearer to the origin or take larger cells"
        )

    def _rows(self, steps: int, dt: float, colliders: Sequence[Collider]) -> Float:
        """[steps, K, COLLIDER_ROW] rows of colliders in each substep."""
        first = pack_colliders(colliders, self._model.dx)[0]
        rows = np.repeat(first[None], steps, axis=0)
        for k, collider in enumerate(colliders):
            if collider.moving:
                for step in range(1, steps):
                    later = pack_colliders([collider.after(step * dt)], self._model.dx)[0][0]
                    for columns in (slice(POINT, AXES + 9), slice(SPIN, SPEED + 3)):
                        rows[step, k, columns] = later[columns]
        return rows

    def _loaded(self, start: ParticleArrays) -> NDArray[np.uint8]:
        """A set of particles in the model's order, each in the block of its first node."""
        model, memory = self._model, self._memory
        n = self._sizes.particles
        cells = start.positions / model.dx
        blocks = np.floor((cells - 0.5) / BLOCK).astype(np.int64)
        if np.abs(blocks).max() >= COORDINATE_LIMIT - 2:
            raise self._too_far()
        raw = np.zeros(len(memory.sets[0]), np.uint8)
        key = np.zeros(n, np.int64)
        for axis in range(3):
            key = (key << COORDINATE_BITS) | (blocks[:, axis] + COORDINATE_LIMIT)
        memory.keys(raw)[:] = ((key << BODY_BITS) | model.body).astype(np.uint64)
        memory.words(raw, 0)[:] = model.material
        memory.words(raw, 1)[:] = np.arange(n)
        values = memory.values(raw)
        values[records.XI : records.VELOCITY] = (cells - blocks * BLOCK).T
        values[records.VELOCITY : records.GRADIENT] = start.velocities.T
        values[records.GRADIENT : records.ELASTIC_F] = start.gradients.reshape(n, 9).T
        values[records.ELASTIC_F : records.STRESS] = start.F_elastic.reshape(n, 9).T
        values[records.HISTORY], values[records.MASS], values[records.VOLUME] = (
            start.history,
            model.masses,
            model.volumes,
        )
        if memory.numbers > records.TOTAL_F:
            values[records.TOTAL_F :] = start.F_total.reshape(n, 9).T
        return raw


def _largest(values: Float) -> float:
    """Maximum; NaN if any value is NaN."""
    return float(values.max())


def _fitting(room: float, stride: float) -> int:
    """Number of strides that fit."""
    if not stride > 0:
        return 1 << 16 if room >= 0 else 0
    return max(0, min(1 << 16, math.floor(room / stride)))
