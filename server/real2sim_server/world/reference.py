"""A planned trajectory as a smooth curve over time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

from real2sim_proto.episode import EgoSpec

from .ego import Motion

Pose = tuple[float, float, float]
"""x, y [m], yaw [rad] in the world."""

Vector = tuple[float, float]

MOVING = 0.5
"""Below this speed the direction between plan poses is mostly noise [m/s]."""

DENSE = 0.25
"""Plans that begin within this time say where they come from, too [s]."""

TRUSTED_YAW = 0.5
"""A planned heading that differs more from the planned way is not used as its tangent [rad]."""


class Reference:
    """Cubic Hermite curve through the vehicle's pose when it got the plan, and the plan's poses.

    Tangents are finite differences of the plan, turned into the planned headings. After its last
    pose the curve goes on with its last speed and turn rate, so that there is something to aim at.

    Plain floats and tangents only where they are needed: of a plan of many poses, the next plan
    replaces all but the first few before anybody asks for them.

    Attributes:
        start_us: when the vehicle got the plan [us].
        end: time of the last pose, from ``start_us`` [s].
        last_pose: x, y [m], yaw [rad] in the world.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        start_us: int,
        times_us: Sequence[int],
        poses: Sequence[Pose],
        spec: EgoSpec,
    ) -> None:
        """The plan of a vehicle that is in ``motion`` at ``start_us``.

        Args:
            motion: of the vehicle.
            start_us: now [us].
            times_us: N of them, increasing, after ``start_us`` [us].
            poses: N of them.
            spec: limits of the vehicle.
        """
        self.start_us = start_us
        self._times = [0.0, *((t - start_us) * 1e-6 for t in times_us)]
        self._poses: list[Pose] = [(motion.x, motion.y, motion.yaw), *poses]
        self.end = self._times[-1]
        self.last_pose = self._poses[-1]
        own = motion.speed * math.cos(motion.yaw), motion.speed * math.sin(motion.yaw)
        self._tangents: dict[int, Vector] = {0: own}
        if len(poses) == 1:
            arrival = _arrival(motion, poses[0], self.end, spec)
            self._tangents[1] = _along_heading(arrival, poses[0][2])
        self._turn_rate = self._last_turn_rate(motion, spec)

    def at(self, t: float) -> tuple[float, float, float, float]:
        """x, y [m] and velocity x, y [m/s] in the world, ``t`` >= 0 seconds after the start."""
        j = bisect_right(self._times, t)
        if j == len(self._times):
            return self._beyond(t - self.end)
        i = j - 1
        (ax, ay, _), (avx, avy) = self._poses[i], self._tangent(i)
        (bx, by, _), (bvx, bvy) = self._poses[j], self._tangent(j)
        h, since = self._times[j] - self._times[i], t - self._times[i]
        x, vx = _hermite((ax, avx), (bx, bvx), h, since)
        y, vy = _hermite((ay, avy), (by, bvy), h, since)
        return x, y, vx, vy

    def planned(self, t: float) -> tuple[float, float, float, float]:
        """Like :meth:`at`, but where the plan itself would be before its first pose: on the arc
        that leads there. The vehicle's distance from it is its error, which :meth:`at` hides.

        A plan that begins late says nothing about the way to it; there the two are the same.
        """
        first = self._times[1]
        if t >= first or first > DENSE:
            return self.at(t)
        rate = self._turn_rate
        if len(self._poses) > 2:
            span = self._times[2] - first
            rate = math.remainder(self._poses[2][2] - self._poses[1][2], math.tau) / span
        return _along_arc(self._poses[1], self._tangent(1), rate, t - first)

    def heading(self, t: float) -> float:
        """Planned heading [rad] at the first pose not before ``t``, or at the last one."""
        return self._poses[min(bisect_left(self._times, t), len(self._poses) - 1)][2]

    def _beyond(self, since: float) -> tuple[float, float, float, float]:
        tangent = self._tangent(len(self._poses) - 1)
        return _along_arc(self.last_pose, tangent, self._turn_rate, since)

    def _tangent(self, i: int) -> Vector:
        """Velocity [m/s] at a pose: the slope there of the parabola through three neighbours.

        The vehicle's own pose is no neighbour: where it is off the plan, its way onto it says
        nothing about the plan's speed.
        """
        if i not in self._tangents:
            last = len(self._poses) - 1
            if last == 2:
                slope = self._chord(1)
            elif i == 1:
                slope = _far_slope(self._chord(1), self._mean_slope(2))
            elif i == last:
                slope = _far_slope(self._chord(last - 1), self._mean_slope(last - 1))
            else:
                slope = self._mean_slope(i)
            self._tangents[i] = _along_heading(slope, self._poses[i][2])
        return self._tangents[i]

    def _chord(self, i: int) -> Vector:
        """Mean velocity [m/s] from pose ``i`` to the next."""
        (ax, ay, _), (bx, by, _) = self._poses[i], self._poses[i + 1]
        h = self._times[i + 1] - self._times[i]
        return (bx - ax) / h, (by - ay) / h

    def _mean_slope(self, i: int) -> Vector:
        """Velocity [m/s] at pose ``i`` of the parabola through it and its two neighbours."""
        (ax, ay), (bx, by) = self._chord(i - 1), self._chord(i)
        before, after = self._times[i] - self._times[i - 1], self._times[i + 1] - self._times[i]
        share = before / (before + after)
        return ax + share * (bx - ax), ay + share * (by - ay)

    def _last_turn_rate(self, motion: Motion, spec: EgoSpec) -> float:
        """Turn rate [rad/s] at the last pose, as far as the vehicle can turn."""
        h = self._times[-1] - self._times[-2]
        rate = math.remainder(self._poses[-1][2] - self._poses[-2][2], math.tau) / h
        if len(self._poses) == 2:
            reach = abs(motion.speed) / spec.wheelbase * spec.max_steer_rate * h
            rate = min(max(rate, motion.yaw_rate - reach), motion.yaw_rate + reach)
        speed = math.hypot(*self._tangent(len(self._poses) - 1))
        most = speed * math.tan(spec.max_steer) / spec.wheelbase
        return min(max(rate, -most), most)


def _along_arc(
    pose: Pose, velocity: Vector, rate: float, since: float
) -> tuple[float, float, float, float]:
    """Place and velocity on an arc, ``since`` seconds after a pose; before it where negative."""
    (x, y, _), (vx, vy) = pose, velocity
    half = rate * since / 2
    cos, sin = math.cos(half), math.sin(half)
    chord = since * (sin / half if abs(half) > 1e-6 else 1.0)
    x, y = x + chord * (cos * vx - sin * vy), y + chord * (sin * vx + cos * vy)
    cos, sin = math.cos(2 * half), math.sin(2 * half)
    return x, y, cos * vx - sin * vy, sin * vx + cos * vy


def _far_slope(chord: Vector, slope: Vector) -> Vector:
    """Slope at the far end of a parabola's chord, from that at its near end."""
    return 2 * chord[0] - slope[0], 2 * chord[1] - slope[1]


def _along_heading(velocity: Vector, yaw: float) -> Vector:
    """The velocity turned into the planned heading, where that is roughly where it goes."""
    speed = math.hypot(*velocity)
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = velocity[0] * cos + velocity[1] * sin
    if speed > MOVING and along > math.cos(TRUSTED_YAW) * speed:
        return speed * cos, speed * sin
    return velocity


def _arrival(motion: Motion, pose: Pose, seconds: float, spec: EgoSpec) -> Vector:
    """Velocity [m/s] at a single planned pose: that of the way there, as far as in reach.

    Without the limit a few centimetres over a short step would count as metres per second.
    """
    dx, dy = pose[0] - motion.x, pose[1] - motion.y
    length = math.hypot(dx, dy)
    change = length / seconds - motion.speed
    change = min(max(change, -spec.max_braking * seconds), spec.max_acceleration * seconds)
    share = max(motion.speed + change, 0.0) / max(length, 1e-9)
    return dx * share, dy * share


def _hermite(start: Vector, end: Vector, h: float, t: float) -> Vector:
    """Value and slope at ``t`` in [0, h] of the cubic with these values and slopes at its ends."""
    (a, a_slope), (b, b_slope) = start, end
    u = t / h
    chord = (b - a) / h
    c2 = 3 * chord - 2 * a_slope - b_slope
    c3 = a_slope + b_slope - 2 * chord
    return a + t * (a_slope + u * (c2 + u * c3)), a_slope + u * (2 * c2 + 3 * u * c3)
