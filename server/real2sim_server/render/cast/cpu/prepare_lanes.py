"""Eight Gaussians at a time: their whitening, and between which angles rays may meet them.

Angles are exact tangents to the ellipsoid alpha = 1/255 as seen by the sensor at the instant it
looks at the centre, widened by how far it can move until it looks at the edges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

from ...backends.base import ALPHA_MIN
from ...backends.cpu.lanes import Lanes, Planes, logarithm
from ...backends.cpu.project_lanes import LOG_255, Named, eight_step
from ...backends.cpu.records import EXPONENT_UNIT
from ...backends.cpu.vectors import (
    Vector,
    cholesky,
    dot,
    dot_all,
    turn_columns,
    whitening,
)
from .records import (
    FRAME,
    GAIN,
    HIGH,
    LEFT,
    LEVEL,
    LOW,
    MEAN,
    OPACITY,
    PREPARATION,
    RANGE,
    RIGHT,
    SHAPE,
    WHITENING,
)

HALF_UNIT_ROOT = math.sqrt(0.5 / EXPONENT_UNIT)
SLACK = 2e-4
"""Angles are widened by this [rad] against rounding and the series of the arc tangent."""
NEARLY_INSIDE = 0.05
"""A Gaussian whose depth takes all but this share of its squared distance may be anywhere."""
POLE = 1.5
"""Beyond this elevation [rad] azimuths mean nothing."""
ARC = (0.99997726, -0.33262347, 0.19354346, -0.11643287, 0.05265332, -0.01172120)
"""Odd series of the arc tangent on [-1, 1], to 2e-6."""
TINY = 1e-12


def _prepare(eight: Planes, sensor: Named, body: Named, *, deformed: bool) -> Any:
    """Write the planes of a record; there remain those that a ray may meet."""
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
    """How fast what is at least ``nearest`` away moves as seen from the sensor [rad/s]."""
    return body.number("speed") / nearest + body.number("turn")


def _factors(eight: Planes, body: Named) -> list[Vector]:
    """[3][3]: linear R diag(s), whose product with its transpose is the covariance."""
    columns = turn_columns([eight.load(SHAPE + k) for k in range(4)])
    scales = [eight.load(SHAPE + 4 + k) for k in range(3)]
    linear = _linear(body)
    return [[dot(linear[row], columns[k]) * scales[k] for k in range(3)] for row in range(3)]


def _deformed_factors(eight: Planes, body: Named) -> list[Vector]:
    """The same from the upper half of a covariance: linear times its Cholesky factor."""
    upper = [eight.load(SHAPE + k).doubles() for k in range(6)]
    a, b, c, d, e, f = cholesky(upper, TINY)
    rows = []
    for own in _linear(body):
        rows.append([dot(own, (a, b, c)), own[1].fused(d, own[2] * e), own[2] * f])
    return rows


def _linear(body: Named) -> list[Vector]:
    return [[number.floats() for number in body.three("linear", row=k)] for k in range(3)]


def _spread(direction: Vector, rows: Sequence[Vector], reach: Lanes) -> Vector:
    """How far the ellipsoid reaches along a direction, as a vector whose products give all."""
    columns = zip(*rows, strict=True)
    return [dot(direction, column) * reach for column in columns]


def _angles(  # noqa: PLR0917
    sensor: Named, seen: list[Vector], gain: Lanes, along: Lanes, z: Lanes, square: Lanes
) -> dict[str, Lanes | Any]:
    """Bounds against the centre: ``left``, ``right``, ``down``, ``up`` [rad], how far they are
    ``widened``, and the mask ``anywhere``."""
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
    it is too near for that."""
    free = square - along
    inside = free.compare("<=", square * NEARLY_INSIDE)
    free = free.at_least(square * NEARLY_INSIDE)
    root = mixed.fused(mixed, across * free).at_least(0.0).root()
    return arc((-mixed - root) / free), arc((root - mixed) / free), inside


def _store_bounds(eight: Planes, angles: dict[str, Any], azimuth: Lanes, elevation: Lanes) -> None:
    left, right, widened = angles["left"], angles["right"], angles["widened"]
    low, high = elevation + angles["down"], elevation + angles["up"]
    # tan e = tan(tilt) cos(azimuth): a horizontal edge sinks towards the horizon on both sides.
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
    """Arc tangent, to 2e-6."""
    size = tangent.magnitude()
    steep = size.compare(">", 1.0)
    ratio = size.reciprocal().where(steep, size)
    angle = _series(ratio)
    angle = (-angle + math.pi / 2).where(steep, angle)
    return (-angle).where(tangent.compare("<", 0.0), angle)


def arc2(y: Lanes, x: Lanes) -> Lanes:
    """Angle of (x, y), to 2e-6."""
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
