"""The controller that makes the vehicle follow a planned trajectory."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .ego import Command, Motion
from .path import Float

LOOKAHEAD = 0.5
"""The controller aims at where the plan is this much later [s]."""

MIN_AIM = 3.0
"""Steering aims at least this far ahead; nearer aims would turn centimetres into angles [m]."""

AIM_TRIES = 8
MAX_LAG = 2.0
"""Distance behind or ahead of the plan beyond which the controller hurries no more [m]."""

GENTLE_BRAKING = 2.0
"""Deceleration after the plan's end [m/s^2]."""

MOVING = 0.5
"""Below this speed the direction between plan poses is mostly noise [m/s]."""

TRUSTED_YAW = 0.5
"""A planned heading that differs more from the planned way is not used as its tangent [rad]."""


class Reference:
    """A plan as a curve over time: cubic Hermite through the vehicle's pose and the plan's.

    Tangents are finite differences of the plan, turned into the planned headings. After its last
    pose the plan goes straight on at its last speed, so that there is something to aim at.

    Attributes:
        start_us: when the plan was made [us].
        end: time of the last pose, from the start [s].
    """

    def __init__(
        self,
        *,
        motion: Motion,
        start_us: int,
        times_us: ArrayLike,
        poses: ArrayLike,
        wheelbase: float,
    ) -> None:
        """Plan from ``motion`` at ``start_us`` on.

        Args:
            times_us: [N] int64, increasing, after ``start_us`` [us].
            poses: [N, 3] x, y [m], yaw [rad] in the world.
            wheelbase: of the vehicle [m].
        """
        given = np.asarray(poses, dtype=np.float64)
        seconds: Float = (np.asarray(times_us, dtype=np.int64) - start_us) * np.float64(1e-6)
        tangents = _tangents(seconds, given, motion)
        own = motion.speed * math.cos(motion.yaw), motion.speed * math.sin(motion.yaw)
        self.start_us = start_us
        self.end = float(seconds[-1])
        self._wheelbase = wheelbase
        self._times: list[float] = [0.0, *seconds.tolist()]
        self._x: list[float] = [motion.x, *given[:, 0].tolist()]
        self._y: list[float] = [motion.y, *given[:, 1].tolist()]
        self._vx: list[float] = [own[0], *tangents[:, 0].tolist()]
        self._vy: list[float] = [own[1], *tangents[:, 1].tolist()]
        last_yaw = float(given[-1, 2])
        self._last_direction = math.cos(last_yaw), math.sin(last_yaw)

    def at(self, t: float) -> tuple[float, float, float, float]:
        """x, y [m] and velocity x, y [m/s] ``t`` seconds after the start of the plan."""
        after = bisect_right(self._times, t)
        if after == len(self._times):
            x, y, vx, vy = self._x[-1], self._y[-1], self._vx[-1], self._vy[-1]
            return x + vx * (t - self.end), y + vy * (t - self.end), vx, vy
        i, j = after - 1, after
        h, since = self._times[j] - self._times[i], t - self._times[i]
        x, vx = _hermite((self._x[i], self._vx[i]), (self._x[j], self._vx[j]), h, since)
        y, vy = _hermite((self._y[i], self._vy[i]), (self._y[j], self._vy[j]), h, since)
        return x, y, vx, vy

    def steer(self, motion: Motion, t: float) -> Command:
        """What to do in ``motion`` at ``t`` seconds after the start of the plan.

        Steering is pure pursuit (Coulter 1992): the arc that ends at the aim. Acceleration brings
        the vehicle to where the plan is after the look-ahead time, s = v T + a T^2 / 2.
        """
        cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
        if t >= self.end:
            aim_x, aim_y = self._aim_after_end(motion)
            ahead, left = _in_vehicle(aim_x - motion.x, aim_y - motion.y, cos, sin)
            return Command(-GENTLE_BRAKING, self._steering(ahead, left))
        x, y, vx, vy = self.at(t + LOOKAHEAD)
        ahead, left = _in_vehicle(x - motion.x, y - motion.y, cos, sin)
        planned = math.copysign(math.hypot(vx, vy), vx * cos + vy * sin)
        lag = _arc_length(ahead, left) - planned * LOOKAHEAD
        lag = min(max(lag, -MAX_LAG), MAX_LAG)
        acceleration = 2 * (lag / LOOKAHEAD + planned - motion.speed) / LOOKAHEAD
        if math.hypot(ahead, left) < MIN_AIM:
            aim_x, aim_y = self._farther_aim(motion, t + LOOKAHEAD)
            ahead, left = _in_vehicle(aim_x - motion.x, aim_y - motion.y, cos, sin)
        return Command(acceleration, self._steering(ahead, left))

    def _steering(self, ahead: float, left: float) -> float:
        return math.atan(self._wheelbase * 2 * left / (ahead * ahead + left * left))

    def _farther_aim(self, motion: Motion, t: float) -> tuple[float, float]:
        """The first place of the plan after ``t`` that is far enough, or one beyond its end."""
        for _ in range(AIM_TRIES):
            t += LOOKAHEAD
            x, y, _, _ = self.at(min(t, self.end))
            if math.hypot(x - motion.x, y - motion.y) >= MIN_AIM:
                return x, y
            if t >= self.end:
                return self._aim_after_end(motion)
        along_x, along_y = math.cos(motion.yaw), math.sin(motion.yaw)
        return x + MIN_AIM * along_x, y + MIN_AIM * along_y

    def _aim_after_end(self, motion: Motion) -> tuple[float, float]:
        """A place ahead on the straight line that leaves the last pose along its heading."""
        dx, dy = self._last_direction
        x, y = self._x[-1], self._y[-1]
        along = max((motion.x - x) * dx + (motion.y - y) * dy, 0.0)
        reach = along + max(MIN_AIM, motion.speed * LOOKAHEAD)
        return x + reach * dx, y + reach * dy


def to_world(poses: ArrayLike, motion: Motion) -> NDArray[np.float64]:
    """Poses [N, 3] x, y, yaw of the vehicle frame in the world."""
    local = np.asarray(poses, dtype=np.float64)
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    x = motion.x + cos * local[:, 0] - sin * local[:, 1]
    y = motion.y + sin * local[:, 0] + cos * local[:, 1]
    return np.stack([x, y, motion.yaw + local[:, 2]], axis=1)


def _tangents(seconds: Float, poses: Float, motion: Motion) -> Float:
    """Velocities [N, 2] [m/s] at the plan's poses."""
    if len(seconds) == 1:
        # A single pose says nothing but how to get there from here.
        velocity = (poses[:, :2] - [motion.x, motion.y]) / seconds[0]
    else:
        velocity = _slopes(seconds, poses[:, :2])
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    headings = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    along = np.sum(velocity * headings, axis=1)
    trusted = (speed > MOVING) & (along > math.cos(TRUSTED_YAW) * speed)
    tangents: Float = np.where(trusted[:, None], speed[:, None] * headings, velocity)
    return tangents


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


def _in_vehicle(dx: float, dy: float, cos: float, sin: float) -> tuple[float, float]:
    return cos * dx + sin * dy, cos * dy - sin * dx


def _arc_length(ahead: float, left: float) -> float:
    """Length of the arc that starts along x and ends at (ahead, left); negative when behind."""
    if ahead <= 0:
        return ahead
    angle = math.atan2(left, ahead)
    stretch = angle / math.sin(angle) if abs(angle) > 1e-4 else 1.0 + angle * angle / 6
    return math.hypot(ahead, left) * stretch
