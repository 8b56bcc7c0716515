"""Transfers between one particle and its 27 nodes as explicit vector code.

A node is four numbers in a row, so one LLVM vector; LLVM's own vectorisers do not find that shape
in scalar loops. Precision follows the array.
"""

# Numba intrinsics take arguments by position.
# ruff: noqa: PLR0917

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..particle import SIDE

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
        """One number in all lanes of a node or of a line."""
        single = self.builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, I32(0))
        return self._pick(single, [0] * kind.count)

    def pack(self, scalars: list[Any]) -> Any:
        """A node of these numbers; zero for those that are missing."""
        vector = ir.Constant(self.node, [0.0] * LANES)
        for lane, scalar in enumerate(scalars):
            vector = self.builder.insert_element(vector, scalar, I32(lane))
        return vector

    def repeated(self, node: Any) -> Any:
        """A line of three times the same node."""
        return self._pick(node, [*range(LANES)] * 3)

    def nodes(self, line: Any) -> list[Any]:
        """The three nodes of a line."""
        return [self._pick(line, list(range(k * LANES, (k + 1) * LANES))) for k in range(3)]

    def spread(self, scalars: list[Any]) -> Any:
        """A line of three numbers, each in all lanes of its node."""
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
        """Pointer to the line (i, j) after the node number ``first``."""
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

    tiles: flat array; wx, wy, wz: weights, three each; start: four numbers; qx, qy, qz: three.
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
