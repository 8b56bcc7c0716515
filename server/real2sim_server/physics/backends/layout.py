"""Which blocks of the grid hold matter, and who is whose neighbour.

The grid is cut into blocks of 4^3 nodes. Particles are sorted by block and body. A block with
particles of one body is a *home*: it scatters into its own tile of 8^3 nodes, one block and a
margin of two nodes below and above, so that no two homes write to the same place and the sums do
not depend on threads. Particles may leave their home by one cell before they must be sorted again.
A *field* is a block of one body's velocities: homes and all blocks around them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ..colliders import Collider, HeightField
from ..constitutive.obstacle import obstacle_distance
from ..errors import ParticleError
from .base import pack_colliders

Int = NDArray[np.int64]

BLOCK = 4
"""Nodes along the edge of a block."""
COORDINATE_BITS, BODY_BITS = 17, 12
COORDINATE_LIMIT = 1 << (COORDINATE_BITS - 1)
CHUNKS = 64
"""Parts of about equal work that threads share out."""
BLOCK_REACH = 3.5
"""From the centre of a block to its corners [cells]."""
COLLIDER_MARGIN = 2.0
"""Colliders count as near this much earlier [cells]; moving ones may move by half of it."""

_range = np.arange(-1, 2)
OFFSETS: Int = np.stack(np.meshgrid(_range, _range, _range, indexing="ij"), axis=-1).reshape(27, 3)


class Layout(NamedTuple):
    """The blocks of one arrangement; P homes, M fields.

    Attributes:
        home_start: [P + 1], particles of a home in the sorted arrays.
        home_block: [P, 3], block coordinates.
        home_fields: [P, 27], the fields around a home, in the order of OFFSETS.
        home_moment: [P], slot among homes that contact needs moments of, or -1.
        chunk_start: [CHUNKS + 1], homes of each chunk.
        field_block: [M, 3].
        field_body: [M].
        field_homes: [M, 27], the homes around a field, or -1.
        group_start: [G + 1], fields of the same block are neighbours and form a group.
        touch_start: [M + 1], near colliders of each field.
        touch_collider: [T].
        near: [M] bool, whether contact is possible in this field.
    """

    home_start: Int
    home_block: Int
    home_fields: Int
    home_moment: Int
    chunk_start: Int
    field_block: Int
    field_body: Int
    field_homes: Int
    group_start: Int
    touch_start: Int
    touch_collider: Int
    near: NDArray[np.bool_]


def arrange(
    blocks: Int, bodies: Int, dx: float, colliders: Sequence[Collider]
) -> tuple[Int, Layout]:
    """Sort particles by block and body and find all neighbours.

    Args:
        blocks: [N, 3] block of each particle's first node.
        bodies: [N].
        dx: cell size [m].
        colliders: in their present poses.

    Returns:
        order [N], which particle comes at each place, and the layout.

    Raises:
        ParticleError: for particles too far away to be addressed.
    """
    if np.abs(blocks).max(initial=0) >= COORDINATE_LIMIT - 2:
        reach = COORDINATE_LIMIT * BLOCK * dx
        raise ParticleError(
            f"particles must stay within {reach:.0f} m of the origin with cells of {dx} m; move "
            "the scene nearer to the origin or take larger cells"
        )
    keys = _pack(blocks, bodies)
    order = np.argsort(keys, kind="stable")
    home_key, first = np.unique(keys[order], return_index=True)
    home_start = np.append(first, len(keys))
    home_block, home_body = _unpack(home_key)

    around = home_block[:, None] + OFFSETS[None]
    around_key = _pack(around, home_body[:, None])
    field_key, inverse = np.unique(around_key, return_inverse=True)
    home_fields = inverse.reshape(-1, 27)
    field_block, field_body = _unpack(field_key)
    field_homes = np.full((len(field_key), 27), -1)
    # The home at offset o of a field sees that field at offset -o, which is entry 26 - index.
    for o in range(27):
        field_homes[home_fields[:, 26 - o], o] = np.arange(len(home_key))

    block_key = field_key >> BODY_BITS
    group_start = np.append(np.flatnonzero(np.diff(block_key, prepend=-1)), len(field_key))
    touch_start, touch_collider = _touches(field_block, dx, colliders)
    shared = np.repeat(np.diff(group_start) > 1, np.diff(group_start))
    near = shared | (np.diff(touch_start) > 0)
    needed = near[home_fields].any(axis=1)
    return order, Layout(
        home_start=home_start,
        home_block=home_block,
        home_fields=home_fields,
        home_moment=np.where(needed, np.cumsum(needed) - 1, -1),
        chunk_start=_chunks(home_start),
        field_block=field_block,
        field_body=field_body,
        field_homes=field_homes,
        group_start=group_start,
        touch_start=touch_start,
        touch_collider=touch_collider,
        near=near,
    )


def _pack(blocks: Int, bodies: Int) -> Int:
    """One sortable number for block and body."""
    shifted = np.asarray(blocks, dtype=np.int64) + COORDINATE_LIMIT
    key = shifted[..., 0]
    for axis in (1, 2):
        key = (key << COORDINATE_BITS) | shifted[..., axis]
    return (key << BODY_BITS) | bodies


def _unpack(keys: Int) -> tuple[Int, Int]:
    mask = (1 << COORDINATE_BITS) - 1
    blocks = np.stack(
        [(keys >> (BODY_BITS + axis * COORDINATE_BITS)) & mask for axis in (2, 1, 0)], axis=-1
    )
    return blocks - COORDINATE_LIMIT, keys & ((1 << BODY_BITS) - 1)


def _touches(blocks: Int, dx: float, colliders: Sequence[Collider]) -> tuple[Int, Int]:
    """Colliders near each block, as starts [M + 1] and a flat list."""
    centres = (blocks * BLOCK + (BLOCK - 1) / 2) * dx
    rows, heights = pack_colliders(colliders)
    near = np.zeros((len(blocks), len(colliders)), dtype=bool)
    for k, (row, collider) in enumerate(zip(rows, colliders, strict=True)):
        # Distance to a height field is measured along one normal, which misses nearby slopes.
        slack = BLOCK_REACH if isinstance(collider, HeightField) else 0.0
        reach = (BLOCK_REACH + COLLIDER_MARGIN + slack) * dx
        near[:, k] = _distances(row, heights, centres) < reach
    start = np.append(0, np.cumsum(near.sum(axis=1)))
    return start, np.nonzero(near)[1]


def _distances(row: Float, heights: Float, points: Float) -> Float:
    return np.array([obstacle_distance(row, heights, *p)[0] for p in points.tolist()])


def _chunks(home_start: Int) -> Int:
    """Cut homes into CHUNKS of about equal work: particles, and something for the tile itself."""
    homes = len(home_start) - 1
    work = np.append(0, np.cumsum(np.diff(home_start) + 30))
    wanted = work[-1] * np.arange(CHUNKS + 1) / CHUNKS
    cuts = np.searchsorted(work, wanted)
    cuts[0], cuts[-1] = 0, homes
    return cuts.astype(np.int64)
