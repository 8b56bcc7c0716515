"""The controlled vehicle: a kinematic bicycle on the plane, referred to its rear axle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from real2sim_proto.drive import EgoSpec

from ..scene import Trajectory
from ..scene.rotation import quaternion_yaw

SUBSTEP_US = 10_000
SLOW = 0.1
"""Below this speed the steering angle cannot be told from the motion [m/s]."""


class Motion(NamedTuple):
    """Planar state of the vehicle.

    Attributes:
        x, y: rear axle centre, world [m].
        yaw: heading [rad], not wrapped.
        speed: along the heading [m/s].
        acceleration: along the heading, mean over the last step [m/s^2].
        steering: road-wheel angle, positive to the left [rad].
        yaw_rate: [rad/s].
    """

    x: float
    y: float
    yaw: float
    speed: float = 0.0
    acceleration: float = 0.0
    steering: float = 0.0
    yaw_rate: float = 0.0


class Command(NamedTuple):
    """What the driver asks for: acceleration [m/s^2] and road-wheel angle [rad]."""

    acceleration: float
    steering: float


Driver = Callable[[Motion, float], Command]
"""What to do in a motion, so many seconds after the start of the step."""


def drive(motion: Motion, driver: Driver, spec: EgoSpec, dt_us: int) -> Motion:
    """The vehicle ``dt_us`` later, in equal substeps of 10 ms at most.

    Within a substep the steering angle moves at most at its rate limit and the arc of its mean is
    followed exactly; speed changes linearly until it meets 0 or the greatest speed. Braking never
    ends in reversing.
    """
    substeps = -(-dt_us // SUBSTEP_US)
    h = dt_us * 1e-6 / substeps
    start = motion
    for k in range(substeps):
        motion = _substep(motion, driver(motion, k * h), spec, h)
    acceleration = (motion.speed - start.speed) / (dt_us * 1e-6)
    return motion._replace(acceleration=acceleration)


def _substep(motion: Motion, command: Command, spec: EgoSpec, h: float) -> Motion:
    steering = _steered(motion.steering, command.steering, spec, h)
    speed, distance = _sped_up(motion.speed, command.acceleration, spec, h)
    curvature = math.tan((motion.steering + steering) / 2) / spec.wheelbase
    turn = distance * curvature
    chord = distance * _sinc(turn / 2)
    heading = motion.yaw + turn / 2
    return Motion(
        x=motion.x + chord * math.cos(heading),
        y=motion.y + chord * math.sin(heading),
        yaw=motion.yaw + turn,
        speed=speed,
        steering=steering,
        yaw_rate=speed * math.tan(steering) / spec.wheelbase,
    )


def _steered(steering: float, wanted: float, spec: EgoSpec, h: float) -> float:
    wanted = min(max(wanted, -spec.max_steer), spec.max_steer)
    most = spec.max_steer_rate * h
    return steering + min(max(wanted - steering, -most), most)


def _sped_up(speed: float, wanted: float, spec: EgoSpec, h: float) -> tuple[float, float]:
    """Speed after ``h`` seconds and distance covered; linear in time until a limit is met."""
    acceleration = min(max(wanted, -spec.max_braking), spec.max_acceleration)
    limit = max(spec.max_speed, speed) if acceleration > 0 else min(0.0, speed)
    if acceleration == 0.0:
        return speed, speed * h
    until_limit = (limit - speed) / acceleration
    if until_limit >= h:
        end = speed + acceleration * h
        return end, (speed + end) / 2 * h
    return limit, (speed + limit) / 2 * until_limit + limit * (h - until_limit)


def placed(motion: Motion, pose: tuple[float, float, float], spec: EgoSpec, dt_us: int) -> Motion:
    """The vehicle put to ``pose`` x, y [m], yaw [rad]; its velocities follow from the way there.

    The way is taken as the arc that ends with the new heading, so that a pose sequence along a
    circle has the speed along the circle.
    """
    x, y, yaw = pose
    seconds = dt_us * 1e-6
    turn = math.remainder(yaw - motion.yaw, math.tau)
    middle = motion.yaw + turn / 2
    chord = (x - motion.x) * math.cos(middle) + (y - motion.y) * math.sin(middle)
    speed = chord / _sinc(turn / 2) / seconds
    return Motion(
        x=x,
        y=y,
        yaw=motion.yaw + turn,
        speed=speed,
        acceleration=(speed - motion.speed) / seconds,
        steering=_steering_of(speed, turn / seconds, spec),
        yaw_rate=turn / seconds,
    )


def logged_motion(ego: Trajectory, t_us: int, spec: EgoSpec) -> Motion:
    """The recorded vehicle at ``t_us``, with the speed and turn rate of its logged segment.

    Raises:
        TimeOutOfRangeError: outside the log.
    """
    position, quaternion = ego.pose(t_us)
    yaw = float(quaternion_yaw(quaternion))
    velocity = ego.velocity(t_us)
    speed = float(velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw))
    yaw_rate = _logged_yaw_rate(ego, t_us)
    return Motion(
        x=float(position[0]),
        y=float(position[1]),
        yaw=yaw,
        speed=speed,
        steering=_steering_of(speed, yaw_rate, spec),
        yaw_rate=yaw_rate,
    )


def _logged_yaw_rate(ego: Trajectory, t_us: int) -> float:
    if len(ego.times_us) == 1:
        return 0.0
    after = int(np.searchsorted(ego.times_us, t_us, side="right"))
    after = min(max(after, 1), len(ego.times_us) - 1)
    before_yaw, after_yaw = quaternion_yaw(ego.quaternions[after - 1 : after + 1]).tolist()
    seconds = int(ego.times_us[after] - ego.times_us[after - 1]) * 1e-6
    return math.remainder(after_yaw - before_yaw, math.tau) / seconds


def _steering_of(speed: float, yaw_rate: float, spec: EgoSpec) -> float:
    if abs(speed) < SLOW:
        return 0.0
    angle = math.atan(spec.wheelbase * yaw_rate / speed)
    return min(max(angle, -spec.max_steer), spec.max_steer)


def _sinc(angle: float) -> float:
    """sin(angle) / angle, by its series near 0 where the quotient loses its digits."""
    if abs(angle) < 1e-4:
        return 1.0 - angle * angle / 6.0
    return math.sin(angle) / angle
