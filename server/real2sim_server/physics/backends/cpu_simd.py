"""Transfers between one particle and its 27 nodes as explicit vector code.

A node is four numbers in a row, so one LLVM vector; LLVM's own vectorisers do not find that shape
in scalar loops. Precision follows the array.
"""

# Numba intrinsics take arguments by position.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .particle import SIDE

LANES = 4


class _Emitter:
    """Builds vector arithmetic in the array's precision."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kind: Any, array: Any) -> None:
        self.builder = builder
        self.scalar = context.get_value_type(kind.dtype)
        self.vector = ir.VectorType(self.scalar, LANES)
        self.data = context.make_array(kind)(context, builder, array).data
        self.suffix = f"v{LANES}f{'32' if kind.dtype == types.float32 else '64'}"

    def number(self, value: float) -> Any:
        return ir.Constant(self.vector, [value] * LANES)

    def splat(self, scalar: Any) -> Any:
        undefined = ir.Constant(self.vector, ir.Undefined)
        single = self.builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(single, undefined, mask)

    def pack(self, scalars: list[Any]) -> Any:
        vector = ir.Constant(self.vector, [0.0] * LANES)
        for lane, scalar in enumerate(scalars):
            vector = self.builder.insert_element(vector, scalar, ir.Constant(ir.IntType(32), lane))
        return vector

    def fused(self, a: Any, b: Any, c: Any) -> Any:
        """a * b + c."""
        kind = ir.FunctionType(self.vector, [self.vector] * 3)
        name = f"llvm.fmuladd.{self.suffix}"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, [a, b, c])

    def node(self, first: Any, i: int, j: int, k: int) -> Any:
        """Pointer to the node (i, j, k) after the node number ``first``."""
        index = self.builder.add(first, ir.Constant(first.type, (i * SIDE + j) * SIDE + k))
        index = self.builder.mul(index, ir.Constant(first.type, LANES))
        pointer = self.builder.gep(self.data, [index], source_etype=self.scalar)
        return self.builder.bitcast(pointer, self.vector.as_pointer())

    def load(self, pointer: Any) -> Any:
        return self.builder.load(pointer, typ=self.vector, align=4)

    def store(self, value: Any, pointer: Any) -> None:
        self.builder.store(value, pointer, align=4)


def _unpack(builder: ir.IRBuilder, value: Any, count: int) -> list[Any]:
    return [builder.extract_value(value, i) for i in range(count)]


@intrinsic
def scatter(typingctx, tiles, first, wx, wy, wz, start, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Add w (start + i qx + j qy + k qz) to the nodes at offsets (i, j, k) from ``first``.

    tiles: flat array; wx, wy, wz: weights, three each; start: four numbers; qx, qy, qz: three.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        e = _Emitter(context, builder, signature.args[0], arguments[0])
        node = arguments[1]
        weights = [_unpack(builder, a, 3) for a in arguments[2:5]]
        value = e.pack(_unpack(builder, arguments[5], 4))
        steps = [e.pack(_unpack(builder, a, 3)) for a in arguments[6:9]]
        wz_vectors = [e.splat(w) for w in weights[2]]
        for i in range(3):
            row = value
            for j in range(3):
                w = e.splat(builder.fmul(weights[0][i], weights[1][j]))
                at = row
                for k in range(3):
                    pointer = e.node(node, i, j, k)
                    weight = builder.fmul(w, wz_vectors[k])
                    e.store(e.fused(weight, at, e.load(pointer)), pointer)
                    at = builder.fadd(at, steps[2])
                row = builder.fadd(row, steps[1])
            value = builder.fadd(value, steps[0])
        return context.get_dummy_value()

    number = tiles.dtype
    three, four = types.UniTuple(number, 3), types.UniTuple(number, 4)
    kinds = (tiles, types.int64, three, three, three, four, three, three, three)
    return types.void(*kinds), generate


@intrinsic
def gather(typingctx, tiles, first, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Twelve numbers: sum w v, and sum w v times the offset i, j and k of each node."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        e = _Emitter(context, builder, signature.args[0], arguments[0])
        weights = [[e.splat(w) for w in _unpack(builder, a, 3)] for a in arguments[2:5]]
        twice = [builder.fadd(w[2], w[2]) for w in weights]
        rows = []
        for i in range(3):
            lines = []
            for j in range(3):
                v = [e.load(e.node(arguments[1], i, j, k)) for k in range(3)]
                lines.append((_total(e, weights[2], v), _lever(e, weights[2], twice[2], v)))
            sums = [line[0] for line in lines]
            rows.append(
                (
                    _total(e, weights[1], sums),
                    _lever(e, weights[1], twice[1], sums),
                    _total(e, weights[1], [line[1] for line in lines]),
                )
            )
        sums = [row[0] for row in rows]
        vectors = (
            _total(e, weights[0], sums),
            _lever(e, weights[0], twice[0], sums),
            _total(e, weights[0], [row[1] for row in rows]),
            _total(e, weights[0], [row[2] for row in rows]),
        )
        lane = ir.IntType(32)
        values = [
            builder.extract_element(v, ir.Constant(lane, c)) for v in vectors for c in (0, 1, 2)
        ]
        return context.make_tuple(builder, signature.return_type, values)

    number = tiles.dtype
    three = types.UniTuple(number, 3)
    return types.UniTuple(number, 12)(tiles, types.int64, three, three, three), generate


def _total(e: _Emitter, w: list[Any], v: list[Any]) -> Any:
    return e.fused(w[2], v[2], e.fused(w[1], v[1], e.builder.fmul(w[0], v[0])))


def _lever(e: _Emitter, w: list[Any], twice: Any, v: list[Any]) -> Any:
    return e.fused(twice, v[2], e.builder.fmul(w[1], v[1]))
