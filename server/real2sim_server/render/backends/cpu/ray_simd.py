"""The innermost step of blending by rays as explicit vector code: one record over eight pixels.

State of eight pixels is RAY_PLANES vectors in a row: those of the pinhole, then the ray x, y, z and
its time, -0.5 to 0.5 over the read-out.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from .lanes import FLOAT, I64, Lanes, Planes, splat
from .ray_records import DRIFT, FRAME, ORIGIN, SQUARE, WHITENING
from .records import (
    BLUE,
    DEPTH,
    EXPONENT_LIMIT,
    EXPONENT_UNIT,
    GREEN,
    INSTANCE,
    LEVEL,
    RED,
)
from .simd import PLANES, blend_exponent

RAY = PLANES
TIME = PLANES + 3
RAY_PLANES = PLANES + 4
VALUES = (RED, GREEN, BLUE, DEPTH, INSTANCE)


def _still_exponent(state: Planes, record: _Record) -> Lanes:
    """Emit the exponents of eight rays from one place; NaN or beyond the limit behind it.

    In the space where the Gaussian is a unit sphere and its centre at the distance D on the third
    axis, a ray along (a, b, c) passes it at D^2 (a^2 + b^2) / (a^2 + b^2 + c^2), squared.
    """
    x, y, z = (state.load(RAY + k) for k in range(3))
    rows = [[record.number(FRAME + 3 * row + k) for k in range(3)] for row in range(3)]
    a, b, c = (x.fused(row[0], y.fused(row[1], z * row[2])) for row in rows)
    beside = a.fused(a, b * b)
    share = beside / c.fused(c, beside)
    exponent = share.fused(record.number(SQUARE), record.number(LEVEL))
    return exponent.where(c.compare(">", 0.0), 2 * EXPONENT_LIMIT)


def _moving_exponent(state: Planes, record: _Record) -> Lanes:
    """Emit the exponents of eight rays from many places.

    In the space where the Gaussian is a unit sphere about 0, a ray from o along d passes it at the
    distance |o x d| / |d|. The cross product keeps its digits where |o|^2 - (o d)^2 / |d|^2 has
    none left.
    """
    x, y, z, time = (state.load(RAY + k) for k in range(4))
    w = [record.number(WHITENING + k) for k in range(6)]
    dx = x * w[0]
    dy = x.fused(w[1], y * w[2])
    dz = x.fused(w[3], y.fused(w[4], z * w[5]))
    ox, oy, oz = (time.fused(record.number(DRIFT + k), record.number(ORIGIN + k)) for k in range(3))
    cx = oy.fused(dz, -(oz * dy))
    cy = oz.fused(dx, -(ox * dz))
    cz = ox.fused(dy, -(oy * dx))
    beside = cx.fused(cx, cy.fused(cy, cz * cz))
    length = dx.fused(dx, dy.fused(dy, dz * dz))
    towards = ox.fused(dx, oy.fused(dy, oz * dz))
    exponent = (beside / length).fused(0.5 / EXPONENT_UNIT, record.number(LEVEL))
    return exponent.where(towards.compare("<", 0.0), 2 * EXPONENT_LIMIT)


class _Record:
    """Numbers of a record in memory, each in all lanes."""

    def __init__(self, builder: ir.IRBuilder, data: Any) -> None:
        self._builder, self._data = builder, data

    def number(self, field: int) -> Lanes:
        """A number."""
        place = self._builder.gep(self._data, [I64(field)], source_etype=FLOAT)
        return splat(self._builder, self._builder.load(place, typ=FLOAT))


def _ray_intrinsic(extras: int, *, moving: bool) -> Any:
    """The intrinsic for what :func:`.simd._blend_intrinsic` says, of rays that start in one place
    or (``moving``) in many.

    In kernels: blend(pixels, half, record); returns zero when all are finished.
    """

    def blend(typingctx, pixels, half, record):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            state = Planes(builder, array.data, arguments[1], planes=RAY_PLANES)
            row = context.make_array(signature.args[2])(context, builder, arguments[2])
            numbers = _Record(builder, row.data)
            exponent = (_moving_exponent if moving else _still_exponent)(state, numbers)
            values = [numbers.number(field) for field in VALUES]
            return blend_exponent(builder, state, exponent, values, extras)

        return types.int64(pixels, types.int64, record), generate

    return intrinsic(blend)


blend_ray = _ray_intrinsic(1, moving=False)
blend_ray_all = _ray_intrinsic(7, moving=False)
blend_moving_ray = _ray_intrinsic(1, moving=True)
blend_moving_ray_all = _ray_intrinsic(7, moving=True)
