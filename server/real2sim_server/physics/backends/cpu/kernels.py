"""The substep on the CPU: blocks scatter to tiles, fields apply contact, blocks gather."""

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917
# Numba types intrinsics without their typing context.
# mypy: disable-error-code="call-arg, unreachable, var-annotated"

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...contact import pair_friction, resolve_node_collider, resolve_node_pair
from ...numerics import ONE, ZERO, entry, inner, spline_weights
from ..layout import BLOCK, CHUNKS
from .deform import deform_all
from .particle import (
    NODES,
    SIDE,
    VOLUME_RATIO,
    add_material,
    add_motion,
    momentum,
    move,
    node_position,
    obstructed,
    place,
    velocity_gradient,
)


@inner()
def resolve_collider_contact(field: Any, layout: Any, work: Any, params: Any) -> None:
    """Contact of one body's field with every collider near it."""
    friction = params.friction[layout.field_body[field]]
    for contact in range(layout.contact_start[field], layout.contact_start[field + 1]):
        row = params.collider_rows[layout.contact_collider[contact]]
        total = work.by_collider[contact]
        for node in range(BLOCK**3):
            if work.velocity[field, node, 3] > ZERO:
                at = node_position(layout.field_coordinates[field], node, params.dx)
                resolve_node_collider(
                    row, params.heights, params.dx, friction, at,
                    work.velocity[field, node], work.offset[field, node], total,
                )  # fmt: skip


@inner()
def resolve_body_contact(begin: Any, end: Any, layout: Any, work: Any, params: Any) -> None:
    """Contact of each pair of bodies in one block, in a fixed order (Bardenhagen et al. 2001)."""
    for a in range(begin, end):
        for b in range(a + 1, end):
            body_a, body_b = layout.field_body[a], layout.field_body[b]
            friction = pair_friction(params.friction[body_a], params.friction[body_b])
            for node in range(BLOCK**3):
                if work.velocity[a, node, 3] > ZERO and work.velocity[b, node, 3] > ZERO:
                    at = node_position(layout.field_coordinates[a], node, params.dx)
                    resolve_node_pair(
                        work.velocity[a, node], work.velocity[b, node],
                        work.offset[a, node], work.offset[b, node],
                        friction, params.dx, at, work.by_body[a, body_b], work.by_body[b, body_a],
                    )  # fmt: skip


@entry(parallel=True)
def measure_blocks(state: Any, layout: Any, params: Any, out: Any) -> None:
    """Fill ``out`` [P, COLUMNS] float64, one row for each block."""
    for chunk in prange(CHUNKS):
        for block in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            row = out[block]
            row[:] = 0.0
            row[VOLUME_RATIO] = math.inf
            begin, end = layout.block_start[block], layout.block_start[block + 1]
            for p in range(begin, end):
                add_motion(p, layout.block_coordinates[block], state, params.dx, row)
                add_material(p, state, params.table[state.material[p]], row)


# Transfers between one particle and its 27 nodes as explicit vector code. A node is four
# consecutive numbers, so one LLVM vector; LLVM's own vectorisers do not find this pattern in scalar
# loops. Precision follows the array.


LANES = 4
I32 = ir.IntType(32)


class _LaneEmitter:
    """Builds vector arithmetic in the array's precision, on nodes and on lines of three nodes."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kind: Any, array: Any) -> None:
        self.builder = builder
        self.scalar = context.get_value_type(kind.dtype)
        self.node = ir.VectorType(self.scalar, LANES)
        self.line = ir.VectorType(self.scalar, 3 * LANES)
        self.data = context.make_array(kind)(context, builder, array).data

    def splat(self, scalar: Any, kind: Any) -> Any:
        """A scalar in all lanes of a node or of a line."""
        single = self.builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, I32(0))
        return self._pick(single, [0] * kind.count)

    def pack(self, scalars: list[Any]) -> Any:
        """A node of these numbers; missing ones are zero."""
        vector = ir.Constant(self.node, [0.0] * LANES)
        for lane, scalar in enumerate(scalars):
            vector = self.builder.insert_element(vector, scalar, I32(lane))
        return vector

    def repeated(self, node: Any) -> Any:
        """A line of three copies of a node."""
        return self._pick(node, [*range(LANES)] * 3)

    def nodes(self, line: Any) -> list[Any]:
        """The three nodes of a line."""
        return [self._pick(line, list(range(k * LANES, (k + 1) * LANES))) for k in range(3)]

    def spread(self, scalars: list[Any]) -> Any:
        """A line of three scalars, each in all lanes of its node."""
        return self._pick(self.pack(scalars), [k for k in range(3) for _ in range(LANES)])

    def _pick(self, vector: Any, lanes: list[int]) -> Any:
        mask = ir.Constant(ir.VectorType(I32, len(lanes)), lanes)
        return self.builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), mask)

    def fused(self, a: Any, b: Any, c: Any) -> Any:
        """a * b + c."""
        kind = a.type
        name = f"llvm.fmuladd.v{kind.count}f{'32' if kind.element == ir.FloatType() else '64'}"
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind] * 3), name
        )
        return self.builder.call(function, [a, b, c])

    def place(self, first: Any, i: int, j: int) -> Any:
        """Pointer to the line (i, j) relative to node number ``first``."""
        index = self.builder.add(first, ir.Constant(first.type, (i * SIDE + j) * SIDE))
        index = self.builder.mul(index, ir.Constant(first.type, LANES))
        pointer = self.builder.gep(self.data, [index], source_etype=self.scalar)
        return self.builder.bitcast(pointer, self.line.as_pointer())

    def load(self, pointer: Any) -> Any:
        return self.builder.load(pointer, typ=self.line, align=4)

    def store(self, value: Any, pointer: Any) -> None:
        self.builder.store(value, pointer, align=4)


def _unpack(builder: ir.IRBuilder, value: Any, count: int) -> list[Any]:
    return [builder.extract_value(value, i) for i in range(count)]


@intrinsic
def scatter(typingctx, tiles, first, wx, wy, wz, start, qx, qy, qz):
    """Add w (start + i qx + j qy + k qz) to the nodes at offsets (i, j, k) from ``first``.

    Args: ``tiles``: flat array; ``wx``, ``wy``, ``wz``: three weights each; ``start``: four
    numbers; ``qx``, ``qy``, ``qz``: three numbers each.
    """

    def generate(context, builder, signature, arguments):
        e = _LaneEmitter(context, builder, signature.args[0], arguments[0])
        weights = [_unpack(builder, a, 3) for a in arguments[2:5]]
        along_z = e.spread(weights[2])
        x, y, z = (e.repeated(e.pack(_unpack(builder, a, 3))) for a in arguments[6:9])
        steps = [builder.fmul(along_z, step) for step in (x, y)]
        value = e.repeated(e.pack(_unpack(builder, arguments[5], 4)))
        numbers = e.spread([ir.Constant(e.scalar, float(k)) for k in range(3)])
        value = builder.fmul(along_z, e.fused(z, numbers, value))
        for i in range(3):
            line = value
            for j in range(3):
                weight = e.splat(builder.fmul(weights[0][i], weights[1][j]), e.line)
                pointer = e.place(arguments[1], i, j)
                e.store(e.fused(weight, line, e.load(pointer)), pointer)
                line = builder.fadd(line, steps[1])
            value = builder.fadd(value, steps[0])
        return context.get_dummy_value()

    number = tiles.dtype
    three, four = types.UniTuple(number, 3), types.UniTuple(number, 4)
    kinds = (tiles, types.int64, three, three, three, four, three, three, three)
    return types.void(*kinds), generate


@intrinsic
def gather(typingctx, tiles, first, wx, wy, wz):
    """Twelve numbers: sum w v, and sum w v times the offset i, j and k of each node."""

    def generate(context, builder, signature, arguments):
        e = _LaneEmitter(context, builder, signature.args[0], arguments[0])
        weights = [_unpack(builder, a, 3) for a in arguments[2:5]]
        wx, wy = ([e.splat(w, e.line) for w in axis] for axis in weights[:2])
        wz = [e.splat(w, e.node) for w in weights[2]]
        rows = []
        for i in range(3):
            lines = [e.load(e.place(arguments[1], i, j)) for j in range(3)]
            rows.append((_total(e, wy, lines), _lever(e, wy, lines)))
        totals, levers = zip(*rows, strict=True)
        plain, by_x, by_y = (
            e.nodes(line)
            for line in (_total(e, wx, totals), _lever(e, wx, totals), _total(e, wx, levers))
        )
        vectors = (
            _total(e, wz, plain),
            _total(e, wz, by_x),
            _total(e, wz, by_y),
            _lever(e, wz, plain),
        )
        values = [builder.extract_element(v, I32(c)) for v in vectors for c in (0, 1, 2)]
        return context.make_tuple(builder, signature.return_type, values)

    number = tiles.dtype
    three = types.UniTuple(number, 3)
    return types.UniTuple(number, 12)(tiles, types.int64, three, three, three), generate


def _total(e: _LaneEmitter, w: Sequence[Any], v: Sequence[Any]) -> Any:
    """Sum of w v over three neighbours."""
    return e.fused(w[2], v[2], e.fused(w[1], v[1], e.builder.fmul(w[0], v[0])))


def _lever(e: _LaneEmitter, w: Sequence[Any], v: Sequence[Any]) -> Any:
    """Sum of w v times 0, 1, 2 over three neighbours."""
    return e.fused(e.builder.fadd(w[2], w[2]), v[2], e.builder.fmul(w[1], v[1]))


@entry()
def advance(steps: Any, dt: Any, state: Any, layout: Any, work: Any, params: Any) -> Any:
    """Make up to ``steps`` substeps and return their number; fewer if particles must be sorted.

    With 0 steps, compute stress and energy of the current particles.
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
    """Transfer particle momentum and mass to tiles (APIC; MLS-MPM stress, Hu et al. 2018)."""
    for chunk in prange(CHUNKS):
        for block in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            scatter_block(block, dt, state, layout, work, params)


@inner()
def scatter_block(block: Any, dt: Any, state: Any, layout: Any, work: Any, params: Any) -> None:
    """Add the particles of one block to its tile, and their moments if contact needs them."""
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
    """Add w V (x_p - x_i) and w V of one block's particles to its moments; V is the rest volume."""
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
    """Combine tiles into fields: sums, gravity, contact. Each group of fields is one task."""
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
    """Nodes of a block on the tile of the block at ``offset`` below it.

    Returns (first, end, shift); the tile index is node + shift.
    """
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
    """Add a tile to a field; ``o``: number of the offset of the tile's block."""
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
    """Sum the first moments of a field; every block around a field near contact has some."""
    out = work.offset[field]
    out[:] = ZERO
    for o in range(27):
        block = layout.field_blocks[field, o]
        if block >= 0:
            add_tile(work.moments[layout.block_moment[block]], o, out)


@inner()
def to_velocity(field: Any, dt: Any, gravity: Any) -> None:
    """Convert momentum to velocity and add gravity."""
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
    """Transfer fields to particles if ``moving``, then compute stress.

    With ``scatter_next``, also scatter for the next substep while a block's particles are cached.
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
            # Particles outside the tile cannot be scattered to it: sort all particles first.
            if scatter_next and not left_tile:
                scatter_block(block, dt, state, layout, work, params)


@inner()
def set_flag(flags: Any, index: Any, flag: Any) -> None:
    """Store a flag. Numba would remove a plain assignment in the parallel loop as dead code."""
    flags[index] = flag


@inner()
def copy_field(field: Any, o: Any, tile: Any) -> None:
    """Copy the nodes of the field at offset number ``o`` from the block to a tile."""
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
    """Move the particles of one block; return whether one left its tile."""
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
    """``gather_particles`` for a block near thin colliders, with contact of its particles."""
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
