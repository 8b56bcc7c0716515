"""Between particles in rows and lanes in columns, as explicit vector code.

Rows are turned eight at a time by three rounds of shuffles; moved number by number they cost as
much as what is computed from them.
"""

# Numba intrinsics take arguments by position.

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import types
from numba.extending import intrinsic

EIGHT = 8
BATCH = 2 * EIGHT
"""Particles laid out side by side."""
I32, I64 = ir.IntType(32), ir.IntType(64)


class _ColumnEmitter:
    """Moves vectors between two arrays of the same precision: [N, width] and scratch space."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kinds: Any, values: Any) -> None:
        self.builder = builder
        self.scalar = context.get_value_type(kinds[0].dtype)
        self.rows, self.scratch = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(kinds, values, strict=True)
        )

    def load(self, data: Any, index: Any, count: int) -> Any:
        pointer, kind = self._at(data, index, count)
        return self.builder.load(pointer, typ=kind, align=4)

    def store(self, value: Any, data: Any, index: Any, count: int) -> None:
        self.builder.store(value, self._at(data, index, count)[0], align=4)

    def _at(self, data: Any, index: Any, count: int) -> tuple[Any, Any]:
        kind = ir.VectorType(self.scalar, count)
        place = self.builder.gep(data, [index], source_etype=self.scalar)
        return self.builder.bitcast(place, kind.as_pointer()), kind

    def row(self, first: Any, lane: int, width: int) -> Any:
        """Index of the row of particle ``first + lane``."""
        particle = self.builder.add(first, I64(lane))
        return self.builder.mul(particle, I64(width))

    def column(self, plane: Any, number: int, half: int) -> Any:
        """Index of eight lanes of the plane ``plane + number``."""
        index = self.builder.mul(self.builder.add(plane, I64(number)), I64(BATCH))
        return self.builder.add(index, I64(half))

    def columns(self, plane: Any, half: int, count: int) -> list[Any]:
        """Eight lanes of each of ``count`` planes."""
        places = [self.column(plane, number, half) for number in range(count)]
        return [self.load(self.scratch, place, EIGHT) for place in places]

    def pick(self, first: Any, second: Any, lanes: list[int]) -> Any:
        """A vector of lanes of two others, numbered through."""
        mask = ir.Constant(ir.VectorType(I32, len(lanes)), lanes)
        return self.builder.shuffle_vector(first, second, mask)

    def turned(self, vectors: list[Any]) -> list[Any]:
        """Eight vectors of eight: rows become columns."""
        for distance in (4, 2, 1):
            turned = list(vectors)
            for i in range(EIGHT):
                if not i & distance:
                    pair = vectors[i], vectors[i | distance]
                    low = [n + 8 - distance if n & distance else n for n in range(EIGHT)]
                    high = [n + 8 if n & distance else n + distance for n in range(EIGHT)]
                    turned[i] = self.pick(*pair, low)
                    turned[i | distance] = self.pick(*pair, high)
            vectors = turned
        return vectors


@intrinsic
def lay_out(typingctx, rows, first, scratch, plane):
    """Nine numbers of each of BATCH particles from ``first`` on to planes from ``plane`` on."""

    def generate(context, builder, signature, arguments):
        data, first, space, plane = arguments
        kinds = signature.args[0], signature.args[2]
        e = _ColumnEmitter(context, builder, kinds, (data, space))
        for half in range(0, BATCH, EIGHT):
            places = [e.row(first, half + lane, 9) for lane in range(EIGHT)]
            columns = e.turned([e.load(e.rows, place, EIGHT) for place in places])
            last = ir.Constant(ir.VectorType(e.scalar, EIGHT), ir.Undefined)
            for lane, place in enumerate(places):
                single = e.load(e.rows, builder.add(place, I64(EIGHT)), 1)
                number = builder.extract_element(single, I32(0))
                last = builder.insert_element(last, number, I32(lane))
            for number, column in enumerate([*columns, last]):
                e.store(column, e.scratch, e.column(plane, number, half), EIGHT)
        return context.get_dummy_value()

    return types.void(rows, types.int64, scratch, types.int64), generate


@intrinsic
def bring_back_nine(typingctx, scratch, plane, rows, first):
    """Nine planes from ``plane`` on back to the rows of BATCH particles from ``first`` on."""

    def generate(context, builder, signature, arguments):
        e, plane, first = _way_back(context, builder, signature, arguments)
        for half in range(0, BATCH, EIGHT):
            columns = e.columns(plane, half, EIGHT + 1)
            for lane, row in enumerate(e.turned(columns[:EIGHT])):
                place = e.row(first, half + lane, 9)
                e.store(row, e.rows, place, EIGHT)
                last = e.pick(columns[EIGHT], columns[EIGHT], [lane])
                e.store(last, e.rows, builder.add(place, I64(EIGHT)), 1)
        return context.get_dummy_value()

    return types.void(scratch, types.int64, rows, types.int64), generate


@intrinsic
def bring_back_six(typingctx, scratch, plane, rows, first):
    """Six planes from ``plane`` on back to the rows of BATCH particles from ``first`` on."""

    def generate(context, builder, signature, arguments):
        e, plane, first = _way_back(context, builder, signature, arguments)
        for half in range(0, BATCH, EIGHT):
            columns = e.columns(plane, half, 6)
            for lane, row in enumerate(e.turned([*columns, *columns[:2]])):
                place = e.row(first, half + lane, 6)
                e.store(e.pick(row, row, [0, 1, 2, 3]), e.rows, place, 4)
                e.store(e.pick(row, row, [4, 5]), e.rows, builder.add(place, I64(4)), 2)
        return context.get_dummy_value()

    return types.void(scratch, types.int64, rows, types.int64), generate


def _way_back(context: Any, builder: Any, signature: Any, arguments: Any) -> tuple[Any, Any, Any]:
    scratch, plane, rows, first = arguments
    kinds = signature.args[2], signature.args[0]
    return _ColumnEmitter(context, builder, kinds, (rows, scratch)), plane, first
