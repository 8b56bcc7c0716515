"""What a drive and its plans feel like, each in one call."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import kernel

PLAN_BOUNDS = (0.7, 0.5, 0.1, 0.1)
"""Greatest RMS difference of successive plans in acceleration, jerk, yaw rate, yaw acceleration
(NAVSIM v2, extended comfort)."""

PLAN_STEP = 0.1
SHORTEST_OVERLAP = 6
"""Fewer common times than these say nothing."""


@kernel
def windowed_sum(values, value, window):
    """Values [n] with one more at their end, the last ``window`` of them; and their sum."""
    kept = min(len(values), window - 1)
    found = np.empty(kept + 1)
    for k in range(kept):
        found[k] = values[len(values) - kept + k]
    found[kept] = value
    total = 0.0
    for v in found:
        total += v
    return found, total


@kernel
def derivatives(weights, samples):
    """Weighted sums of speed and yaw.

    Args:
        weights: [3, W] float64 of the value, the first and the second derivative.
        samples: [W, 2] float64, speed and yaw.

    Returns:
        Speed, its first and second derivative; first and second derivative of yaw.
    """
    speed = acceleration = jerk = rate = yaw_acceleration = 0.0
    for k in range(len(samples)):
        speed += weights[0, k] * samples[k, 0]
        acceleration += weights[1, k] * samples[k, 0]
        jerk += weights[2, k] * samples[k, 0]
        rate += weights[1, k] * samples[k, 1]
        yaw_acceleration += weights[2, k] * samples[k, 1]
    return speed, acceleration, jerk, rate, yaw_acceleration


@kernel
def make_continuous(poses):
    """Add whole turns to the yaws of poses [N, 3] (x, y, yaw [rad]), so that none is more than
    half a turn from the one before, as ``np.unwrap``."""
    before, added = poses[0, 2], 0.0
    for k in range(1, len(poses)):
        step = poses[k, 2] - before
        before = poses[k, 2]
        if abs(step) > math.pi:
            short = (step + math.pi) % math.tau - math.pi
            if short == -math.pi and step > 0:
                short = math.pi
            added += short - step
        poses[k, 2] += added


@kernel
def plans_alike(times_a, poses_a, times_b, poses_b):
    """Whether two plans feel alike where both say something: RMS differences of acceleration,
    jerk, yaw rate and yaw acceleration, by finite differences in steps of 0.1 s.

    Args:
        times_a, times_b: [N] int64, increasing [us].
        poses_a, poses_b: [N, 3] float64, x, y [m], yaw [rad].

    Returns:
        1 for alike, 0 for not, -1 where they overlap for less than 0.5 s.
    """
    first, last = max(times_a[0], times_b[0]), min(times_a[-1], times_b[-1])
    count = int((last - first) * 1e-6 / PLAN_STEP + 1e-6) + 1
    if count < SHORTEST_OVERLAP:
        return -1
    poses_a, poses_b = poses_a.copy(), poses_b.copy()
    make_continuous(poses_a)
    make_continuous(poses_b)
    speeds, rates = np.empty((2, count - 1)), np.empty((2, count - 1))
    _differentiate(times_a, poses_a, first, speeds[0], rates[0])
    _differentiate(times_b, poses_b, first, speeds[1], rates[1])
    # Differences of derivatives are derivatives of differences.
    acceleration, rate = _slopes(speeds[0] - speeds[1]), rates[0] - rates[1]
    alike = (
        _within(acceleration, PLAN_BOUNDS[0])
        and _within(_slopes(acceleration), PLAN_BOUNDS[1])
        and _within(rate, PLAN_BOUNDS[2])
        and _within(_slopes(rate), PLAN_BOUNDS[3])
    )
    return 1 if alike else 0


@kernel
def _differentiate(times, poses, first, speeds, rates):
    """Write speeds and yaw rates [T] of a plan between times in steps of 0.1 s from ``first``."""
    k = 1
    x = y = yaw = 0.0
    for i in range(len(speeds) + 1):
        at = first * 1e-6 + PLAN_STEP * i
        while k < len(times) - 1 and times[k] * 1e-6 < at:
            k += 1
        start, end = times[k - 1] * 1e-6, times[k] * 1e-6
        fraction = (at - start) / (end - start)
        rest = 1 - fraction
        before = x, y, yaw
        x = poses[k - 1, 0] * rest + poses[k, 0] * fraction
        y = poses[k - 1, 1] * rest + poses[k, 1] * fraction
        yaw = poses[k - 1, 2] * rest + poses[k, 2] * fraction
        if i:
            vx, vy = (x - before[0]) / PLAN_STEP, (y - before[1]) / PLAN_STEP
            speeds[i - 1] = math.sqrt(vx * vx + vy * vy)
            rates[i - 1] = (yaw - before[2]) / PLAN_STEP


@kernel
def _slopes(values):
    """Finite differences [T - 1] of values [T] in steps of 0.1 s."""
    return (values[1:] - values[:-1]) / PLAN_STEP


@kernel
def _within(values, bound):
    """Whether the RMS of values [T] is at most ``bound``."""
    squares = 0.0
    for value in values:
        squares += value * value
    return squares <= len(values) * bound * bound
