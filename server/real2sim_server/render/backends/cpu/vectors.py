"""Vectors and small matrices of eight Gaussians at a time in kernels under construction."""

from __future__ import annotations

from collections.abc import Sequence

from .lanes import Lanes

Vector = list[Lanes]


def dot(a: Sequence[Lanes], b: Sequence[Lanes], addend: Lanes | None = None) -> Lanes:
    """Scalar product of three numbers each, plus ``addend``."""
    last = a[2] * b[2] if addend is None else a[2].fused(b[2], addend)
    return a[0].fused(b[0], a[1].fused(b[1], last))


def dot_all(a: Sequence[Lanes], b: Sequence[Lanes]) -> Lanes:
    """Scalar product of any count of numbers, first to last."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = left.fused(right, total)
    return total


def cross(a: Sequence[Lanes], b: Sequence[Lanes]) -> Vector:
    """Vector product."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def turn_columns(quaternion: Sequence[Lanes]) -> list[Vector]:
    """Columns of the turns of quaternions w, x, y, z of any length but 0."""
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
    """Roots (xx, yx, zx, yy, zy, zz), float32, of covariances (xx, xy, xz, yy, yz, zz), float64,
    with pivots of at least ``least``."""
    xx, xy, xz, yy, yz, zz = upper
    a = xx.at_least(least).root()
    b, c = xy / a, xz / a
    d = (yy - b * b).at_least(least).root()
    e = (yz - b * c) / d
    f = (zz - c * c - e * e).at_least(least).root()
    return [number.floats() for number in (a, b, c, d, e, f)]


def whitening(rows: Sequence[Vector], least: Lanes | float) -> Vector:
    """Inverses of the lower triangles L with L L^T = rows rows^T, by rows, for three rows of any
    length; by Gram and Schmidt, which keeps the digits of flat Gaussians that a covariance loses.

    Squares of lengths are at least ``least``.
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
    """A lower triangle by rows times a vector."""
    return [
        w[0] * v[0],
        w[1].fused(v[0], w[2] * v[1]),
        w[3].fused(v[0], w[4].fused(v[1], w[5] * v[2])),
    ]
