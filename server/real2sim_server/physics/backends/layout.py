"""Occupied blocks of the grid and their neighbours.

The grid is divided into blocks of 4^3 nodes. Particles are sorted by block and body: a *block* of
the kernels holds the particles of one body in one block. It scatters into its own tile of 8^3 nodes
(the block plus a margin of two nodes on each side). No two blocks write to the same memory, so sums
do not depend on threads. Particles may leave their block by one cell before they must be sorted
again. A *field* is a block of nodes with the velocities of one body; it exists for occupied blocks
and all their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ..colliders import Collider, HeightField, Solid
from ..contact import AXES, COUNT_X, COUNT_Y, FIRST_HEIGHT, KIND, PLANE, POINT, SPACING
from ..errors import ParticleError
from ..model import is_thin, pack_colliders

Int = NDArray[np.int64]

BLOCK = 4
"""Nodes along the edge of a block."""
COORDINATE_BITS, BODY_BITS = 17, 12
COORDINATE_LIMIT = 1 << (COORDINATE_BITS - 1)
CHUNKS = 64
"""Number of work items of about equal size, divided among threads."""
BLOCK_REACH = 3.5
"""Distance from the centre of a block to its corners [cells]."""
PARTICLE_CENTRE, PARTICLE_REACH = 2.5, 6.0
"""Centre of the region of a block's particles along an axis, from the first node of the block, and
distance to its corners including the particle radius [cells]."""
COLLIDER_MARGIN = 2.0
"""Additional distance within which colliders count as near [cells]; moving ones may move by half of
it."""

_range = np.arange(-1, 2)
OFFSETS: Int = np.stack(np.meshgrid(_range, _range, _range, indexing="ij"), axis=-1).reshape(27, 3)


class Layout(NamedTuple):
    """One arrangement: P blocks with particles, M fields.

    Attributes:
        block_start: [P + 1], particles of a block in the sorted arrays.
        block_coordinates: [P, 3], in blocks.
        block_fields: [P, 27], the fields around a block, in the order of OFFSETS.
        block_moment: [P], slot among blocks that contact needs moments of, or -1.
        chunk_start: [CHUNKS + 1], blocks of each chunk.
        field_coordinates: [M, 3], in blocks.
        field_body: [M].
        field_blocks: [M, 27], the blocks around a field, or -1.
        group_start: [G + 1], fields of the same block are neighbours and form a group.
        contact_start: [M + 1], near colliders of each field.
        contact_collider: [T].
        thin_start: [P + 1], near colliders of each block with contact of particles.
        thin_collider: [S].
        near: [M] bool, whether contact is possible in this field.
    """

    block_start: Int
    block_coordinates: Int
    block_fields: Int
    block_moment: Int
    chunk_start: Int
    field_coordinates: Int
    field_body: Int
    field_blocks: Int
    group_start: Int
    contact_start: Int
    contact_collider: Int
    thin_start: Int
    thin_collider: Int
    near: NDArray[np.bool_]


def arrange(
    blocks: Int, bodies: Int, laws: NDArray[np.int16], dx: float, colliders: Sequence[Collider]
) -> tuple[Int, Layout]:
    """Sort particles by block and body and find all neighbours.

    Args:
        blocks: [N, 3] block of each particle's first node.
        bodies: [N].
        laws: [N] small numbers; particles of a block are grouped by law.
        dx: cell size [m].
        colliders: colliders in their current poses.

    Returns:
        Particle order [N] and the layout.

    Raises:
        ParticleError: for particles beyond the addressable range.
    """
    if np.abs(blocks).max(initial=0) >= COORDINATE_LIMIT - 2:
        reach = COORDINATE_LIMIT * BLOCK * dx
        raise ParticleError(
            f"particles must stay within {reach:.0f} m of the origin with cells of {dx} m; move "
            "the scene nearer to the origin or take larger cells"
        )
    keys = _pack(blocks, bodies)
    by_law = np.argsort(laws, kind="stable")
    order = by_law[np.argsort(keys[by_law], kind="stable")]
    found_key, first = np.unique(keys[order], return_index=True)
    block_start = np.append(first, len(keys))
    block_coordinates, block_body = _unpack(found_key)

    around = block_coordinates[:, None] + OFFSETS[None]
    around_key = _pack(around, block_body[:, None])
    field_key, inverse = np.unique(around_key, return_inverse=True)
    block_fields = inverse.reshape(-1, 27)
    field_coordinates, field_body = _unpack(field_key)
    field_blocks = np.full((len(field_key), 27), -1)
    # The block at offset o of a field sees that field at offset -o, which is entry 26 - index.
    for o in range(27):
        field_blocks[block_fields[:, 26 - o], o] = np.arange(len(found_key))

    block_key = field_key >> BODY_BITS
    group_start = np.append(np.flatnonzero(np.diff(block_key, prepend=-1)), len(field_key))
    thin = np.array([is_thin(c, dx) for c in colliders], dtype=bool)
    contact_start, contact_collider = _near_colliders(
        field_coordinates,
        dx,
        colliders,
        middle=(BLOCK - 1) / 2,
        reach=BLOCK_REACH,
        wanted=np.full_like(thin, True),
    )
    thin_start, thin_collider = _near_colliders(
        block_coordinates,
        dx,
        colliders,
        middle=PARTICLE_CENTRE,
        reach=PARTICLE_REACH,
        wanted=thin,
    )
    shared = np.repeat(np.diff(group_start) > 1, np.diff(group_start))
    near = shared | (np.diff(contact_start) > 0)
    needed = near[block_fields].any(axis=1)
    return order, Layout(
        block_start=block_start,
        block_coordinates=block_coordinates,
        block_fields=block_fields,
        block_moment=np.where(needed, np.cumsum(needed) - 1, -1),
        chunk_start=_chunks(block_start),
        field_coordinates=field_coordinates,
        field_body=field_body,
        field_blocks=field_blocks,
        group_start=group_start,
        contact_start=contact_start,
        contact_collider=contact_collider,
        thin_start=thin_start,
        thin_collider=thin_collider,
        near=near,
    )


def _pack(blocks: Int, bodies: Int) -> Int:
    """A sortable key of block and body."""
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


def _near_colliders(
    blocks: Int,
    dx: float,
    colliders: Sequence[Collider],
    *,
    middle: float,
    reach: float,
    wanted: NDArray[np.bool_],
) -> tuple[Int, Int]:
    """The ``wanted`` colliders near each block, as starts [M + 1] and a flat list.

    Args:
        blocks: [M, 3].
        dx: cell size [m].
        colliders: all colliders.
        middle: centre of the contact region along each axis, from the first node of the block
            [cells].
        reach: distance from the centre to its corners [cells].
        wanted: [K] bool.
    """
    centres = (blocks * BLOCK + middle) * dx
    rows, heights = pack_colliders(colliders, dx)
    near = np.zeros((len(blocks), len(colliders)), dtype=bool)
    for k in np.flatnonzero(wanted).tolist():
        # The distance to a height field is measured along one normal and misses nearby slopes.
        slack = BLOCK_REACH if isinstance(colliders[k], HeightField) else 0.0
        far = (reach + COLLIDER_MARGIN + slack) * dx
        near[:, k] = distances(colliders[k], rows[k], heights, centres) < far
    start = np.append(0, np.cumsum(near.sum(axis=1)))
    # Contiguous, because strided arrays would compile the kernels once more.
    return start, np.ascontiguousarray(np.nonzero(near)[1])


def distances(
    collider: Collider, row: Float, heights: Float, points: NDArray[np.floating[Any]]
) -> Float:
    """Lower bounds [N] of signed distances [m] of points [N, 3] to a collider."""
    if isinstance(collider, Solid):
        return _distances_to_bounds(collider, points)
    if int(row[KIND]) == PLANE:
        from_plane: Float = (points - row[POINT : POINT + 3]) @ row[AXES : AXES + 3]
        return from_plane
    return _above_ground(row, heights, points)


def _distances_to_bounds(solid: Solid, points: NDArray[np.floating[Any]]) -> Float:
    """Signed distances [N] [m] of points [N, 3] to the bounding box of a solid."""
    low, high = solid.bounds
    local = (points - solid.pose[:3, 3]) @ solid.pose[:3, :3] - (low + high) / 2
    over = np.abs(local) - (high - low) / 2
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
    to_box: Float = outside + np.minimum(over.max(axis=1), 0.0)
    return to_box


def _above_ground(row: Float, heights: Float, points: NDArray[np.floating[Any]]) -> Float:
    first, shape = int(row[FIRST_HEIGHT]), (int(row[COUNT_X]), int(row[COUNT_Y]))
    h = heights[first : first + shape[0] * shape[1]].reshape(shape)
    last = np.array(shape) - 1
    place = np.clip((points[:, :2] - row[POINT : POINT + 2]) / row[SPACING], 0.0, last)
    low = np.minimum(place.astype(np.int64), last - 1)
    (i, j), (a, b) = low.T, (place - low).T
    h00, h01, h10, h11 = h[i, j], h[i, j + 1], h[i + 1, j], h[i + 1, j + 1]
    slope_x = ((h10 - h00) * (1.0 - b) + (h11 - h01) * b) / row[SPACING]
    slope_y = ((h01 - h00) * (1.0 - a) + (h11 - h10) * a) / row[SPACING]
    height = (h00 * (1.0 - a) + h10 * a) * (1.0 - b) + (h01 * (1.0 - a) + h11 * a) * b
    above: Float = (points[:, 2] - height) / np.sqrt(slope_x**2 + slope_y**2 + 1.0)
    return above


def _chunks(block_start: Int) -> Int:
    """Divide blocks into CHUNKS of about equal work, by particles plus a constant per tile."""
    blocks = len(block_start) - 1
    work = np.append(0, np.cumsum(np.diff(block_start) + 30))
    wanted = work[-1] * np.arange(CHUNKS + 1) / CHUNKS
    cuts = np.searchsorted(work, wanted)
    cuts[0], cuts[-1] = 0, blocks
    starts: Int = cuts.astype(np.int64)
    return starts
