"""Eight numbers side by side in a kernel under construction, so that formulas read like formulas.

LLVM's loop vectoriser needs checks for overlapping arrays that cost more than a row of pixels, so
the eight lanes are spelled out as LLVM vectors. They run as one AVX register, as two SSE or NEON
registers where those are all there is, and give the same bits in each case as long as the machine
has fused multiply-add.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

LANES = 8
FLOAT, DOUBLE = ir.FloatType(), ir.DoubleType()
I32, I64 = ir.IntType(32), ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, LANES)
DOUBLES = ir.VectorType(DOUBLE, LANES)
INTEGERS = ir.VectorType(I32, LANES)
LONGS = ir.VectorType(I64, LANES)
MANTISSA_BITS = 23
ROOT_HALF = int(np.float32(math.sqrt(0.5)).view(np.int32))
Real = float | np.floating[Any]
SUFFIXES = {FLOAT: f"v{LANES}f32", DOUBLE: f"v{LANES}f64"}


class Lanes:
    """Eight float32 or float64 numbers."""

    def __init__(self, builder: ir.IRBuilder, value: Any) -> None:
        self.builder = builder
        self.value = value

    def _lift(self, other: Lanes | Real) -> Any:
        if isinstance(other, Lanes):
            return other.value
        kind = self.value.type
        number = float(np.float32(other)) if kind.element is FLOAT else float(other)
        return ir.Constant(kind, [number] * LANES)

    def __add__(self, other: Lanes | Real) -> Lanes:
        return Lanes(self.builder, self.builder.fadd(self.value, self._lift(other)))

    def __sub__(self, other: Lanes | Real) -> Lanes:
        return Lanes(self.builder, self.builder.fsub(self.value, self._lift(other)))

    def __mul__(self, other: Lanes | Real) -> Lanes:
        return Lanes(self.builder, self.builder.fmul(self.value, self._lift(other)))

    def __truediv__(self, other: Lanes | Real) -> Lanes:
        return Lanes(self.builder, self.builder.fdiv(self.value, self._lift(other)))

    def __neg__(self) -> Lanes:
        return Lanes(self.builder, self.builder.fneg(self.value))

    def fused(self, factor: Lanes | Real, addend: Lanes | Real) -> Lanes:
        """self * factor + addend, rounded once where the machine can."""
        return self._call("llvm.fmuladd", self._lift(factor), self._lift(addend))

    def magnitude(self) -> Lanes:
        """Absolute value."""
        return self._call("llvm.fabs")

    def root(self) -> Lanes:
        """Square root."""
        return self._call("llvm.sqrt")

    def reciprocal(self) -> Lanes:
        """One over self."""
        return Lanes(self.builder, self.builder.fdiv(self._lift(1.0), self.value))

    def floor(self) -> Lanes:
        """Next whole number below."""
        return self._call("llvm.floor")

    def ceiling(self) -> Lanes:
        """Next whole number above."""
        return self._call("llvm.ceil")

    def at_least(self, limit: Lanes | Real) -> Lanes:
        """The larger of self and ``limit``; ``limit`` for NaN."""
        return self.where(self.compare(">", limit), limit)

    def at_most(self, limit: Lanes | Real) -> Lanes:
        """The smaller of self and ``limit``; ``limit`` for NaN."""
        return self.where(self.compare("<", limit), limit)

    def negative_where(self, mask: Any) -> Lanes:
        """Self with the sign bit set where ``mask`` holds."""
        sign = ir.Constant(INTEGERS, [-(2**31)] * LANES)
        chosen = self.builder.and_(self.builder.sext(mask, INTEGERS), sign)
        merged = self.builder.or_(self.builder.bitcast(self.value, INTEGERS), chosen)
        return Lanes(self.builder, self.builder.bitcast(merged, VECTOR))

    def _call(self, intrinsic_name: str, *others: Any) -> Lanes:
        kind = self.value.type
        function = cgutils.get_or_insert_function(
            self.builder.module,
            ir.FunctionType(kind, [kind] * (1 + len(others))),
            f"{intrinsic_name}.{SUFFIXES[kind.element]}",
        )
        return Lanes(self.builder, self.builder.call(function, [self.value, *others]))

    def compare(self, operator: str, other: Lanes | Real) -> Any:
        """Mask of eight bits; false for NaN."""
        return self.builder.fcmp_ordered(operator, self.value, self._lift(other))

    def where(self, mask: Any, other: Lanes | Real) -> Lanes:
        """Self where ``mask`` holds, else ``other``."""
        return Lanes(self.builder, self.builder.select(mask, self.value, self._lift(other)))

    def doubles(self) -> Lanes:
        """As float64."""
        return Lanes(self.builder, self.builder.fpext(self.value, DOUBLES))

    def floats(self) -> Lanes:
        """Rounded to float32."""
        return Lanes(self.builder, self.builder.fptrunc(self.value, VECTOR))

    def integers(self) -> Integers:
        """As int32, towards zero; any number for what does not fit."""
        return Integers(self.builder, self.builder.fptosi(self.value, INTEGERS))

    def bits(self) -> Integers:
        """The bits of float32 numbers as int32."""
        return Integers(self.builder, self.builder.bitcast(self.value, INTEGERS))


class Integers:
    """Eight int32 or int64 numbers."""

    def __init__(self, builder: ir.IRBuilder, value: Any) -> None:
        self.builder = builder
        self.value = value

    @classmethod
    def filled(cls, builder: ir.IRBuilder, number: int) -> Integers:
        """One int32 in all lanes."""
        return cls(builder, ir.Constant(INTEGERS, [number] * LANES))

    def _lift(self, other: Integers | int) -> Any:
        if isinstance(other, Integers):
            return other.value
        return ir.Constant(self.value.type, [other] * LANES)

    def __add__(self, other: Integers | int) -> Integers:
        return Integers(self.builder, self.builder.add(self.value, self._lift(other)))

    def __sub__(self, other: Integers | int) -> Integers:
        return Integers(self.builder, self.builder.sub(self.value, self._lift(other)))

    def __or__(self, other: Integers | int) -> Integers:
        return Integers(self.builder, self.builder.or_(self.value, self._lift(other)))

    def __lshift__(self, other: Integers | int) -> Integers:
        return Integers(self.builder, self.builder.shl(self.value, self._lift(other)))

    def __rshift__(self, other: Integers | int) -> Integers:
        return Integers(self.builder, self.builder.ashr(self.value, self._lift(other)))

    def compare(self, operator: str, other: Integers | int) -> Any:
        """Mask of eight bits."""
        return self.builder.icmp_signed(operator, self.value, self._lift(other))

    def where(self, mask: Any, other: Integers | int) -> Integers:
        """Self where ``mask`` holds, else ``other``."""
        return Integers(self.builder, self.builder.select(mask, self.value, self._lift(other)))

    def floats(self) -> Lanes:
        """As float32."""
        return Lanes(self.builder, self.builder.sitofp(self.value, VECTOR))

    def as_bits(self) -> Lanes:
        """The float32 numbers that have these bits."""
        return Lanes(self.builder, self.builder.bitcast(self.value, VECTOR))

    def longs(self) -> Integers:
        """As int64; for numbers that are not negative."""
        return Integers(self.builder, self.builder.zext(self.value, LONGS))


class Planes:
    """Groups of float32 vectors in memory, ``planes`` in a row; this is group number ``group``."""

    def __init__(self, builder: ir.IRBuilder, data: Any, group: Any, *, planes: int) -> None:
        self.builder = builder
        first = builder.mul(group, ir.Constant(group.type, planes * LANES))
        self.pointer = builder.gep(data, [first], source_etype=FLOAT)

    def _plane(self, index: int) -> Any:
        plane = self.builder.gep(self.pointer, [I64(index * LANES)], source_etype=FLOAT)
        return self.builder.bitcast(plane, VECTOR.as_pointer())

    def load(self, index: int) -> Lanes:
        """Vector of a plane."""
        value = self.builder.load(self._plane(index), typ=VECTOR, align=4)
        return Lanes(self.builder, value)

    def store(self, index: int, lanes: Lanes) -> None:
        """Write a plane."""
        self.builder.store(lanes.value, self._plane(index), align=4)


def logarithm(number: Lanes) -> Lanes:
    """Natural logarithm of positive, normal float32 numbers, to 2e-7 of it or of 1."""
    bits = number.bits()
    exponent = (bits - ROOT_HALF) >> MANTISSA_BITS
    mantissa = (bits - (exponent << MANTISSA_BITS)).as_bits()
    # ln m = 2 artanh((m - 1) / (m + 1)), with m from sqrt(1/2) to sqrt(2).
    ratio = (mantissa - 1.0) / (mantissa + 1.0)
    square = ratio * ratio
    series = square.fused(square.fused(square * (2 / 9) + 2 / 7, 2 / 5), 2 / 3)
    return exponent.floats().fused(math.log(2.0), (series * square).fused(ratio, ratio * 2.0))


def splat(builder: ir.IRBuilder, scalar: Any) -> Lanes:
    """One scalar in all lanes."""
    undefined = ir.Constant(ir.VectorType(scalar.type, LANES), ir.Undefined)
    single = builder.insert_element(undefined, scalar, I32(0))
    mask = ir.Constant(INTEGERS, [0] * LANES)
    return Lanes(builder, builder.shuffle_vector(single, undefined, mask))


def lane_numbers(builder: ir.IRBuilder) -> Lanes:
    """0 to 7."""
    return Lanes(builder, ir.Constant(VECTOR, [float(i) for i in range(LANES)]))


def mask_bits(builder: ir.IRBuilder, mask: Any) -> Any:
    """A mask as the low eight bits of an int64."""
    return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), I64)


def mask_of(builder: ir.IRBuilder, bits: Any) -> Any:
    """The mask whose bits an int64 holds."""
    vector = ir.VectorType(ir.IntType(1), LANES)
    return builder.bitcast(builder.trunc(bits, ir.IntType(LANES)), vector)
