"""Device memory of one simulation, and the kernel sequences that use it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....geometry import Float
from ...contact import THIN
from ...model import TOTALS, Model
from . import launcher as records
from .launcher import Launch, Launcher

# Sequences of kernel launches, independent of particle motion.

KEY_BYTES = 8


@dataclass(frozen=True)
class Sizes:
    """Sizes of launches: fixed for a simulation, and the capacity of its lists.

    Attributes:
        particles, bodies, colliders: numbers of each.
        obstructed: whether there are thin colliders, which contact particles directly.
        laws: number of constitutive laws in use.
        sort_blocks: thread blocks that share the particle list for sorting.
        blocks, fields, contacts, pairs, thins: capacities on the device, see ``kernels/space.h``.
    """

    particles: int
    bodies: int
    colliders: int
    obstructed: bool
    laws: int
    sort_blocks: int
    blocks: int
    fields: int
    contacts: int
    pairs: int
    thins: int

    @property
    def listed(self) -> int:
        """Length of the longest list that is summed up."""
        return max(self.particles, records.AROUND * self.blocks, 3 * self.fields + self.blocks)


def arranging(sizes: Sizes, *, keep: bool, step: int) -> list[Launch]:
    """Sort particles and build all lists, for the collider poses of a substep.

    Args:
        sizes: sizes of the simulation.
        keep: whether particles stay in their current blocks.
        step: index of the substep.
    """
    by_particle = _groups(sizes.particles)
    launches = [Launch("find_keys", by_particle, int(keep))]
    passes = [records.BY_LAW] if sizes.laws > 1 else []
    # With one body, all keys have the same low byte.
    passes += range(0 if sizes.bodies > 1 else 1, KEY_BYTES)
    for number, one in enumerate(passes):
        argument = one | (records.FLIPPED if number % 2 else 0)
        launches += [
            Launch("count_digits", sizes.sort_blocks, argument),
            Launch("sum_digits", records.DIGITS),
            Launch("scatter_digits", sizes.sort_blocks, argument),
        ]
    launches.append(Launch("reorder", by_particle, records.FLIPPED if len(passes) % 2 else 0))
    launches.append(Launch("mark_blocks", by_particle))
    launches += _summing(records.BLOCKS, sizes.particles)
    launches.append(Launch("fill_blocks", by_particle))
    met = records.AROUND * sizes.blocks
    launches.append(Launch("mark_fields", _groups(met)))
    launches += _summing(records.FIELDS, met)
    launches.append(Launch("fill_fields", _groups(met)))
    launches.append(Launch("link_fields", _groups(records.AROUND * sizes.fields)))
    longest = _groups(max(sizes.fields, sizes.blocks))
    launches.append(Launch("mark_lists", longest, step))
    launches += _summing(records.LISTS, 3 * sizes.fields + sizes.blocks)
    launches.append(Launch("fill_lists", longest, step))
    launches.append(Launch("find_near", _groups(sizes.blocks)))
    return launches


def substeps(sizes: Sizes, first: int, end: int) -> list[Launch]:
    """Launches of substeps: one for the start and two each, more with thin colliders.

    Args:
        sizes: sizes of the simulation.
        first, end: index of the first substep, and of the one after the last.
    """
    groups = _groups(sizes.fields * records.NODES)
    launches = advancing(sizes, records.SCATTERS | first)
    for step in range(first, end):
        does = records.MOVES | records.DEFORMS | (records.SCATTERS if step + 1 < end else 0)
        launches.append(Launch("collect_fields", groups, step))
        launches += advancing(sizes, does | step)
    return launches


def advancing(sizes: Sizes, does: int) -> list[Launch]:
    """Advance the particles of all blocks through the requested stages."""
    launches = [Launch("advance_blocks", sizes.blocks, does)]
    if sizes.obstructed:
        launches.append(Launch("advance_obstructed", sizes.blocks, does))
    return launches


def flushing(sizes: Sizes) -> list[Launch]:
    """Add contact sums to the totals of bodies."""
    rows = sizes.contacts + sizes.pairs + sizes.thins
    totals = sizes.bodies * (sizes.bodies + sizes.colliders)
    return [
        Launch("sum_contacts", _groups(rows * 16)),
        Launch("add_totals", _groups(totals * 8)),
    ]


def measuring(sizes: Sizes) -> list[Launch]:
    """Compute sums and bounds of the particles."""
    return [Launch("measure_blocks", sizes.blocks), Launch("measure_bodies", sizes.bodies)]


def _summing(which: int, length: int) -> list[Launch]:
    pieces = -(-length // records.PIECE)
    return [
        Launch("add_pieces", pieces, which),
        Launch("sum_pieces", 1, which),
        Launch("spread_sums", pieces, which),
    ]


def _groups(threads: int) -> int:
    return max(1, -(-threads // records.THREADS))


SORT_BLOCKS = 512
"""Maximum number of thread blocks that share the list of particles."""
ALIGNMENT = 256
_U4, _U8, _F8 = 4, 8, 8


class SolverMemory:
    """Device memory of a simulation.

    Attributes:
        sizes: capacities.
        pitch: length of the array of one number for all particles.
        numbers: number of values per particle.
        sets: [bytes] uint8 each, see ``kernels/space.h``.
        report: [bytes] uint8, Held, sums of bodies, and contact totals.
    """

    def __init__(self, launcher: Launcher, model: Model, rows: Float, heights: Float) -> None:
        self._launcher, self._model = launcher, model
        colliders = len(rows)
        n, bodies = len(model.masses), model.bodies
        self._real = np.dtype(model.dtype).itemsize
        self.pitch = -(-n // 64) * 64
        self.numbers = records.TOTAL_F + (9 if model.plastic.any() else 0)
        guess = n // 32 + 64
        self.sizes = Sizes(
            particles=n,
            bodies=bodies,
            colliders=colliders,
            obstructed=bool((rows[:, THIN] > 0).any()),
            laws=len(np.unique(model.table[model.material, 0])),
            sort_blocks=max(1, min(SORT_BLOCKS, n // (16 * records.THREADS))),
            blocks=guess,
            fields=2 * guess,
            contacts=64,
            pairs=64,
            thins=16,
        )
        set_bytes = self.pitch * (16 + self.numbers * self._real)
        self.sets = [self._zeros(set_bytes), self._zeros(set_bytes)]
        self._places = [
            0,
            records.HELD.itemsize,
            records.HELD.itemsize + bodies * records.COLUMNS * _F8,
            records.HELD.itemsize + bodies * (records.COLUMNS + colliders * TOTALS) * _F8,
        ]
        totals = bodies * (records.COLUMNS + (colliders + bodies) * TOTALS) * _F8
        self.report = self._zeros(records.HELD.itemsize + totals)
        self._host_report = launcher.host_memory(len(self.report))
        self._staged = launcher.host_memory(0)
        self._spaces: dict[str, Tensor] = {}
        self._space = self._zeros(records.SPACE.itemsize)
        fixed = {
            "table": np.ascontiguousarray(model.table, model.dtype),
            "friction": np.ascontiguousarray(model.friction, np.float64),
            "heights": np.ascontiguousarray(heights, np.float64),
        }
        for name, values in fixed.items():
            self._reserve(name, values.nbytes)
            self.upload(self._spaces[name], values)
        self.grow({})

    @property
    def space(self) -> int:
        """Address of the Space."""
        return self._launcher.pointer(self._space)

    def grow(self, wanted: dict[str, int]) -> None:
        """Grow capacities to ``wanted`` plus a quarter; lists must be rebuilt."""
        held = {name: getattr(self.sizes, name) for name in records.CAPACITIES}
        more: dict[str, Any] = {n: c + c // 4 for n, c in wanted.items() if c > held[n]}
        self.sizes = replace(self.sizes, **more)
        for name, nbytes in self._bytes().items():
            self._reserve(name, nbytes)
        self._describe()

    def upload(self, target: Tensor, values: NDArray[Any]) -> None:
        """Copy an array to the device, asynchronously."""
        if values.nbytes == 0:
            return
        if len(self._staged) < values.nbytes:
            self._staged = self._launcher.host_memory(2 * values.nbytes)
        else:
            self._launcher.wait()  # An earlier upload from this buffer may still be running.
        self._staged.numpy()[: values.nbytes] = values.reshape(-1).view(np.uint8)
        target[: values.nbytes].copy_(self._staged[: values.nbytes], non_blocking=True)

    def upload_step(self, dt: float, moving: bool, rows: Float) -> None:
        """Upload the parameters of the next substeps in one copy."""
        step = np.zeros(1, records.STEP)
        step["dt"], step["moving"] = dt, moving
        nbytes = records.STEP.itemsize + rows.nbytes
        self._reserve_step(nbytes)
        staged = self._step_staged.numpy()
        staged[: records.STEP.itemsize] = step.view(np.uint8)
        staged[records.STEP.itemsize : nbytes] = rows.reshape(-1).view(np.uint8)
        self._spaces["step"][:nbytes].copy_(self._step_staged[:nbytes], non_blocking=True)

    def read_report(self) -> NDArray[np.uint8]:
        """The report, in one copy; waits for all queued work."""
        self._host_report.copy_(self.report, non_blocking=True)
        self._launcher.wait()
        return self._host_report.numpy().copy()

    def held(self, report: NDArray[np.uint8]) -> Any:
        """The Held of a report."""
        return report[: records.HELD.itemsize].view(records.HELD)[0]

    def measured(self, report: NDArray[np.uint8]) -> Float:
        """[B, COLUMNS] sums and bounds of each body in a report."""
        values: Float = report[self._places[1] : self._places[2]].view(np.float64)
        return values.reshape(-1, records.COLUMNS)

    def totals(self, report: NDArray[np.uint8]) -> tuple[Float, Float]:
        """Contact totals in a report, [B, K, TOTALS] and [B, B, TOTALS]."""
        bodies, colliders = self.sizes.bodies, self.sizes.colliders
        on, between = report[self._places[2] : self._places[3]], report[self._places[3] :]
        return (
            on.view(np.float64).reshape(bodies, colliders, TOTALS),
            between.view(np.float64).reshape(bodies, bodies, TOTALS),
        )

    def read_set(self, which: int) -> NDArray[np.uint8]:
        """A set of particles on the host."""
        return self.sets[which].cpu().numpy()

    def keys(self, memory: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """[N] keys of a set, on the host."""
        return memory[: 8 * self.pitch].view(np.uint64)[: self.sizes.particles]

    def words(self, memory: NDArray[np.uint8], which: int) -> NDArray[np.uint32]:
        """[N] materials (0) or indices in the model (1)."""
        first = (8 + 4 * which) * self.pitch
        values: NDArray[np.uint32] = memory[first : first + 4 * self.pitch].view(np.uint32)
        return values[: self.sizes.particles]

    def values(self, memory: NDArray[np.uint8]) -> NDArray[Any]:
        """[numbers, N] values of a set, on the host."""
        values = memory[16 * self.pitch :].view(self._model.dtype)
        return values.reshape(self.numbers, self.pitch)[:, : self.sizes.particles]

    def _bytes(self) -> dict[str, int]:
        s, four = self.sizes, 4 * self._real
        rows = s.contacts + s.pairs + s.thins
        by_particle = {f"{name}_{k}": s.particles for name in ("keys", "order") for k in (0, 1)}
        return {
            **{n: c * (_U8 if n.startswith("keys") else _U4) for n, c in by_particle.items()},
            "digit_counts": (s.sort_blocks + 1) * records.DIGITS * _U4,
            "counts": (s.listed + 1) * _U4,
            "sums": (s.listed // records.PIECE + 2) * _U4,
            "block_key": s.blocks * _U8,
            "field_key": s.fields * _U8,
            "block_start": (s.blocks + 1) * _U4,
            "block_fields": s.blocks * records.AROUND * _U4,
            "block_near": s.blocks * _U4,
            "field_blocks": s.fields * records.AROUND * _U4,
            "field_near": s.fields * _U4,
            "group_start": (s.fields + 1) * _U4,
            "contact_start": (s.fields + 1) * _U4,
            "contact_collider": s.contacts * _U4,
            "contact_field": s.contacts * _U4,
            "pair_start": (s.fields + 1) * _U4,
            "pair_field": s.pairs * _U4,
            "thin_start": (s.blocks + 1) * _U4,
            "thin_collider": s.thins * _U4,
            "thin_block": s.thins * _U4,
            "tiles": s.blocks * records.TILE * four,
            "moments": s.blocks * records.TILE * four,
            "velocity": s.fields * records.NODES * four,
            "offset": s.fields * records.NODES * four,
            "by_collider": s.contacts * records.NODES * TOTALS * _F8,
            "by_pair": s.pairs * records.NODES * 2 * TOTALS * _F8,
            "by_thin": s.thins * records.THREADS * TOTALS * _F8,
            "touched": rows * 2 * TOTALS * _F8,
            "rows": s.blocks * records.COLUMNS * _F8,
        }

    def _describe(self) -> None:
        """Write the addresses of all arrays to the device."""
        space = np.zeros(1, records.SPACE)
        at = self._launcher.pointer
        for name, held in self._spaces.items():
            if name in (records.SPACE.names or ()):
                space[name] = at(held)
        for k in (0, 1):
            space["sets"][0, k] = at(self.sets[k])
            space["keys"][0, k] = at(self._spaces[f"keys_{k}"])
            space["order"][0, k] = at(self._spaces[f"order_{k}"])
        report = at(self.report)
        for name, place in zip(
            ("held", "measured", "collider_totals", "body_totals"), self._places, strict=True
        ):
            space[name] = report + place
        if "step" not in self._spaces:
            self._reserve_step(ALIGNMENT)
            space["step"] = at(self._spaces["step"])
        s = self.sizes
        space["dx"], space["gravity"] = self._model.dtype(self._model.dx), self._model.gravity
        space["particles"], space["pitch"] = s.particles, self.pitch
        space["plastic"] = self.numbers > records.TOTAL_F
        space["bodies"], space["colliders"], space["sort_blocks"] = (
            s.bodies,
            s.colliders,
            s.sort_blocks,
        )
        for name in records.CAPACITIES:
            space[f"{name[:-1]}_capacity"] = getattr(s, name)
        self.upload(self._space, space)

    def _reserve_step(self, nbytes: int) -> None:
        held = self._spaces.get("step")
        if held is None or len(held) < nbytes:
            self._spaces["step"] = self._zeros(2 * nbytes)
            self._step_staged = self._launcher.host_memory(2 * nbytes)
            if held is not None:
                self._describe()

    def _reserve(self, name: str, nbytes: int) -> None:
        held = self._spaces.get(name)
        if held is None or len(held) < nbytes:
            self._spaces.pop(name, None)
            self._spaces[name] = self._zeros(max(ALIGNMENT, nbytes))

    def _zeros(self, nbytes: int) -> Tensor:
        return torch.zeros(nbytes, dtype=torch.uint8, device=self._launcher.device)


# Bytes that a substep moves between memory and multiprocessors, calculated, not measured.

_KEYS, _INDEX = 8, 4


@dataclass(frozen=True)
class Traffic:
    """Memory traffic of one substep [bytes]; arrays read or written by a kernel count in full.

    Attributes:
        particles: positions, deformation, stress, velocities of particles.
        tiles: scattered data of blocks, written and read.
        velocities: node velocities, written once and read by each block around them.
        indices: neighbours of blocks and fields.
        floor: minimum for any algorithm: position and deformation of a particle read and written,
            its mass, volume and material read, and a node of the grid written and read.
    """

    particles: int
    tiles: int
    velocities: int
    indices: int
    floor: int

    @property
    def moved(self) -> int:
        """Total traffic [bytes]."""
        return self.particles + self.tiles + self.velocities + self.indices


def substep_traffic(
    *, particles: int, blocks: int, fields: int, nodes: int, plastic: bool, itemsize: int = 4
) -> Traffic:
    """Traffic of a substep in the middle of an interval without contact.

    Args:
        particles: number of particles.
        blocks, fields: number of blocks and fields of the layout.
        nodes: number of grid nodes with mass.
        plastic: whether particles have a separate total deformation and history.
        itemsize: bytes per number, 4 in single precision.
    """
    # Read: position, F, mass, volume, history. Written: position, velocity, gradient, F, stress,
    # energy. The material is one word.
    numbers = 3 + 9 + 3 + (3 + 3 + 9 + 9 + 6 + 1)
    least = 2 * (3 + 9) + 2
    if plastic:
        numbers += 9 + 9 + 1
        least += 2 * (9 + 1)
    node = 4 * itemsize
    return Traffic(
        particles=particles * (numbers * itemsize + _INDEX),
        tiles=2 * blocks * records.TILE * node,
        velocities=fields * records.NODES * node + blocks * records.TILE * node,
        indices=(blocks + fields) * (records.AROUND * _INDEX + _KEYS),
        floor=particles * (least * itemsize + _INDEX) + 2 * nodes * node,
    )
