"""A planned trajectory as a smooth curve over time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import ArrayLike

from real2sim_proto.drive import EgoSpec

from .ego import Motion
from .path import Float

MOVING = 0.5
"""Below this speed the direction between plan poses is mostly noise [m/s]."""

TRUSTED_YAW = 0.5
"""A planned heading that differs more from the planned way is not used as its tangent [rad]."""


class Reference:
    """Cubic Hermite curve through the vehicle's pose when it got the plan, and the plan's poses.

    Tangents are finite differences of the plan, turned into the planned headings. After its last
    pose the curve goes on with its last speed and turn rate, so that there is something to aim at.

    Attributes:
        start_us: when the vehicle got the plan [us].
        end: time of the last pose, from ``start_us`` [s].
        last_pose: x, y [m], yaw [rad] in the world.
    """

    def __init__(
        self, motion: Motion, *, start_us: int, times_us: ArrayLike, poses: ArrayLike, spec: EgoSpec
    ) -> None:
        """The plan of a vehicle that is in ``motion`` at ``start_us``.

        Args:
            motion: of the vehicle.
            start_us: now [us].
            times_us: [N] int64, increasing, after ``start_us`` [us].
            poses: [N, 3] x, y [m], yaw [rad] in the world.
            spec: limits of the vehicle.
        """
        given = np.asarray(poses, dtype=np.float64)
        seconds: Float = (np.asarray(times_us, dtype=np.int64) - start_us) * np.float64(1e-6)
        tangents = _tangents(seconds, given, motion, spec)
        own = motion.speed * math.cos(motion.yaw), motion.speed * math.sin(motion.yaw)
        self.start_us = start_us
        self.end = float(seconds[-1])
        self.last_pose: tuple[float, float, float] = tuple(given[-1].tolist())
        self._times: list[float] = [0.0, *seconds.tolist()]
        self._x: list[float] = [motion.x, *given[:, 0].tolist()]
        self._y: list[float] = [motion.y, *given[:, 1].tolist()]
        self._yaws: list[float] = [motion.yaw, *given[:, 2].tolist()]
        self._vx: list[float] = [own[0], *tangents[:, 0].tolist()]
        self._vy: list[float] = [own[1], *tangents[:, 1].tolist()]
        last_speed = math.hypot(self._vx[-1], self._vy[-1])
        self._turn_rate = _last_turn_rate(seconds, given, motion, last_speed, spec)

    def at(self, t: float) -> tuple[float, float, float, float]:
        """x, y [m] and velocity x, y [m/s] in the world, ``t`` >= 0 seconds after the start."""
        after = bisect_right(self._times, t)
        if after == len(self._times):
            return self._beyond(t - self.end)
        i, j = after - 1, after
        h, since = self._times[j] - self._times[i], t - self._times[i]
        x, vx = _hermite((self._x[i], self._vx[i]), (self._x[j], self._vx[j]), h, since)
        y, vy = _hermite((self._y[i], self._vy[i]), (self._y[j], self._vy[j]), h, since)
        return x, y, vx, vy

    def heading(self, t: float) -> float:
        """Planned heading [rad] at the first pose not before ``t``, or at the last one."""
        return self._yaws[min(bisect_left(self._times, t), len(self._yaws) - 1)]

    def _beyond(self, since: float) -> tuple[float, float, float, float]:
        vx, vy = self._vx[-1], self._vy[-1]
        half = self._turn_rate * since / 2
        cos, sin = math.cos(half), math.sin(half)
        chord = since * (sin / half if abs(half) > 1e-6 else 1.0)
        x = self._x[-1] + chord * (cos * vx - sin * vy)
        y = self._y[-1] + chord * (sin * vx + cos * vy)
        cos, sin = math.cos(2 * half), math.sin(2 * half)
        return x, y, cos * vx - sin * vy, sin * vx + cos * vy


def _tangents(seconds: Float, poses: Float, motion: Motion, spec: EgoSpec) -> Float:
    """Velocities [N, 2] [m/s] at the plan's poses."""
    if len(seconds) == 1:
        velocity = _arrival(seconds[0], poses[0], motion, spec)[None]
    else:
        velocity = _slopes(seconds, poses[:, :2])
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    headings = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    along = np.sum(velocity * headings, axis=1)
    trusted = (speed > MOVING) & (along > math.cos(TRUSTED_YAW) * speed)
    tangents: Float = np.where(trusted[:, None], speed[:, None] * headings, velocity)
    return tangents


def _arrival(seconds: float, pose: Float, motion: Motion, spec: EgoSpec) -> Float:
    """Velocity [2] [m/s] at a single planned pose: that of the way there, as far as in reach.

    Without the limit a few centimetres over a short step would count as metres per second.
    """
    way = pose[:2] - [motion.x, motion.y]
    length = float(np.hypot(way[0], way[1]))
    change = length / seconds - motion.speed
    change = min(max(change, -spec.max_braking * seconds), spec.max_acceleration * seconds)
    arrival: Float = way * max(motion.speed + change, 0.0) / max(length, 1e-9)
    return arrival


def _last_turn_rate(
    seconds: Float, poses: Float, motion: Motion, last_speed: float, spec: EgoSpec
) -> float:
    """Turn rate [rad/s] at the last pose, as far as the vehicle can turn."""
    single = len(seconds) == 1
    turn = poses[-1, 2] - (motion.yaw if single else poses[-2, 2])
    rate = math.remainder(turn, math.tau) / (seconds[-1] - (0.0 if single else seconds[-2]))
    if single:
        reach = abs(motion.speed) / spec.wheelbase * spec.max_steer_rate * seconds[0]
        rate = min(max(rate, motion.yaw_rate - reach), motion.yaw_rate + reach)
    most = last_speed * math.tan(spec.max_steer) / spec.wheelbase
    return float(min(max(rate, -most), most))


def _slopes(times: Float, values: Float) -> Float:
    """Derivatives [N, C] of ``values`` [N, C], N >= 2, by the parabola through three neighbours."""
    steps = np.diff(times)[:, None]
    chords = np.diff(values, axis=0) / steps
    if len(times) == 2:
        return np.concatenate([chords, chords])
    inner = (steps[1:] * chords[:-1] + steps[:-1] * chords[1:]) / (steps[:-1] + steps[1:])
    return np.concatenate([2 * chords[:1] - inner[:1], inner, 2 * chords[-1:] - inner[-1:]])


def _hermite(
    start: tuple[float, float], end: tuple[float, float], h: float, t: float
) -> tuple[float, float]:
    """Value and slope at ``t`` in [0, h] of the cubic with these values and slopes at its ends."""
    (a, a_slope), (b, b_slope) = start, end
    u = t / h
    chord = (b - a) / h
    c2 = 3 * chord - 2 * a_slope - b_slope
    c3 = a_slope + b_slope - 2 * chord
    return a + t * (a_slope + u * (c2 + u * c3)), a_slope + u * (2 * c2 + 3 * u * c3)
