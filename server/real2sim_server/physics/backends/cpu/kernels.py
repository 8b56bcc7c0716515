"""The substep on the CPU: blocks scatter to tiles, fields add up and touch, blocks gather."""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917
# Numba types intrinsics without their typing context.
# mypy: disable-error-code="call-arg, unreachable, var-annotated"

from __future__ import annotations

from typing import Any

from numba import prange

from ...numerics.device import ONE, ZERO
from ...numerics.splines import spline_weights
from ..kernel import entry, inner
from ..layout import BLOCK, CHUNKS
from ..particle import NODES, SIDE, momentum, move, obstructed, place, velocity_gradient
from .contact import resolve_body_contact, resolve_collider_contact
from .deform import deform_all
from .simd import LANES, gather, scatter


@entry()
def advance(steps: Any, dt: Any, state: Any, layout: Any, work: Any, params: Any) -> Any:
    """Make up to ``steps`` substeps; returns how many, fewer when particles must be sorted.

    No steps at all find the stress and energy of the particles as they stand.
    """
    if steps == 0:
        gather_blocks(dt, state, layout, work, params, False, False)
    else:
        scatter_blocks(dt, state, layout, work, params)
    for done in range(steps):
        collect_fields(dt, layout, work, params)
        gather_blocks(dt, state, layout, work, params, True, done + 1 < steps)
        if work.needs_resort.any():
            return done + 1
    return steps


@inner(parallel=True)
def scatter_blocks(dt: Any, state: Any, layout: Any, work: Any, params: Any) -> None:
    """Particles to tiles: momentum with APIC and stress (MLS-MPM, Hu et al. 2018), mass."""
    for chunk in prange(CHUNKS):
        for block in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            scatter_block(block, dt, state, layout, work, params)


@inner()
def scatter_block(block: Any, dt: Any, state: Any, layout: Any, work: Any, params: Any) -> None:
    """Add the particles of one block to its tile, and their moments where contact needs them."""
    tile = work.tiles[block]
    tile[:] = ZERO
    begin, end = layout.block_start[block], layout.block_start[block + 1]
    scatter_particles(begin, end, dt, params.dx, state, tile.reshape(-1))
    slot = layout.block_moment[block]
    if slot >= 0:
        moments = work.moments[slot]
        moments[:] = ZERO
        scatter_moments(begin, end, state, moments.reshape(-1))


@inner()
def scatter_particles(begin: Any, end: Any, dt: Any, dx: Any, state: Any, tile: Any) -> None:
    """Add the particles of one block to its tile."""
    for p in range(begin, end):
        first, f = place(p, state.xi)
        start, qx, qy, qz = momentum(p, dt, dx, f, state)
        wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
        scatter(tile, first, wx, wy, wz, (*start, state.mass[p]), qx, qy, qz)


@inner()
def scatter_moments(begin: Any, end: Any, state: Any, moments: Any) -> None:
    """Add w V (x_p - x_i) and w V of one block's particles to its moments; V at rest."""
    for p in range(begin, end):
        first, f = place(p, state.xi)
        V = state.volume[p]
        zero = ZERO * V
        wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
        start = (V * f[0], V * f[1], V * f[2], V)
        scatter(
            moments, first, wx, wy, wz, start, (-V, zero, zero), (zero, -V, zero), (zero, zero, -V)
        )


@inner(parallel=True)
def collect_fields(dt: Any, layout: Any, work: Any, params: Any) -> None:
    """Tiles to fields: sums, gravity, contact. One group of fields is one task."""
    groups = len(layout.group_start) - 1
    for group in prange(groups):
        begin, end = layout.group_start[group], layout.group_start[group + 1]
        for field in range(begin, end):
            collect(field, layout.field_blocks, work.tiles, work.velocity[field])
            to_velocity(work.velocity[field], dt, params.gravity)
            if layout.near[field]:
                collect_moments(field, layout, work)
        if end - begin > 1:
            resolve_body_contact(begin, end, layout, work, params)
        for field in range(begin, end):
            if layout.contact_start[field] < layout.contact_start[field + 1]:
                resolve_collider_contact(field, layout, work, params)


@inner()
def overlap(offset: Any) -> Any:
    """(first, end, shift): nodes of a block that lie on a tile ``offset`` blocks below; tile index
    is node + shift."""
    if offset < 0:
        return BLOCK - 1, BLOCK, 1 - BLOCK
    if offset > 0:
        return 0, SIDE - 1 - BLOCK, 1 + BLOCK
    return 0, BLOCK, 1


@inner()
def collect(field: Any, field_blocks: Any, tiles: Any, out: Any) -> None:
    """Sum a field from the tiles of the blocks around it, always in the same order."""
    out[:] = ZERO
    for o in range(27):
        block = field_blocks[field, o]
        if block >= 0:
            add_tile(tiles[block], o, out)


@inner()
def add_tile(tile: Any, o: Any, out: Any) -> None:
    """Add a tile to a field; the tile's block lies at offset number ``o``."""
    i0, i1, si = overlap(1 - o // 9)
    j0, j1, sj = overlap(1 - o // 3 % 3)
    k0, k1, sk = overlap(1 - o % 3)
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = (i * BLOCK + j) * BLOCK
            source = ((i + si) * SIDE + j + sj) * SIDE + sk
            for k in range(k0, k1):
                for lane in range(LANES):
                    out[row + k, lane] += tile[source + k, lane]


@inner()
def collect_moments(field: Any, layout: Any, work: Any) -> None:
    """Sum the first moments of a field; every block around a near field has some."""
    out = work.offset[field]
    out[:] = ZERO
    for o in range(27):
        block = layout.field_blocks[field, o]
        if block >= 0:
            add_tile(work.moments[layout.block_moment[block]], o, out)


@inner()
def to_velocity(field: Any, dt: Any, gravity: Any) -> None:
    """Momentum to velocity, with gravity."""
    gx, gy, gz = dt * gravity[0], dt * gravity[1], dt * gravity[2]
    for node in range(NODES):
        m = field[node, 3]
        if m > ZERO:
            inverse = ONE / m
            field[node, 0] = field[node, 0] * inverse + gx
            field[node, 1] = field[node, 1] * inverse + gy
            field[node, 2] = field[node, 2] * inverse + gz


@inner(parallel=True)
def gather_blocks(
    dt: Any, state: Any, layout: Any, work: Any, params: Any, moving: Any, scatter_next: Any
) -> None:
    """Fields to particles when ``moving``, then stress.

    When ``scatter_next``, already the scattering of the next substep, while a block's particles
    are in the cache.
    """
    for chunk in prange(CHUNKS):
        for block in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            tile = work.tiles[block]
            for o in range(27):
                copy_field(work.velocity[layout.block_fields[block, o]], o, tile)
            begin, end = layout.block_start[block], layout.block_start[block + 1]
            if moving and layout.thin_start[block] < layout.thin_start[block + 1]:
                left_tile = gather_obstructed(block, dt, state, layout, work, params)
            else:
                left_tile = gather_particles(
                    begin, end, dt, params.dx, state, tile.reshape(-1), moving
                )
            deform_all(begin, end, dt, state, params.table, work.scratch[chunk])
            set_flag(work.needs_resort, block, left_tile)
            # Particles that left the tile cannot be scattered to it; all are sorted first.
            if scatter_next and not left_tile:
                scatter_block(block, dt, state, layout, work, params)


@inner()
def set_flag(flags: Any, index: Any, flag: Any) -> None:
    """Store a flag. As a plain assignment in the parallel loop Numba takes it for dead code."""
    flags[index] = flag


@inner()
def copy_field(field: Any, o: Any, tile: Any) -> None:
    """Copy to a tile the nodes of the field at offset number ``o`` from the block."""
    i0, i1, si = overlap(o // 9 - 1)
    j0, j1, sj = overlap(o // 3 % 3 - 1)
    k0, k1, sk = overlap(o % 3 - 1)
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = (i * BLOCK + j) * BLOCK
            target = ((i + si) * SIDE + j + sj) * SIDE + sk
            for k in range(k0, k1):
                for lane in range(LANES):
                    tile[target + k, lane] = field[row + k, lane]


@inner()
def gather_particles(
    begin: Any, end: Any, dt: Any, dx: Any, state: Any, tile: Any, moving: Any
) -> Any:
    """Move the particles of one block; returns whether one left its tile."""
    needs_resort = False
    if moving:
        for p in range(begin, end):
            first, f = place(p, state.xi)
            wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
            g = gather(tile, first, wx, wy, wz)
            L = velocity_gradient(g, dx, f)
            if move(p, dt, dx, (g[0], g[1], g[2]), L, state):
                needs_resort = True
    return needs_resort


@inner()
def gather_obstructed(block: Any, dt: Any, state: Any, layout: Any, work: Any, params: Any) -> Any:
    """The same for a block near thin colliders, which its particles touch themselves."""
    tile, dx = work.tiles[block].reshape(-1), params.dx
    needs_resort = False
    for p in range(layout.block_start[block], layout.block_start[block + 1]):
        first, f = place(p, state.xi)
        wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
        g = gather(tile, first, wx, wy, wz)
        L = velocity_gradient(g, dx, f)
        v = obstructed(p, g, block, dt, state, layout, params, work.by_thin)
        if move(p, dt, dx, v, L, state):
            needs_resort = True
    return needs_resort
