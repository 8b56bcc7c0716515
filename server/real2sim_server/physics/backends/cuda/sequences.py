"""Which kernels are launched one after the other: nothing here depends on what particles do."""

from __future__ import annotations

from dataclasses import dataclass

from . import records as r
from .launcher import Launch

KEY_BYTES = 8


@dataclass(frozen=True)
class Sizes:
    """What launches are sized by: fixed for a simulation, and room for its lists.

    Attributes:
        particles, bodies, colliders: numbers of each.
        obstructed: whether there are thin colliders, which particles touch themselves.
        laws: how many constitutive laws its particles follow.
        sort_blocks: blocks of threads that share the list of particles when it is sorted.
        blocks, fields, contacts, pairs, thins: room on the device, see ``kernels/space.h``.
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
        """Longest list that is summed up."""
        return max(self.particles, r.AROUND * self.blocks, 3 * self.fields + self.blocks)


def arranging(sizes: Sizes, *, keep: bool, step: int) -> list[Launch]:
    """Sort particles and make all lists, for colliders as they stand in a substep.

    Args:
        sizes: of the simulation.
        keep: particles stay in the blocks that they are in.
        step: number of the substep.
    """
    by_particle = _groups(sizes.particles)
    launches = [Launch("find_keys", by_particle, int(keep))]
    passes = [r.BY_LAW] if sizes.laws > 1 else []
    # Of one body all keys end alike.
    passes += range(0 if sizes.bodies > 1 else 1, KEY_BYTES)
    for number, one in enumerate(passes):
        argument = one | (r.FLIPPED if number % 2 else 0)
        launches += [
            Launch("count_digits", sizes.sort_blocks, argument),
            Launch("sum_digits", r.DIGITS),
            Launch("scatter_digits", sizes.sort_blocks, argument),
        ]
    launches.append(Launch("reorder", by_particle, r.FLIPPED if len(passes) % 2 else 0))
    launches.append(Launch("mark_blocks", by_particle))
    launches += _summing(r.BLOCKS, sizes.particles)
    launches.append(Launch("fill_blocks", by_particle))
    met = r.AROUND * sizes.blocks
    launches.append(Launch("mark_fields", _groups(met)))
    launches += _summing(r.FIELDS, met)
    launches.append(Launch("fill_fields", _groups(met)))
    launches.append(Launch("link_fields", _groups(r.AROUND * sizes.fields)))
    longest = _groups(max(sizes.fields, sizes.blocks))
    launches.append(Launch("mark_lists", longest, step))
    launches += _summing(r.LISTS, 3 * sizes.fields + sizes.blocks)
    launches.append(Launch("fill_lists", longest, step))
    launches.append(Launch("find_near", _groups(sizes.blocks)))
    return launches


def substeps(sizes: Sizes, first: int, end: int) -> list[Launch]:
    """Substeps of these numbers: one launch, and two for each; more where colliders are thin."""
    groups = _groups(sizes.fields * r.NODES)
    launches = advancing(sizes, r.SCATTERS | first)
    for step in range(first, end):
        does = r.MOVES | r.DEFORMS | (r.SCATTERS if step + 1 < end else 0)
        launches.append(Launch("collect_fields", groups, step))
        launches += advancing(sizes, does | step)
    return launches


def advancing(sizes: Sizes, does: int) -> list[Launch]:
    """Particles of all blocks through what is asked for."""
    launches = [Launch("advance_blocks", sizes.blocks, does)]
    if sizes.obstructed:
        launches.append(Launch("advance_obstructed", sizes.blocks, does))
    return launches


def flushing(sizes: Sizes) -> list[Launch]:
    """Bring what contacts did to the totals of bodies."""
    rows = sizes.contacts + sizes.pairs + sizes.thins
    totals = sizes.bodies * (sizes.bodies + sizes.colliders)
    return [
        Launch("sum_contacts", _groups(rows * 16)),
        Launch("add_totals", _groups(totals * 8)),
    ]


def measuring(sizes: Sizes) -> list[Launch]:
    """Sums and bounds of the particles."""
    return [Launch("measure_blocks", sizes.blocks), Launch("measure_bodies", sizes.bodies)]


def _summing(which: int, length: int) -> list[Launch]:
    pieces = -(-length // r.PIECE)
    return [
        Launch("add_pieces", pieces, which),
        Launch("sum_pieces", 1, which),
        Launch("spread_sums", pieces, which),
    ]


def _groups(threads: int) -> int:
    return max(1, -(-threads // r.THREADS))
