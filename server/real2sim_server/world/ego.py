"""The controlled vehicle: a bicycle on the plane, referred to its rear axle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from real2sim_proto.episode import EgoSpec

from ..scene import Trajectory
from ..scene.rotation import quaternion_yaw
from . import dynamic
from .actuators import Command, at_wheels
from .vehicle import GRAVITY, vehicle_of

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
        lateral_speed: of the rear axle, positive to the left; 0 while its wheels roll [m/s].
        drive: acceleration that engine or brakes bring about now [m/s^2].
        pending: commands on their way to the wheels, newest first; one for each 10 ms of delay.
    """

    x: float
    y: float
    yaw: float
    speed: float = 0.0
    acceleration: float = 0.0
    steering: float = 0.0
    yaw_rate: float = 0.0
    lateral_speed: float = 0.0
    drive: float = 0.0
    pending: tuple[Command, ...] = ()

    @property
    def velocity(self) -> tuple[float, float]:
        """Of the rear axle in the world [m/s]."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return (
            self.speed * cos - self.lateral_speed * sin,
            self.speed * sin + self.lateral_speed * cos,
        )


Driver = Callable[[Motion, float], Command]
"""What to do in a motion, so many seconds after the start of the step."""


def drive(motion: Motion, driver: Driver, spec: EgoSpec, dt_us: int) -> Motion:
    """The vehicle ``dt_us`` later, in equal substeps of 10 ms at most.

    Within a substep the steering angle moves at most at its rate limit. The kinematic bicycle
    follows the arc of its mean exactly; speed changes linearly until it meets 0 or the greatest
    speed. The dynamic bicycle does the same at walking pace and slips on its tyres above, see
    :mod:`.dynamic`. Braking never ends in reversing.
    """
    substeps = -(-dt_us // SUBSTEP_US)
    h = dt_us * 1e-6 / substeps
    model = _roll if spec.dynamics == "kinematic_bicycle" else _slip
    start = motion
    for k in range(substeps):
        asked = driver(motion, k * h)
        now = Command(motion.drive, motion.steering)
        command, pending = at_wheels(asked, motion.pending, now, spec, h)
        motion = model(motion, command, spec, h)
        if pending:
            motion = motion._replace(pending=pending)
    acceleration = (motion.speed - start.speed) / (dt_us * 1e-6)
    return motion._replace(acceleration=acceleration)


def _roll(motion: Motion, command: Command, spec: EgoSpec, h: float) -> Motion:
    """Kinematic bicycle: wheels go where they point."""
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
        drive=command.acceleration,
    )


def _slip(motion: Motion, command: Command, spec: EgoSpec, h: float) -> Motion:
    """Dynamic bicycle; fades into the kinematic one where it is slow."""
    vehicle = vehicle_of(spec)
    most = vehicle.friction * GRAVITY
    limited = command._replace(acceleration=min(max(command.acceleration, -most), most))
    rolled = _roll(motion, limited, spec, h)._replace(drive=command.acceleration)
    share = dynamic.tyre_share(min(motion.speed, rolled.speed))
    if share == 0.0:
        return rolled
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    centre = (
        motion.x + vehicle.rear * cos,
        motion.y + vehicle.rear * sin,
        motion.yaw,
        motion.speed,
        motion.lateral_speed + vehicle.rear * motion.yaw_rate,
        motion.yaw_rate,
    )
    acceleration = (rolled.speed - motion.speed) / h
    steering = (motion.steering, rolled.steering)
    x, y, yaw, vx, vy, turn = dynamic.integrate(vehicle, centre, steering, acceleration, h)
    rest = 1 - share
    slipped = Motion(
        x=x - vehicle.rear * math.cos(yaw),
        y=y - vehicle.rear * math.sin(yaw),
        yaw=yaw,
        speed=max(vx, 0.0),
        steering=rolled.steering,
        yaw_rate=share * turn + rest * rolled.yaw_rate,
        lateral_speed=share * (vy - vehicle.rear * turn),
        drive=command.acceleration,
    )
    if rest == 0.0:
        return slipped
    return slipped._replace(
        x=share * slipped.x + rest * rolled.x,
        y=share * slipped.y + rest * rolled.y,
        yaw=share * slipped.yaw + rest * rolled.yaw,
        speed=share * slipped.speed + rest * rolled.speed,
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
