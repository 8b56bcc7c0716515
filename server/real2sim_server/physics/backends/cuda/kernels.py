"""The substep on a CUDA device: the CPU's blocks, one group of threads for each.

Blocks add up in shared memory with atomics, fields collect from blocks without any. Threads of a
group divide particles or nodes, however many they are, so the simulator may use few.
"""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numba import config, cuda, float64
from numba.np.numpy_support import from_dtype

from ...contact.node import pair_friction, resolve_node_collider, resolve_node_pair
from ...contact.particle import resolve_particle_collider
from ...numerics.device import F32, ONE, ZERO, device_function
from ...numerics.splines import spline_weights
from ..base import TOTALS
from ..layout import BLOCK
from ..particle import (
    COLUMNS,
    NODES,
    SIDE,
    TILE,
    VOLUME_RATIO,
    add_material,
    add_motion,
    deform,
    momentum,
    move,
    node_position,
    particle_position,
    place,
    tile_node,
    velocity_gradient,
)

SIMULATED = bool(config.ENABLE_CUDASIM)  # type: ignore[attr-defined]
THREADS = 2 if SIMULATED else 128
"""Of a group. The simulator starts a Python thread for each."""
NODE_THREADS = 2 if SIMULATED else NODES
MEASURE_THREADS = 1 if SIMULATED else 32
NEEDS_RESORT, HALTED, DONE = range(3)
"""Entries of ``progress``: a particle left its tile in this substep; no more steps until particles
are sorted; substeps made."""


class Kernels(NamedTuple):
    """Entry points for one precision; see ``kernels_of``."""

    scatter: Any
    collect: Any
    gather: Any
    finish: Any
    measure: Any
    reorder: Any


@device_function
def tile_index(node: Any, o: Any) -> Any:
    """Index on a block's tile of a field's node, or -1; the block is at offset number ``o``."""
    i = node // (BLOCK * BLOCK) + BLOCK * (1 - o // 9)
    j = node // BLOCK % BLOCK + BLOCK * (1 - o // 3 % 3)
    k = node % BLOCK + BLOCK * (1 - o % 3)
    inside = -1 <= i < SIDE - 1 and -1 <= j < SIDE - 1 and -1 <= k < SIDE - 1
    return tile_node(i, j, k) if inside else -1


@device_function
def field_of(index: Any) -> Any:
    """Where a node of a tile is stored: offset number of its field, and node on that field."""
    i, j, k = index // (SIDE * SIDE) - 1, index // SIDE % SIDE - 1, index % SIDE - 1
    o = (i // BLOCK + 1) * 9 + (j // BLOCK + 1) * 3 + k // BLOCK + 1
    return o, (i % BLOCK * BLOCK + j % BLOCK) * BLOCK + k % BLOCK


@device_function
def collect_node(field: Any, node: Any, dt: Any, layout: Any, work: Any, params: Any) -> None:
    """Sum one node of a field from the tiles around it, always in the same order; to velocity."""
    zero = ZERO * params.dx
    px, py, pz, m = zero, zero, zero, zero
    for o in range(27):
        block = layout.field_blocks[field, o]
        index = tile_index(node, o) if block >= 0 else -1
        if index >= 0:
            px += work.tiles[block, index, 0]
            py += work.tiles[block, index, 1]
            pz += work.tiles[block, index, 2]
            m += work.tiles[block, index, 3]
    inverse = ONE / m if m > ZERO else zero
    work.velocity[field, node, 0] = px * inverse + dt * params.gravity[0]
    work.velocity[field, node, 1] = py * inverse + dt * params.gravity[1]
    work.velocity[field, node, 2] = pz * inverse + dt * params.gravity[2]
    work.velocity[field, node, 3] = m


@device_function
def collect_moment(field: Any, node: Any, layout: Any, work: Any) -> None:
    """Sum the first moment of one node; every block around a near field has some."""
    for c in range(4):
        work.offset[field, node, c] = ZERO
    for o in range(27):
        block = layout.field_blocks[field, o]
        index = tile_index(node, o) if block >= 0 else -1
        if index >= 0:
            slot = layout.block_moment[block]
            for c in range(4):
                work.offset[field, node, c] += work.moments[slot, index, c]


@cuda.jit(device=True)
def add_particles(block, thread, dt, state, layout, params, tile):
    """Add momentum and mass of one block's particles to its tile."""
    for p in range(layout.block_start[block] + thread, layout.block_start[block + 1], THREADS):
        first, f = place(p, state.xi)
        start, qx, qy, qz = momentum(p, dt, params.dx, f, state)
        wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    w = wx[a] * wy[b] * wz[c]
                    node = first + (a * SIDE + b) * SIDE + c
                    i, j, k = F32(a), F32(b), F32(c)
                    for axis in range(3):
                        at = start[axis] + i * qx[axis] + j * qy[axis] + k * qz[axis]
                        cuda.atomic.add(tile, (node, axis), w * at)
                    cuda.atomic.add(tile, (node, 3), w * state.mass[p])


@cuda.jit(device=True)
def add_volumes(block, thread, state, layout, tile):
    """Add w V (x_p - x_i) and w V of one block's particles to its tile; V at rest."""
    for p in range(layout.block_start[block] + thread, layout.block_start[block + 1], THREADS):
        first, f = place(p, state.xi)
        wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    volume = wx[a] * wy[b] * wz[c] * state.volume[p]
                    node = first + (a * SIDE + b) * SIDE + c
                    cuda.atomic.add(tile, (node, 0), volume * (f[0] - F32(a)))
                    cuda.atomic.add(tile, (node, 1), volume * (f[1] - F32(b)))
                    cuda.atomic.add(tile, (node, 2), volume * (f[2] - F32(c)))
                    cuda.atomic.add(tile, (node, 3), volume)


@device_function
def gather_sums(first: Any, f: Any, tile: Any) -> Any:
    """Twelve sums over a particle's nodes, see ``particle.velocity_gradient``."""
    wx, wy, wz = spline_weights(f[0]), spline_weights(f[1]), spline_weights(f[2])
    zero = ZERO * f[0]
    vx, vy, vz = zero, zero, zero
    xi, xj, xk = zero, zero, zero
    yi, yj, yk = zero, zero, zero
    zi, zj, zk = zero, zero, zero
    for a in range(3):
        for b in range(3):
            for c in range(3):
                w = wx[a] * wy[b] * wz[c]
                node = first + (a * SIDE + b) * SIDE + c
                i, j, k = F32(a), F32(b), F32(c)
                x, y, z = w * tile[node, 0], w * tile[node, 1], w * tile[node, 2]
                vx, vy, vz = vx + x, vy + y, vz + z
                xi, xj, xk = xi + i * x, xj + j * x, xk + k * x
                yi, yj, yk = yi + i * y, yj + j * y, yk + k * y
                zi, zj, zk = zi + i * z, zj + j * z, zk + k * z
    return vx, vy, vz, xi, yi, zi, xj, yj, zj, xk, yk, zk


@cuda.jit(device=True)
def clear(thread, tile):
    """Zero a tile."""
    for index in range(thread, TILE, THREADS):
        for c in range(4):
            tile[index, c] = ZERO


@cuda.jit(device=True)
def store(thread, tile, out):
    """Copy a tile out of shared memory."""
    for index in range(thread, TILE, THREADS):
        for c in range(4):
            out[index, c] = tile[index, c]


@cuda.jit(device=True)
def load_velocities(block, thread, layout, work, tile):
    """Copy the velocities around a block to its tile."""
    for index in range(thread, TILE, THREADS):
        o, node = field_of(index)
        field = layout.block_fields[block, o]
        for c in range(3):
            tile[index, c] = work.velocity[field, node, c]


@functools.cache
def kernels_of(dtype: Any) -> Kernels:
    """The kernels for one precision; compiled when first launched.

    Shared memory needs its type when it is compiled, hence the functions in a function.
    """
    number = from_dtype(np.dtype(dtype))

    @cuda.jit
    def scatter(dt, state, layout, work, params, progress):
        """Particles of one block to its tile, then volumes where contact asks for them."""
        if progress[HALTED] != 0:
            return
        block, thread = cuda.blockIdx.x, cuda.threadIdx.x
        tile = cuda.shared.array((TILE, 4), number)
        clear(thread, tile)
        cuda.syncthreads()
        add_particles(block, thread, dt, state, layout, params, tile)
        cuda.syncthreads()
        store(thread, tile, work.tiles[block])
        slot = layout.block_moment[block]
        if slot < 0:
            return
        cuda.syncthreads()
        clear(thread, tile)
        cuda.syncthreads()
        add_volumes(block, thread, state, layout, tile)
        cuda.syncthreads()
        store(thread, tile, work.moments[slot])

    @cuda.jit
    def gather(dt, state, layout, work, params, progress, moving):
        """Fields to the particles of one block when ``moving``, then stress."""
        if progress[HALTED] != 0:
            return
        block, thread = cuda.blockIdx.x, cuda.threadIdx.x
        tile = cuda.shared.array((TILE, 4), number)
        if moving:
            load_velocities(block, thread, layout, work, tile)
        cuda.syncthreads()
        for p in range(layout.block_start[block] + thread, layout.block_start[block + 1], THREADS):
            if moving:
                first, f = place(p, state.xi)
                g = gather_sums(first, f, tile)
                L = velocity_gradient(g, params.dx, f)
                v = (float(g[0]), float(g[1]), float(g[2]))
                if layout.thin_start[block] < layout.thin_start[block + 1]:
                    v = hold_particle(p, v, block, dt, state, layout, work, params)
                if move(p, dt, params.dx, v, L, state):
                    progress[NEEDS_RESORT] = 1
            deform(p, dt, state, params.table[state.material[p]])

    return Kernels(scatter, collect, gather, finish, measure, reorder)


@cuda.jit
def collect(dt, layout, work, params, progress):
    """Tiles to the fields of one group: sums, gravity, contact. Nodes do not know each other."""
    if progress[HALTED] != 0:
        return
    group = cuda.blockIdx.x
    begin, end = layout.group_start[group], layout.group_start[group + 1]
    for node in range(cuda.threadIdx.x, NODES, NODE_THREADS):
        for field in range(begin, end):
            collect_node(field, node, dt, layout, work, params)
            if layout.near[field]:
                collect_moment(field, node, layout, work)
        at = node_position(layout.field_coordinates[begin], node, params.dx)
        for a in range(begin, end):
            for b in range(a + 1, end):
                if work.velocity[a, node, 3] > ZERO and work.velocity[b, node, 3] > ZERO:
                    collide(a, b, node, at, layout, work, params)
        for field in range(begin, end):
            if work.velocity[field, node, 3] > ZERO:
                obstruct(field, node, at, layout, work, params)


@cuda.jit(device=True)
def collide(a, b, node, at, layout, work, params):
    """Contact of two bodies at one node; what it did goes to the totals of both."""
    on_a = cuda.local.array(TOTALS, float64)
    on_b = cuda.local.array(TOTALS, float64)
    for c in range(TOTALS):
        on_a[c] = 0.0
        on_b[c] = 0.0
    body_a, body_b = layout.field_body[a], layout.field_body[b]
    friction = pair_friction(params.friction[body_a], params.friction[body_b])
    resolve_node_pair(
        work.velocity[a, node], work.velocity[b, node],
        work.offset[a, node], work.offset[b, node],
        friction, params.dx, at, on_a, on_b,
    )  # fmt: skip
    for c in range(TOTALS):
        if on_a[c] != 0.0:
            cuda.atomic.add(work.by_body, (a, body_b, c), on_a[c])
        if on_b[c] != 0.0:
            cuda.atomic.add(work.by_body, (b, body_a, c), on_b[c])


@cuda.jit(device=True)
def obstruct(field, node, at, layout, work, params):
    """Contact of one body's node with every collider near its field."""
    friction = params.friction[layout.field_body[field]]
    for contact in range(layout.contact_start[field], layout.contact_start[field + 1]):
        total = cuda.local.array(TOTALS, float64)
        for c in range(TOTALS):
            total[c] = 0.0
        row = params.collider_rows[layout.contact_collider[contact]]
        resolve_node_collider(
            row, params.heights, params.dx, friction, at,
            work.velocity[field, node], work.offset[field, node], total,
        )  # fmt: skip
        for c in range(TOTALS):
            if total[c] != 0.0:
                cuda.atomic.add(work.by_collider, (contact, c), total[c])


@cuda.jit(device=True)
def hold_particle(p, v, block, dt, state, layout, work, params):
    """Velocity of a particle near thin colliders; ``particle.obstructed`` for many threads."""
    x = particle_position(layout.block_coordinates[block], p, state.xi, params.dx)
    friction = params.friction[layout.field_body[layout.block_fields[block, 13]]]
    volume, m = state.volume[p], float(state.mass[p])
    first, end = layout.thin_start[block], layout.thin_start[block + 1]
    total = cuda.local.array(TOTALS, float64)
    for _ in range(min(end - first, 2)):
        for contact in range(first, end):
            for c in range(TOTALS):
                total[c] = 0.0
            row = params.collider_rows[layout.thin_collider[contact]]
            v = resolve_particle_collider(row, dt, friction, volume, x, v, m, total)
            for c in range(TOTALS):
                if total[c] != 0.0:
                    cuda.atomic.add(work.by_thin, (contact, c), total[c])
    return v


@cuda.jit
def finish(progress):
    """End of a substep, by one thread: count it, and halt when particles must be sorted."""
    if progress[HALTED] == 0:
        progress[DONE] += 1
        progress[HALTED] = progress[NEEDS_RESORT]


@cuda.jit
def measure(state, layout, params, out):
    """Fill ``out`` [P MEASURE_THREADS, COLUMNS] float64, one row for each thread of each block."""
    block, thread = cuda.blockIdx.x, cuda.threadIdx.x
    row = out[block * MEASURE_THREADS + thread]
    for c in range(COLUMNS):
        row[c] = 0.0
    row[VOLUME_RATIO] = math.inf
    begin, end = layout.block_start[block], layout.block_start[block + 1]
    for p in range(begin + thread, end, MEASURE_THREADS):
        add_motion(p, layout.block_coordinates[block], state, params.dx, row)
        add_material(p, state, params.table[state.material[p]], row)


@cuda.jit
def reorder(source, order, out):
    """Rows of ``source`` [N, C] in another order."""
    p = cuda.grid(1)
    if p < order.shape[0]:
        for c in range(source.shape[1]):
            out[p, c] = source[order[p], c]
