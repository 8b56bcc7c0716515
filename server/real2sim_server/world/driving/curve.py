"""A planned trajectory as a smooth curve over time.

A cubic Hermite curve through the vehicle pose at reception of the plan and the poses of the plan.
Tangents are finite differences of the plan, aligned with the planned headings. Beyond its last
pose the curve continues at the last speed and turn rate, so that trackers always have a target.

Knots are [K, 6] float64, one row per pose, the vehicle's first: time from the start [s], x, y [m],
yaw [rad], and the tangent velocity x, y [m/s], world frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..._numba import func
from .vehicle import clamped, wrapped

T, X, Y, YAW, VX, VY = range(6)

MOVING = 0.5
"""Minimum speed for using the direction between plan poses [m/s]; it is mostly noise below."""

DENSE = 0.25
"""Maximum time of the first pose for plans whose initial direction is used [s]."""

TRUSTED_YAW = 0.5
"""Maximum deviation of a planned heading from the path to be used as its tangent [rad]."""


NO_POSE = math.nan, 0.0, 0.0, 0.0
"""Value of ``before`` for plans that do not continue an earlier pose."""


class PlanCurve(NamedTuple):
    """A plan to follow.

    Attributes:
        knots: see above.
        turn_rate: turn rate at and beyond the last pose [rad/s].
        early: delay between a command and its effect [s]; the plan is over once a command given
            after its end would take effect.
    """

    knots: np.ndarray
    turn_rate: float
    early: float


@func
def curve_through(state, seconds, poses, vehicle, before):
    """The curve of a plan, from a vehicle state.

    Args:
        state: vehicle state at the start.
        seconds: [N] float64, times of the poses from the start, positive and increasing [s].
        poses: [N, 3] float64, x, y [m], yaw [rad], world frame.
        vehicle: vehicle constants.
        before: time [s] and x, y [m], yaw [rad] of the previous plan's pose if both plans have a
            single pose, see :data:`NO_POSE`.
    """
    last = len(seconds)
    knots = np.empty((last + 1, 6))
    knots[0, T], knots[0, X], knots[0, Y], knots[0, YAW] = 0.0, state.x, state.y, state.yaw
    knots[0, VX] = state.speed * math.cos(state.yaw)
    knots[0, VY] = state.speed * math.sin(state.yaw)
    for i in range(last):
        knots[i + 1, T] = seconds[i]
        knots[i + 1, X], knots[i + 1, Y], knots[i + 1, YAW] = poses[i, 0], poses[i, 1], poses[i, 2]
    for i in range(1, last + 1):
        slope = _slope(knots, i) if last > 1 else _arrival(knots, state.speed, vehicle, before)
        knots[i, VX], knots[i, VY] = _along_heading(slope, knots[i, YAW])
    return PlanCurve(knots, _last_turn_rate(knots, state, vehicle, before), 0.0)


@func
def end_of(curve):
    """Time of the last pose [s]."""
    return curve.knots[len(curve.knots) - 1, T]


@func
def is_over(curve, t):
    """Whether a command that takes effect at time ``t`` [s] was given after the plan's end."""
    return t >= end_of(curve) + curve.early


@func
def at(curve, t):
    """x, y [m] and velocity x, y [m/s], world frame, ``t`` >= 0 seconds after the start."""
    knots = curve.knots
    last = len(knots) - 1
    if t >= knots[last, T]:
        return _along_arc(knots[last], curve.turn_rate, t - knots[last, T])
    j = 1
    while knots[j, T] <= t:
        j += 1
    a, b = knots[j - 1], knots[j]
    h, since = b[T] - a[T], t - a[T]
    x, vx = _hermite((a[X], a[VX]), (b[X], b[VX]), h, since)
    y, vy = _hermite((a[Y], a[VY]), (b[Y], b[VY]), h, since)
    return x, y, vx, vy


@func
def planned_at(curve, t, version):
    """Like :func:`at`, but on the extrapolated plan before its first pose.

    Before its first pose the plan is extrapolated backwards along an arc. The distance of the
    vehicle from that arc is its tracking error, which :func:`at` hides. For plans that begin late,
    both functions agree.

    Args:
        curve: curve of the plan.
        t: seconds after its start, at least 0.
        version: version of the trackers; from 2 on the arc has the acceleration of the first poses.
    """
    knots = curve.knots
    first = knots[1, T]
    if t >= first or first > DENSE:
        return at(curve, t)
    rate = curve.turn_rate
    if len(knots) > 2:
        rate = wrapped(knots[2, YAW] - knots[1, YAW]) / (knots[2, T] - first)
        if version > 1:
            return _along_changing_arc(knots[1], rate, _first_gain(knots), t - first)
    return _along_arc(knots[1], rate, t - first)


@func
def heading(curve, t):
    """Planned heading [rad] at the first pose not before ``t``, or at the last one."""
    i = 0
    while i < len(curve.knots) - 1 and curve.knots[i, T] < t:
        i += 1
    return curve.knots[i, YAW]


@func
def _slope(knots, i):
    """Velocity [m/s] at a plan pose: slope of the parabola through three neighbouring poses.

    The vehicle pose is excluded: if it is off the plan, the segment from it does not represent
    the planned speed.
    """
    last = len(knots) - 1
    if last == 2:
        return _chord(knots, 1)
    if i == 1:
        return _far_slope(_chord(knots, 1), _mean_slope(knots, 2))
    if i == last:
        return _far_slope(_chord(knots, last - 1), _mean_slope(knots, last - 1))
    return _mean_slope(knots, i)


@func
def _chord(knots, i):
    """Mean velocity [m/s] from pose ``i`` to the next."""
    a, b = knots[i], knots[i + 1]
    h = b[T] - a[T]
    return (b[X] - a[X]) / h, (b[Y] - a[Y]) / h


@func
def _mean_slope(knots, i):
    """Velocity [m/s] at pose ``i`` of the parabola through it and its two neighbours."""
    (ax, ay), (bx, by) = _chord(knots, i - 1), _chord(knots, i)
    before, after = knots[i, T] - knots[i - 1, T], knots[i + 1, T] - knots[i, T]
    fraction = before / (before + after)
    return ax + fraction * (bx - ax), ay + fraction * (by - ay)


@func
def _far_slope(chord, slope):
    """Slope at the far end of a parabola's chord, from that at its near end."""
    return 2 * chord[0] - slope[0], 2 * chord[1] - slope[1]


@func
def _arrival(knots, speed, vehicle, before):
    """Velocity [m/s] at a single planned pose, within the vehicle's limits.

    Computed from the previous plan's pose, else from the vehicle pose. The latter includes the
    tracking error, which dominates at short time steps.
    """
    seconds, since = knots[1, T], 0.0
    dx, dy = knots[1, X] - knots[0, X], knots[1, Y] - knots[0, Y]
    if before[0] < seconds:
        since = before[0]
        dx, dy = knots[1, X] - before[1], knots[1, Y] - before[2]
    length = math.hypot(dx, dy)
    change = clamped(
        length / (seconds - since) - speed,
        -vehicle.max_braking * seconds,
        vehicle.max_acceleration * seconds,
    )
    fraction = max(speed + change, 0.0) / max(length, 1e-9)
    return dx * fraction, dy * fraction


@func
def _along_heading(velocity, yaw):
    """The velocity rotated into the planned heading, if both roughly agree."""
    vx, vy = velocity
    speed = math.hypot(vx, vy)
    cos, sin = math.cos(yaw), math.sin(yaw)
    if speed > MOVING and vx * cos + vy * sin > math.cos(TRUSTED_YAW) * speed:
        return speed * cos, speed * sin
    return velocity


@func
def _last_turn_rate(knots, state, vehicle, before):
    """Turn rate [rad/s] at the last pose, within the vehicle's limits."""
    last = len(knots) - 1
    h = knots[last, T] - knots[last - 1, T]
    rate = wrapped(knots[last, YAW] - knots[last - 1, YAW]) / h
    if last == 1 and before[0] < knots[1, T]:
        rate = wrapped(knots[1, YAW] - before[3]) / (knots[1, T] - before[0])
    if last == 1:
        reach = abs(state.speed) / vehicle.wheelbase * vehicle.max_steer_rate * h
        rate = clamped(rate, state.yaw_rate - reach, state.yaw_rate + reach)
    speed = math.hypot(knots[last, VX], knots[last, VY])
    most = speed * math.tan(vehicle.max_steer) / vehicle.wheelbase
    return clamped(rate, -most, most)


@func
def _along_arc(knot, rate, since):
    """Position and velocity on an arc, ``since`` seconds after a knot (before it if negative)."""
    vx, vy = knot[VX], knot[VY]
    half = rate * since / 2
    cos, sin = math.cos(half), math.sin(half)
    chord = since * (sin / half if abs(half) > 1e-6 else 1.0)
    x = knot[X] + chord * (cos * vx - sin * vy)
    y = knot[Y] + chord * (sin * vx + cos * vy)
    cos, sin = math.cos(2 * half), math.sin(2 * half)
    return x, y, cos * vx - sin * vy, sin * vx + cos * vy


@func
def _first_gain(knots):
    """Acceleration [m/s^2] along the path from the first planned pose to the next."""
    before = math.hypot(knots[1, VX], knots[1, VY])
    along = knots[1, VX] * knots[2, VX] + knots[1, VY] * knots[2, VY]
    after = math.copysign(math.hypot(knots[2, VX], knots[2, VY]), along)
    return (after - before) / (knots[2, T] - knots[1, T])


@func
def _along_changing_arc(knot, rate, gain, since):
    """Position and velocity on an arc at ``since`` <= 0 seconds relative to a knot.

    The arc has a constant acceleration [m/s^2]; the vehicle is at rest before it starts to move.
    """
    speed = math.hypot(knot[VX], knot[VY])
    if speed == 0.0:
        return knot[X], knot[Y], 0.0, 0.0
    if speed + gain * since < 0.0:
        since = -speed / gain
    # The time that the arc would take at the speed of the knot.
    alike = since * (1.0 + gain * since / (2 * speed))
    x, y, vx, vy = _along_arc(knot, rate, alike)
    share = (speed + gain * since) / speed
    return x, y, share * vx, share * vy


@func
def _hermite(start, end, h, t):
    """Value and slope at ``t`` in [0, h] of the cubic with these values and slopes at its ends."""
    (a, a_slope), (b, b_slope) = start, end
    u = t / h
    chord = (b - a) / h
    c2 = 3 * chord - 2 * a_slope - b_slope
    c3 = a_slope + b_slope - 2 * chord
    return a + t * (a_slope + u * (c2 + u * c3)), a_slope + u * (2 * c2 + 3 * u * c3)
