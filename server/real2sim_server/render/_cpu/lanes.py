"""Vectors of eight numbers for building kernels, with operators for readable formulas.

LLVM's loop vectoriser checks arrays for overlap, which costs more than a row of pixels, so kernels
use explicit LLVM vectors. They compile to one AVX register, or two SSE or NEON registers, and are
bitwise equal on all machines with fused multiply-add. The module also has small vectors and
matrices of lanes, and the options of the renderer's kernels.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..._numba import func
from ..._numba import kernel as cached_kernel

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
        """self * factor + addend, rounded once if the machine has fused multiply-add."""
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
        """Largest integer not above self."""
        return self._call("llvm.floor")

    def ceiling(self) -> Lanes:
        """Smallest integer not below self."""
        return self._call("llvm.ceil")

    def at_least(self, limit: Lanes | Real) -> Lanes:
        """The larger of self and ``limit``; ``limit`` for NaN."""
        return self.where(self.compare(">", limit), limit)

    def at_most(self, limit: Lanes | Real) -> Lanes:
        """The smaller of self and ``limit``; ``limit`` for NaN."""
        return self.where(self.compare("<", limit), limit)

    def negative_where(self, mask: Any) -> Lanes:
        """Self with the sign bit set where ``mask`` is true."""
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
        """As int32, rounded towards zero; undefined if out of range."""
        return Integers(self.builder, self.builder.fptosi(self.value, INTEGERS))

    def bits(self) -> Integers:
        """Bit patterns of float32 numbers as int32."""
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
        """Float32 numbers with these bit patterns."""
        return Lanes(self.builder, self.builder.bitcast(self.value, VECTOR))

    def longs(self) -> Integers:
        """As int64; numbers must not be negative."""
        return Integers(self.builder, self.builder.zext(self.value, LONGS))


class Planes:
    """Group ``group`` of float32 vectors in memory; each group has ``planes`` vectors."""

    def __init__(self, builder: ir.IRBuilder, data: Any, group: Any, *, planes: int) -> None:
        self.builder = builder
        first = builder.mul(group, ir.Constant(group.type, planes * LANES))
        self.pointer = builder.gep(data, [first], source_etype=FLOAT)

    def _plane(self, index: int) -> Any:
        plane = self.builder.gep(self.pointer, [I64(index * LANES)], source_etype=FLOAT)
        return self.builder.bitcast(plane, VECTOR.as_pointer())

    def load(self, index: int) -> Lanes:
        """Load the vector of a plane."""
        value = self.builder.load(self._plane(index), typ=VECTOR, align=4)
        return Lanes(self.builder, value)

    def store(self, index: int, lanes: Lanes) -> None:
        """Store the vector of a plane."""
        self.builder.store(lanes.value, self._plane(index), align=4)


def logarithm(number: Lanes) -> Lanes:
    """Natural logarithm of positive, normal float32 numbers; error 2e-7, relative or absolute."""
    bits = number.bits()
    exponent = (bits - ROOT_HALF) >> MANTISSA_BITS
    mantissa = (bits - (exponent << MANTISSA_BITS)).as_bits()
    # ln m = 2 artanh((m - 1) / (m + 1)), with m from sqrt(1/2) to sqrt(2).
    ratio = (mantissa - 1.0) / (mantissa + 1.0)
    square = ratio * ratio
    series = square.fused(square.fused(square * (2 / 9) + 2 / 7, 2 / 5), 2 / 3)
    return exponent.floats().fused(math.log(2.0), (series * square).fused(ratio, ratio * 2.0))


def splat(builder: ir.IRBuilder, scalar: Any) -> Lanes:
    """Broadcast a scalar to all lanes."""
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
    """The mask from the low eight bits of an int64."""
    vector = ir.VectorType(ir.IntType(1), LANES)
    return builder.bitcast(builder.trunc(bits, ir.IntType(LANES)), vector)


# Kernel options; ``_numba`` caches kernels on disk.

kernel: Any = functools.partial(cached_kernel, nogil=True)
"""Options for entry points, which release the GIL."""

inlined: Any = functools.partial(func, forceinline=True, _nrt=False)
"""Options for functions called once per Gaussian, which must not allocate.

Without ``_nrt=False``, Numba counts references of each array that is passed or sliced with atomic
instructions, which take several times as long as the work itself.
"""


# Vectors and small matrices of lanes

Vector = list[Lanes]


def dot(a: Sequence[Lanes], b: Sequence[Lanes], addend: Lanes | None = None) -> Lanes:
    """Scalar product of three numbers each, plus ``addend``."""
    last = a[2] * b[2] if addend is None else a[2].fused(b[2], addend)
    return a[0].fused(b[0], a[1].fused(b[1], last))


def dot_all(a: Sequence[Lanes], b: Sequence[Lanes]) -> Lanes:
    """Scalar product of any number of components, summed first to last."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = left.fused(right, total)
    return total


def cross(a: Sequence[Lanes], b: Sequence[Lanes]) -> Vector:
    """Vector product."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def turn_columns(quaternion: Sequence[Lanes]) -> list[Vector]:
    """Columns of the rotations of quaternions (w, x, y, z) of any nonzero length."""
    w, x, y, z = quaternion
    norm = w.fused(w, x.fused(x, y.fused(y, z * z))).reciprocal() * 2.0
    nx, ny, nz = x * norm, y * norm, z * norm
    xx, yy, zz = x * nx, y * ny, z * nz
    xy, xz, yz = x * ny, x * nz, y * nz
    wx, wy, wz = w * nx, w * ny, w * nz
    return [
        [-(yy + zz) + 1.0, xy + wz, xz - wy],
        [xy - wz, -(xx + zz) + 1.0, yz + wx],
        [xz + wy, yz - wx, -(xx + yy) + 1.0],
    ]


def cholesky(upper: Sequence[Lanes], least: float) -> Vector:
    """Cholesky factors (xx, yx, zx, yy, zy, zz) float32 of covariances (xx, xy, xz, yy, yz, zz)
    float64, with pivots of at least ``least``."""
    xx, xy, xz, yy, yz, zz = upper
    a = xx.at_least(least).root()
    b, c = xy / a, xz / a
    d = (yy - b * b).at_least(least).root()
    e = (yz - b * c) / d
    f = (zz - c * c - e * e).at_least(least).root()
    return [number.floats() for number in (a, b, c, d, e, f)]


def whitening(rows: Sequence[Vector], least: Lanes | float) -> Vector:
    """Inverses of the lower triangles L with L L^T = rows rows^T, by rows, for three rows of any
    length.

    Uses Gram-Schmidt, which stays precise for flat Gaussians where the covariance cancels. Squared
    lengths are clamped to at least ``least``.
    """
    first, second, third = rows
    l11 = dot_all(first, first).at_least(least).root()
    w11 = l11.reciprocal()
    q1 = [v * w11 for v in first]
    l21, l31 = dot_all(second, q1), dot_all(third, q1)
    second = [v - l21 * q for v, q in zip(second, q1, strict=True)]
    third = [v - l31 * q for v, q in zip(third, q1, strict=True)]
    w22 = dot_all(second, second).at_least(least).root().reciprocal()
    q2 = [v * w22 for v in second]
    l32 = dot_all(third, q2)
    third = [v - l32 * q for v, q in zip(third, q2, strict=True)]
    w33 = dot_all(third, third).at_least(least).root().reciprocal()
    w21 = -(l21 * w11 * w22)
    w32 = -(l32 * w22 * w33)
    w31 = -((l31 * w11 + l32 * w21) * w33)
    return [w11, w21, w22, w31, w32, w33]


def whitened(w: Sequence[Lanes], v: Sequence[Lanes]) -> Vector:
    """Product of a lower triangle, by rows, and a vector."""
    return [
        w[0] * v[0],
        w[1].fused(v[0], w[2] * v[1]),
        w[3].fused(v[0], w[4].fused(v[1], w[5] * v[2])),
    ]


@intrinsic
def lowest_bit(typingctx, mask):  # type: ignore[no-untyped-def]
    """Position of the lowest set bit; ``mask`` int64, nonzero."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate


@intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Prefetch the cache line of ``array[index]`` (first axis)."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = cgutils.unpack_tuple(builder, values.strides)[0]
        start = builder.bitcast(values.data, ir.IntType(8).as_pointer())
        offset = builder.mul(arguments[1], stride)
        pointer = builder.gep(start, [offset], source_etype=ir.IntType(8))
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
