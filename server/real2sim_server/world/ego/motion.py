"""The controlled vehicle: a bicycle on the plane, referred to its rear axle."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from real2sim_proto.episode import EgoSpec

from ...geometry.rotation import quaternion_yaw
from ...scene import Trajectory
from ..driving import (
    HOLD,
    NO_SCHEDULE,
    PLANNING_AHEAD,
    Command,
    advance_vehicle,
    driver_command,
    prepare_schedule,
    vehicle_parameters,
)
from ..path import Float

SLOW = 0.1
"""Below this speed the steering angle cannot be derived from the motion [m/s]."""

Schedules = tuple[Float, Float, Float, Float]
"""See :func:`.driving.prepare_schedule`."""

NO_PLAN = np.empty((0, 6))
NOTHING_PENDING = np.empty((0, 2))


class Motion(NamedTuple):
    """Planar state of the vehicle: a :class:`.driving.PlanarState`, and delayed commands.

    Attributes:
        pending: commands on their way to the wheels, newest first; one for each 10 ms of delay.
        reversing: whether the reverse gear is engaged, see :mod:`.gear`.
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
    reversing: bool = False

    @property
    def velocity(self) -> tuple[float, float]:
        """Of the rear axle in the world [m/s]."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return (
            self.speed * cos - self.lateral_speed * sin,
            self.speed * sin + self.lateral_speed * cos,
        )

    @property
    def numbers(self) -> tuple[float, ...]:
        """All but pending commands and gear, as :mod:`.driving` takes a state."""
        x, y, yaw, speed, acceleration, steering, yaw_rate, lateral_speed, drive, _, _ = self
        kinematic = (float(x), float(y), float(yaw), float(speed), float(acceleration))
        return (*kinematic, float(steering), float(yaw_rate), float(lateral_speed), float(drive))


class ControlLaw(NamedTuple):
    """Gives commands to the vehicle, see :func:`.driving.advance_vehicle`.

    Attributes:
        kind: HOLD, PURSUIT, LQR or ILQR.
        knots, turn_rate: the plan that trackers follow.
        hold: the command of HOLD.
    """

    kind: int
    knots: Float = NO_PLAN
    turn_rate: float = 0.0
    hold: tuple[float, float] = (0.0, 0.0)

    def arguments(
        self, since: float, schedule: Schedules = NO_SCHEDULE
    ) -> tuple[int, Float, float, float, tuple[float, float], Schedules]:
        """The law ``since`` seconds after its plan began, as :mod:`.driving` takes it."""
        return self.kind, self.knots, self.turn_rate, since, self.hold, schedule


def constant_law(command: Command) -> ControlLaw:
    """Gives the same command all the time."""
    return ControlLaw(HOLD, hold=(float(command.acceleration), float(command.steering)))


def advance_motion(
    motion: Motion, law: ControlLaw, spec: EgoSpec, dt_us: int, *, since: float = 0.0
) -> Motion:
    """The vehicle ``dt_us`` later, see :func:`.driving.advance_vehicle`.

    Args:
        motion: now.
        law: gives its commands.
        spec: of the vehicle.
        dt_us: how far to go [us].
        since: time since the law's plan began [s].
    """
    pending = np.array(motion.pending) if motion.pending else NOTHING_PENDING
    vehicle = tuple(vehicle_parameters(spec))
    numbers, arguments = motion.numbers, law.arguments(since)
    if law.kind in PLANNING_AHEAD:
        schedule = prepare_schedule(numbers, pending, arguments, vehicle, dt_us)
        arguments = law.arguments(since, schedule)
    state, waiting = advance_vehicle(numbers, pending, arguments, vehicle, dt_us)
    delayed = tuple(Command(*row) for row in waiting.tolist())
    return Motion._make((*state, delayed, False))


def commanded(motion: Motion, law: ControlLaw, spec: EgoSpec, *, since: float = 0.0) -> Command:
    """The command of the law, ``since`` seconds after its plan began."""
    return Command(
        *driver_command(motion.numbers, law.arguments(since), tuple(vehicle_parameters(spec)))
    )


def teleported(
    motion: Motion, pose: tuple[float, float, float], spec: EgoSpec, dt_us: int
) -> Motion:
    """The vehicle put to ``pose`` x, y [m], yaw [rad]; its velocities follow from the way there.

    The way is taken as the arc that ends with the new heading, so that a pose sequence along a
    circle has the speed along the circle.
    """
    x, y, yaw = pose
    seconds = dt_us * 1e-6
    turn = math.remainder(yaw - motion.yaw, math.tau)
    middle = motion.yaw + turn / 2
    chord = (x - motion.x) * math.cos(middle) + (y - motion.y) * math.sin(middle)
    speed = chord / float(np.sinc(turn / math.tau)) / seconds
    return Motion(
        x=x,
        y=y,
        yaw=motion.yaw + turn,
        speed=speed,
        acceleration=(speed - motion.speed) / seconds,
        steering=_steering_of(speed, turn / seconds, spec),
        yaw_rate=turn / seconds,
        reversing=speed < 0.0 and spec.max_reverse_speed > 0.0,
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
        reversing=speed < -SLOW and spec.max_reverse_speed > 0.0,
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
