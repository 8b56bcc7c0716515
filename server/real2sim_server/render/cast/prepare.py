"""Records of the Gaussians of one body, with the range of angles at which rays may hit them.

The sensor moves while it spins, so the time at which it scans each Gaussian is computed first. At
the azimuth where the sweep starts and ends, Gaussians are scanned twice, one turn apart, and become
two records, one for the tiles of each half of the sweep.

Eight Gaussians are processed at a time. The angles are exact tangents to the ellipsoid
alpha = 1/255 at the scan time of its centre, widened by the sensor motion until its edges are
scanned.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
from numba import prange

from ..._numba import PARALLEL_LOOPS
from .._cpu.lanes import (
    LANES,
    Lanes,
    Planes,
    Vector,
    cholesky,
    dot,
    dot_all,
    inlined,
    kernel,
    logarithm,
    lowest_bit,
    turn_columns,
    whitening,
)
from .._cpu.project import LOG_255, Named, eight_step, gather_shape
from .._cpu.records import CHUNK, EXPONENT_UNIT
from ..backend import ALPHA_MIN
from .layout import (
    AZIMUTH_BIN,
    AZIMUTH_BINS,
    BODY,
    ELEVATION_BIN,
    ELEVATION_BINS,
    FRAME,
    GAIN,
    HIGH,
    LEFT,
    LEVEL,
    LOSS,
    LOW,
    MEAN,
    MEMBER,
    OPACITY,
    PREPARATION,
    RANGE,
    RECORD,
    REFLECTIVITY,
    RIGHT,
    SHAPE,
    WHITENING,
)

HALF_UNIT_ROOT = math.sqrt(0.5 / EXPONENT_UNIT)
SLACK = 2e-4
"""Margin of angles for rounding and the arc tangent series [rad]."""
NEARLY_INSIDE = 0.05
"""If the Gaussian's squared extent along the ray leaves less than this fraction of its squared
distance, it may be in any direction."""
POLE = 1.5
"""Elevation beyond which azimuths are undefined [rad]."""
ARC = (0.99997726, -0.33262347, 0.19354346, -0.11643287, 0.05265332, -0.01172120)
"""Odd series of the arc tangent on [-1, 1]; error 2e-6."""
TINY = 1e-12


def _prepare(eight: Planes, sensor: Named, body: Named, *, deformed: bool) -> Any:
    """Write the planes of a record; keeps Gaussians that a ray may hit."""
    mean = [eight.load(MEAN + k) for k in range(3)]
    turn = [[eight.load(FRAME + 4 * row + k) for k in range(3)] for row in range(3)]
    x, y, z = (dot(turn[row], mean, eight.load(FRAME + 4 * row + 3)) for row in range(3))
    flat = x.fused(x, y * y).at_least(TINY)
    square = z.fused(z, flat)
    along, distance = flat.root(), square.root()
    cos, sin = x / along, y / along
    radial = [turn[0][k].fused(cos, turn[1][k] * sin) for k in range(3)]
    across = [turn[1][k].fused(cos, -(turn[0][k] * sin)) for k in range(3)]
    rise, level_share = z / distance, along / distance
    upward = [turn[2][k].fused(level_share, -(radial[k] * rise)) for k in range(3)]

    factors = (_deformed_factors if deformed else _factors)(eight, body)
    wide, high = distance * sensor.number("wide"), distance * sensor.number("high")
    rows = [[*factors[k], across[k] * wide, upward[k] * high] for k in range(3)]
    for k, value in enumerate(whitening(rows, TINY)):
        eight.store(WHITENING + k, value * HALF_UNIT_ROOT)

    opacity = eight.load(OPACITY)
    level = -logarithm(opacity.at_least(TINY))
    eight.store(LEVEL, level * (1 / EXPONENT_UNIT))
    reach = ((-level + LOG_255).at_least(0.0) * 2.0).root()
    seen = [_spread(direction, rows, reach) for direction in (radial, across, turn[2])]
    extent = reduce(Lanes.__add__, (dot_all(v, v) for v in seen)).root()
    gain = sensor_gain(body, (distance - extent).at_least(0.1))
    eight.store(GAIN, gain)
    eight.store(RANGE, distance)
    angles = _angles(sensor, seen, gain, along, z, square)
    azimuth, elevation = arc2(y, x), arc2(z, along)
    _store_bounds(eight, angles, azimuth, elevation)
    tests = [
        opacity.compare(">=", ALPHA_MIN),
        (distance - extent).compare("<=", sensor.number("far")),
        (distance + extent).compare(">=", sensor.number("near")),
    ]
    return reduce(eight.builder.and_, tests)


def sensor_gain(body: Named, nearest: Lanes) -> Lanes:
    """Upper bound of the angular speed [rad/s] of points at least ``nearest`` [m] away."""
    return body.number("speed") / nearest + body.number("turn")


def _factors(eight: Planes, body: Named) -> list[Vector]:
    """Factor F = linear R diag(s), [3][3], of the covariance F F^T."""
    columns = turn_columns([eight.load(SHAPE + k) for k in range(4)])
    scales = [eight.load(SHAPE + 4 + k) for k in range(3)]
    linear = _linear(body)
    return [[dot(linear[row], columns[k]) * scales[k] for k in range(3)] for row in range(3)]


def _deformed_factors(eight: Planes, body: Named) -> list[Vector]:
    """The same from the upper half of a covariance: linear times the Cholesky factor."""
    upper = [eight.load(SHAPE + k).doubles() for k in range(6)]
    a, b, c, d, e, f = cholesky(upper, TINY)
    rows = []
    for own in _linear(body):
        rows.append([dot(own, (a, b, c)), own[1].fused(d, own[2] * e), own[2] * f])
    return rows


def _linear(body: Named) -> list[Vector]:
    return [[number.floats() for number in body.three("linear", row=k)] for k in range(3)]


def _spread(direction: Vector, rows: Sequence[Vector], reach: Lanes) -> Vector:
    """Vector whose length is the extent of the ellipsoid along a direction.

    Products of such vectors are the covariances between directions.
    """
    columns = zip(*rows, strict=True)
    return [dot(direction, column) * reach for column in columns]


def _angles(
    sensor: Named, seen: list[Vector], gain: Lanes, along: Lanes, z: Lanes, square: Lanes
) -> dict[str, Lanes | Any]:
    """Bounds relative to the centre: ``left``, ``right``, ``down``, ``up`` [rad].

    Also the margin ``widened`` [rad], and the mask ``anywhere`` of Gaussians without bounds.
    """
    radial, across, upward = seen
    flat = along * along
    left, right, near_axis = _tangents(
        flat, dot_all(radial, radial), dot_all(radial, across), dot_all(across, across)
    )
    inverse = square.root().reciprocal()
    u = [(a * along + b * z) * inverse for a, b in zip(radial, upward, strict=True)]
    v = [(b * along - a * z) * inverse for a, b in zip(radial, upward, strict=True)]
    down, up, near = _tangents(square, dot_all(u, u), dot_all(u, v), dot_all(v, v))
    half = left.magnitude().at_least(right.magnitude())
    widened = gain * half.fused(sensor.number("period"), sensor.number("spread")) + SLACK
    return {
        "left": left - widened,
        "right": right + widened,
        "down": down,
        "up": up,
        "widened": widened,
        "anywhere": along.builder.or_(near_axis, near),
    }


def _tangents(square: Lanes, along: Lanes, mixed: Lanes, across: Lanes) -> tuple[Lanes, Lanes, Any]:
    """Angles of the two tangents from the origin to an ellipse at a squared distance, and whether
    the origin is inside it or too close."""
    free = square - along
    inside = free.compare("<=", square * NEARLY_INSIDE)
    free = free.at_least(square * NEARLY_INSIDE)
    root = mixed.fused(mixed, across * free).at_least(0.0).root()
    return arc((-mixed - root) / free), arc((root - mixed) / free), inside


def _store_bounds(eight: Planes, angles: dict[str, Any], azimuth: Lanes, elevation: Lanes) -> None:
    left, right, widened = angles["left"], angles["right"], angles["widened"]
    low, high = elevation + angles["down"], elevation + angles["up"]
    # tan e = tan(tilt) cos(azimuth): a horizontal edge approaches the horizon on both sides.
    half = left.magnitude().at_least(right.magnitude())
    sunk = (half * half * -0.5 + 1.0).at_least(0.0)
    low, high = low.at_most(low * sunk) - widened, high.at_least(high * sunk) + widened
    builder = eight.builder
    anywhere = reduce(
        builder.or_,
        [angles["anywhere"], low.compare("<", -POLE), high.compare(">", POLE)],
    )
    beyond = azimuth * 0.0 + 4.0
    eight.store(LEFT, (-beyond).where(anywhere, azimuth + left))
    eight.store(RIGHT, beyond.where(anywhere, azimuth + right))
    eight.store(LOW, (-beyond).where(anywhere, low))
    eight.store(HIGH, beyond.where(anywhere, high))


def arc(tangent: Lanes) -> Lanes:
    """Arc tangent; error 2e-6."""
    size = tangent.magnitude()
    steep = size.compare(">", 1.0)
    ratio = size.reciprocal().where(steep, size)
    angle = _series(ratio)
    angle = (-angle + math.pi / 2).where(steep, angle)
    return (-angle).where(tangent.compare("<", 0.0), angle)


def arc2(y: Lanes, x: Lanes) -> Lanes:
    """Angle of (x, y); error 2e-6."""
    ax, ay = x.magnitude(), y.magnitude()
    large, small = ax.at_least(ay).at_least(TINY), ax.at_most(ay)
    angle = _series(small / large)
    angle = (-angle + math.pi / 2).where(ay.compare(">", ax), angle)
    angle = (-angle + math.pi).where(x.compare("<", 0.0), angle)
    return (-angle).where(y.compare("<", 0.0), angle)


def _series(ratio: Lanes) -> Lanes:
    square = ratio * ratio
    value = square * 0.0 + ARC[-1]
    for coefficient in ARC[-2::-1]:
        value = value.fused(square, coefficient)
    return value * ratio


prepare_eight = eight_step(partial(_prepare, deformed=False), count=PREPARATION)
prepare_eight_deformed = eight_step(partial(_prepare, deformed=True), count=PREPARATION)


# Records of a body


F32 = np.float32
PI, HALF_PI, TURN = F32(np.pi), F32(np.pi / 2), F32(2 * np.pi)
A0, A1, A2, A3, A4, A5 = (F32(a) for a in ARC)
ROUNDS = 2
"""Iterations for the scan time of a point; each leaves 1/50 of the error."""
SEAMLESS = 3.5
FIELDS = tuple(field for field in range(RECORD) if field not in {BODY, MEMBER, REFLECTIVITY, LOSS})


@kernel(parallel=PARALLEL_LOOPS, fastmath={"contract", "nsz", "arcp"})
def prepare_body(body, sensor, layout, base, records):
    """Write records of the Gaussians of one Body that rays may hit.

    Args:
        base: first chunk of this body; each chunk has two regions of CHUNK records.
        records: Records of the rasterizer, written starting at region ``2 base``.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    values, footprints = records.values, records.footprints
    depths, counts = records.depths, records.counts
    total = body.means.shape[0]
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        planes = np.zeros(PREPARATION * LANES, np.float32)
        region = 2 * (base + chunk)
        slot, second = region * CHUNK, (region + 1) * CHUNK
        stop = min(total, (chunk + 1) * CHUNK)
        for first in range(chunk * CHUNK, stop, LANES):
            count = min(stop - first, LANES)
            gather(body, first, count, planes)
            pending, seamless = np.int64((1 << count) - 1), layout.seam >= SEAMLESS
            seamless = seamless or (body.speed == 0 and body.turn == 0)
            for side in range(3):
                look(body, layout, count, side, planes)
                lanes = run(body, sensor, pending, planes)
                if side == 0:
                    pending = np.int64(0) if seamless else near_seam(layout, sensor, lanes, planes)
                    lanes &= ~pending
                place = second if side == 2 else slot
                place = write(
                    body, layout, first, lanes, side, planes, values, footprints, depths, place
                )
                if side == 2:
                    second = place
                else:
                    slot = place
                if pending == 0:
                    break
        counts[region] = slot - region * CHUNK
        counts[region + 1] = second - (region + 1) * CHUNK


@inlined()
def gather(body, first, count, planes):
    """Gather Gaussians into the planes, with centres in the sweep frame."""
    for lane in range(count):
        i = first + lane
        planes[OPACITY * LANES + lane] = body.opacities[i]
        x, y, z = (
            np.float64(body.means[i, 0]),
            np.float64(body.means[i, 1]),
            np.float64(body.means[i, 2]),
        )
        for k in range(3):
            row = body.linear[k]
            placed = row[0] * x + row[1] * y + row[2] * z + body.offset[k]
            planes[(MEAN + k) * LANES + lane] = F32(placed)
        gather_shape(body, i, SHAPE, lane, planes)


@inlined()
def look(body, layout, count, side, planes):
    """Write the sensor pose at the scan time of each centre to the planes.

    ``side`` is 1 for the first half of the sweep, 2 for the second, 0 for both.
    """
    slots = body.frames.shape[0]
    low = 0 if side != 2 else slots - slots // 2
    high = slots - 1 if side != 1 else slots // 2 - 1
    for lane in range(count):
        slot = (low + high) // 2
        if body.speed > 0 or body.turn > 0:
            mx, my = planes[MEAN * LANES + lane], planes[(MEAN + 1) * LANES + lane]
            mz = planes[(MEAN + 2) * LANES + lane]
            if side == 1:
                slot = 0
            elif side == 2:
                slot = slots - 1
            for _ in range(ROUNDS):
                f = body.frames[slot]
                x = f[0] * mx + f[1] * my + f[2] * mz + f[3]
                y = f[4] * mx + f[5] * my + f[6] * mz + f[7]
                bin_ = np.int64((angle_of(y, x) + PI) * F32(1 / AZIMUTH_BIN))
                found = np.int64(layout.slot_of[min(max(bin_, 0), AZIMUTH_BINS - 1)])
                if side == 1 and found > high:
                    found = 0
                elif side == 2 and found < low:
                    found = slots - 1
                slot = found
        for k in range(12):
            planes[(FRAME + k) * LANES + lane] = body.frames[slot, k]


@inlined()
def run(body, sensor, lanes, planes):
    """Bits of the remaining lanes, see prepare_eight."""
    if body.covars.shape[0] > 0:
        return prepare_eight_deformed(planes, lanes, sensor, body)
    return prepare_eight(planes, lanes, sensor, body)


@inlined()
def near_seam(layout, sensor, lanes, planes):
    """Bits of the Gaussians that rays may hit both at the start and at the end of the sweep."""
    bits = np.int64(0)
    for lane in range(LANES):
        if (lanes >> lane) & 1:
            left, right = planes[LEFT * LANES + lane], planes[RIGHT * LANES + lane]
            moved = planes[GAIN * LANES + lane] * sensor.duration
            middle, half = F32(0.5) * (left + right), F32(0.5) * (right - left) + moved
            away = abs(F32(layout.seam) - middle)
            away = min(away, abs(TURN - away))
            if half < PI and away <= half:
                bits |= np.int64(1) << lane
    return bits


@inlined()
def write(body, layout, first, lanes, side, planes, values, footprints, depths, slot):
    """Write the records of lanes whose angles contain rays; returns the next free slot."""
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        footprint = footprint_of(layout, lane, planes, side)
        if footprint >= 0:
            out = values[slot]
            for field in FIELDS:
                out[field] = planes[field * LANES + lane]
            out[BODY] = body.number
            out[MEMBER] = F32(first + lane)
            known = body.attributes.shape[0] > 0
            out[REFLECTIVITY] = body.attributes[first + lane, 0] if known else F32(0.5)
            out[LOSS] = body.attributes[first + lane, 1] if known else F32(0)
            footprints[slot] = footprint
            depths[slot] = planes[RANGE * LANES + lane]
            slot += 1
    return slot


@inlined()
def footprint_of(layout, lane, planes, side):
    """Bands, azimuth bins and side as one integer, or -1 if no ray passes.

    From the low bits: first and last band (8 bits each), first and last bin (13 bits each; the last
    may exceed the number of bins, which wraps), side (2 bits).
    """
    low = elevation_bin(planes[LOW * LANES + lane])
    high = elevation_bin(planes[HIGH * LANES + lane])
    if layout.rows_until[high] <= layout.rows_before[low]:
        return np.int64(-1)
    band, last_band = np.int64(layout.first_bands[low]), np.int64(layout.last_bands[high])
    if band > last_band:
        return np.int64(-1)
    left, right = planes[LEFT * LANES + lane], planes[RIGHT * LANES + lane]
    if right - left >= TURN:
        first_bin, last_bin = np.int64(0), np.int64(AZIMUTH_BINS - 1)
    else:
        if left < -PI:
            left, right = left + TURN, right + TURN
        elif left >= PI:
            left, right = left - TURN, right - TURN
        first_bin = np.int64((left + PI) * F32(1 / AZIMUTH_BIN))
        first_bin = min(max(first_bin, 0), AZIMUTH_BINS - 1)
        last_bin = np.int64((right + PI) * F32(1 / AZIMUTH_BIN))
        last_bin = min(max(last_bin, first_bin), first_bin + AZIMUTH_BINS - 1)
    packed = band | (last_band << 8) | (first_bin << 16) | (last_bin << 29)
    return packed | (np.int64(side) << 42)


@inlined()
def elevation_bin(angle):
    """Bin of an elevation; angles beyond the poles are clamped."""
    bin_ = np.int64((angle + HALF_PI) * F32(1 / ELEVATION_BIN) + F32(1)) - 1
    return min(max(bin_, 0), ELEVATION_BINS - 1)


@inlined()
def angle_of(y, x):
    """Angle of (x, y); error 2e-6."""
    ax, ay = abs(x), abs(y)
    ratio = min(ax, ay) / max(ax, ay, F32(1e-12))
    s = ratio * ratio
    angle = ratio * (A0 + s * (A1 + s * (A2 + s * (A3 + s * (A4 + s * A5)))))
    if ay > ax:
        angle = HALF_PI - angle
    if x < 0:
        angle = PI - angle
    return math.copysign(angle, y)
