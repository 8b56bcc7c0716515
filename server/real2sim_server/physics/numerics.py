"""Scalar and tuple functions shared by the kernels of all backends, and their decorators."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable

from .._numba import func, kernel

FASTMATH = {"contract", "nsz", "arcp"}
"""Allows fused multiply-add and reciprocals; NaN and infinity are preserved."""

device_function: Any = register_jitable(fastmath=FASTMATH, error_model="numpy")
"""Decorator of functions that kernels of every backend and Python may call."""

F32 = np.float32
ZERO, HALF, ONE, TWO, THREE, FOUR = (F32(v) for v in (0, 0.5, 1, 2, 3, 4))
THREE_QUARTERS, THREE_HALVES = F32(0.75), F32(1.5)
TINY = F32(1e-30)


def square_root(x: Any) -> Any:
    """Square root of a non-negative number.

    Compiles to a processor instruction, so loops over lanes can be vectorised; ``math.sqrt`` calls
    the C library to handle negative numbers.
    """
    return math.sqrt(x)


@intrinsic
def _root(typingctx, x):
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(signature.args[0])
        name = f"llvm.sqrt.f{32 if kind == ir.FloatType() else 64}"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind]), name
        )
        return builder.call(function, arguments)

    return (x(x), generate) if isinstance(x, types.Float) else None


@overload(square_root)
def _square_root(x):
    def root(x):
        return _root(x)

    return root


# 3x3 matrices as tuples of nine numbers, row by row; symmetric ones as xx, yy, zz, xy, xz, yz.

POLAR_STEPS = 16
JACOBI_SWEEPS = 8


@device_function
def det(a: Any) -> Any:
    """Determinant."""
    return (
        a[0] * (a[4] * a[8] - a[5] * a[7])
        - a[1] * (a[3] * a[8] - a[5] * a[6])
        + a[2] * (a[3] * a[7] - a[4] * a[6])
    )


@device_function
def cofactors(a: Any) -> Any:
    """Cofactor matrix: det(a) times the transposed inverse."""
    return (
        a[4] * a[8] - a[5] * a[7],
        a[5] * a[6] - a[3] * a[8],
        a[3] * a[7] - a[4] * a[6],
        a[2] * a[7] - a[1] * a[8],
        a[0] * a[8] - a[2] * a[6],
        a[1] * a[6] - a[0] * a[7],
        a[1] * a[5] - a[2] * a[4],
        a[2] * a[3] - a[0] * a[5],
        a[0] * a[4] - a[1] * a[3],
    )


@device_function
def multiply(a: Any, b: Any) -> Any:
    """a b."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@device_function
def symmetric_times(s: Any, a: Any) -> Any:
    """s a for a symmetric s."""
    return multiply((s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]), a)


@device_function
def times_transposed(a: Any, b: Any) -> Any:
    """a b^T if it is symmetric."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[3] * b[3] + a[4] * b[4] + a[5] * b[5],
        a[6] * b[6] + a[7] * b[7] + a[8] * b[8],
        a[0] * b[3] + a[1] * b[4] + a[2] * b[5],
        a[0] * b[6] + a[1] * b[7] + a[2] * b[8],
        a[3] * b[6] + a[4] * b[7] + a[5] * b[8],
    )


@device_function
def least_minor(s: Any, bound: Any, sign: Any) -> Any:
    """Least leading principal minor of sign (s - bound I) for a symmetric s.

    Positive if all eigenvalues of that matrix are positive (Sylvester).
    """
    xx, yy, zz = sign * (s[0] - bound), sign * (s[1] - bound), sign * (s[2] - bound)
    xy, xz, yz = sign * s[3], sign * s[4], sign * s[5]
    second = xx * yy - xy * xy
    third = second * zz - xx * yz * yz - yy * xz * xz + (xy + xy) * xz * yz
    return min(xx, second, third)


@device_function
def rotation_step(r: Any, determinant: Any) -> Any:
    """One Newton step towards the rotation of a matrix, and the size of the change.

    r' = (r + r^-T) / 2 (Higham 1986).
    """
    half_inverse = HALF / determinant
    c = cofactors(r)
    n = (
        HALF * r[0] + half_inverse * c[0],
        HALF * r[1] + half_inverse * c[1],
        HALF * r[2] + half_inverse * c[2],
        HALF * r[3] + half_inverse * c[3],
        HALF * r[4] + half_inverse * c[4],
        HALF * r[5] + half_inverse * c[5],
        HALF * r[6] + half_inverse * c[6],
        HALF * r[7] + half_inverse * c[7],
        HALF * r[8] + half_inverse * c[8],
    )
    change = (
        abs(n[0] - r[0]) + abs(n[4] - r[4]) + abs(n[8] - r[8])
        + abs(n[1] - r[1]) + abs(n[2] - r[2]) + abs(n[5] - r[5])
    )  # fmt: skip
    return n, change


@device_function
def polar_rotation(a: Any, determinant: Any) -> Any:
    """Rotation R of the polar decomposition a = R S, by Newton's iteration.

    Requires det(a) > 0: the caller handles inverted particles.
    """
    r = a
    d = determinant
    for _ in range(POLAR_STEPS):
        r, change = rotation_step(r, d)
        d = det(r)
        # The error squares with each step, so the next one would be below the rounding error.
        if ONE + change * change == ONE:
            break
    return r


@device_function
def jacobi_angle(pp: Any, qq: Any, pq: Any) -> Any:
    """Tangent, cosine and sine of the rotation that makes the element ``pq`` vanish."""
    # Branch-free, so that it can be vectorised.
    small = abs(pq) < TINY
    theta = HALF * (qq - pp) / (ONE + ZERO * pq if small else pq)
    t = ONE / (abs(theta) + square_root(theta * theta + ONE))
    t = -t if theta < ZERO else t
    t = ZERO * t if small else t
    c = ONE / square_root(t * t + ONE)
    return t, c, t * c


@device_function
def jacobi_sweep(s: Any, v: Any) -> Any:
    """A symmetric matrix after one Jacobi sweep, and ``v`` (9) rotated by the same angles."""
    xx, yy, zz, xy, xz, yz = s
    v0, v1, v2, v3, v4, v5, v6, v7, v8 = v
    zero = ZERO * xx
    t, c, n = jacobi_angle(xx, yy, xy)
    xx, yy, xy = xx - t * xy, yy + t * xy, zero
    xz, yz = c * xz - n * yz, n * xz + c * yz
    v0, v1 = c * v0 - n * v1, n * v0 + c * v1
    v3, v4 = c * v3 - n * v4, n * v3 + c * v4
    v6, v7 = c * v6 - n * v7, n * v6 + c * v7
    t, c, n = jacobi_angle(xx, zz, xz)
    xx, zz, xz = xx - t * xz, zz + t * xz, zero
    xy, yz = c * xy - n * yz, n * xy + c * yz
    v0, v2 = c * v0 - n * v2, n * v0 + c * v2
    v3, v5 = c * v3 - n * v5, n * v3 + c * v5
    v6, v8 = c * v6 - n * v8, n * v6 + c * v8
    t, c, n = jacobi_angle(yy, zz, yz)
    yy, zz, yz = yy - t * yz, zz + t * yz, zero
    xy, xz = c * xy - n * xz, n * xy + c * xz
    v1, v2 = c * v1 - n * v2, n * v1 + c * v2
    v4, v5 = c * v4 - n * v5, n * v4 + c * v5
    v7, v8 = c * v7 - n * v8, n * v7 + c * v8
    return (xx, yy, zz, xy, xz, yz), (v0, v1, v2, v3, v4, v5, v6, v7, v8)


@device_function
def is_diagonal(s: Any) -> Any:
    """Whether the off-diagonal elements of a symmetric matrix are below the rounding error."""
    scale = abs(s[0]) + abs(s[1]) + abs(s[2])
    return scale + (abs(s[3]) + abs(s[4]) + abs(s[5])) == scale


@device_function
def eigen_symmetric(s: Any) -> Any:
    """Eigenvalues (3) and eigenvectors (9, in columns) of a symmetric matrix, by cyclic Jacobi.

    Golub and Van Loan, Matrix Computations, 8.5. Not sorted.
    """
    one, zero = ONE + ZERO * s[0], ZERO * s[0]
    v = (one, zero, zero, zero, one, zero, zero, zero, one)
    for _ in range(JACOBI_SWEEPS):
        if is_diagonal(s):
            break
        s, v = jacobi_sweep(s, v)
    return (s[0], s[1], s[2]), v


@device_function
def recompose(values: Any, vectors: Any) -> Any:
    """vectors diag(values) vectors^T, symmetric."""
    a, b, c = values
    v = vectors
    return (
        a * v[0] * v[0] + b * v[1] * v[1] + c * v[2] * v[2],
        a * v[3] * v[3] + b * v[4] * v[4] + c * v[5] * v[5],
        a * v[6] * v[6] + b * v[7] * v[7] + c * v[8] * v[8],
        a * v[0] * v[3] + b * v[1] * v[4] + c * v[2] * v[5],
        a * v[0] * v[6] + b * v[1] * v[7] + c * v[2] * v[8],
        a * v[3] * v[6] + b * v[4] * v[7] + c * v[5] * v[8],
    )


# Quadratic B-splines.


@device_function
def spline_weights(f: Any) -> Any:
    """Weights of the three nodes at offsets 0, 1, 2 for a particle at ``f`` in [0.5, 1.5).

    f is the distance to the first node [cells]. Jiang et al. 2016, MPM course, eq. 123.
    """
    left = THREE_HALVES - f
    right = f - HALF
    middle = right - HALF
    return HALF * left * left, THREE_QUARTERS - middle * middle, HALF * right * right


# Decorators of the CPU's kernels.

inner: Any = functools.partial(func, fastmath=FASTMATH)
"""Compiles functions that only entry points call; cached as part of those."""

entry: Any = functools.partial(kernel, nogil=True, fastmath=FASTMATH)
"""Compiles functions that Python calls: cached on disk, without the interpreter's lock."""
