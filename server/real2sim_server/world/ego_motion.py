"""Motion of the controlled vehicle: a planar bicycle model at the rear axle, and suspension."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np

from real2sim_proto.episode import EgoSpec, SuspensionSpec

from ..geometry import quaternion_yaw
from ..scene import Trajectory
from .common import cache_by_identity
from .driving import (
    GRAVITY,
    HOLD,
    NO_SCHEDULE,
    PLANNING_AHEAD,
    Command,
    PlanarState,
    VehicleParameters,
    advance_vehicle,
    driver_command,
    prepare_schedule,
    vehicle_parameters,
    wheel_load,
)
from .path import Float

SLOW = 0.1
"""Minimum speed at which the steering angle can be derived from the motion [m/s]."""

Schedules = tuple[Float, Float, Float, Float]
"""See :func:`..driving.prepare_schedule`."""

NO_PLAN = np.empty((0, 6))
NOTHING_PENDING = np.empty((0, 2))


class Motion(NamedTuple):
    """Planar state of the vehicle: a :class:`..driving.PlanarState`, and delayed commands.

    Attributes:
        pending: delayed commands, newest first, one per 10 ms of delay.
        reversing: whether the reverse gear is engaged, see :mod:`.plan`.
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
        """Velocity of the rear axle, world frame [m/s]."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return (
            self.speed * cos - self.lateral_speed * sin,
            self.speed * sin + self.lateral_speed * cos,
        )

    @property
    def numbers(self) -> tuple[float, ...]:
        """The state in the form of :mod:`..driving`, without pending commands and gear."""
        x, y, yaw, speed, acceleration, steering, yaw_rate, lateral_speed, drive, _, _ = self
        kinematic = (float(x), float(y), float(yaw), float(speed), float(acceleration))
        return (*kinematic, float(steering), float(yaw_rate), float(lateral_speed), float(drive))


class ControlLaw(NamedTuple):
    """Source of vehicle commands, see :func:`..driving.advance_vehicle`.

    Attributes:
        kind: HOLD, PURSUIT, LQR or ILQR.
        knots, turn_rate: plan of a tracker.
        hold: command of HOLD.
    """

    kind: int
    knots: Float = NO_PLAN
    turn_rate: float = 0.0
    hold: tuple[float, float] = (0.0, 0.0)

    def arguments(
        self, since: float, schedule: Schedules = NO_SCHEDULE
    ) -> tuple[int, Float, float, float, tuple[float, float], Schedules]:
        """The law in the form of :mod:`..driving`, ``since`` seconds after the plan's start."""
        return self.kind, self.knots, self.turn_rate, since, self.hold, schedule


def constant_law(command: Command) -> ControlLaw:
    """A law with a constant command."""
    return ControlLaw(HOLD, hold=(float(command.acceleration), float(command.steering)))


def advance_motion(
    motion: Motion, law: ControlLaw, spec: EgoSpec, dt_us: int, *, since: float = 0.0
) -> Motion:
    """The vehicle ``dt_us`` later, see :func:`..driving.advance_vehicle`.

    Args:
        motion: current motion.
        law: source of commands.
        spec: vehicle specification.
        dt_us: duration [us].
        since: time since the start of the law's plan [s].
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
    """The command of the law, ``since`` seconds after its plan's start."""
    return Command(
        *driver_command(motion.numbers, law.arguments(since), tuple(vehicle_parameters(spec)))
    )


def teleported(
    motion: Motion, pose: tuple[float, float, float], spec: EgoSpec, dt_us: int
) -> Motion:
    """The vehicle moved to ``pose`` x, y [m], yaw [rad], with velocities from the displacement.

    The path is an arc that ends in the new heading, so that poses along a circle have the speed
    along the circle.
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


# --- Suspension ----------------------------------------------------------------------------------

# Load transfer compresses the springs; the body follows as a damped oscillator and moves the
# cameras. Dynamics and contact ignore it: tyre loads change instantly, and boxes stay level. At
# constant velocity the body settles level.
#
# Axes are those of the vehicle: pitch about y, positive nose down; roll about x, positive right.


class BodyAttitude(NamedTuple):
    """Pitch and roll relative to the ground [rad], and their rates [rad/s]."""

    pitch: float = 0.0
    pitch_rate: float = 0.0
    roll: float = 0.0
    roll_rate: float = 0.0


LEVEL = BodyAttitude()

SPEED, ACCELERATION, TURN = (
    PlanarState._fields.index(name) for name in ("speed", "acceleration", "yaw_rate")
)

Value = TypeVar("Value", float, Float)


class Suspension(NamedTuple):
    """Suspension parameters.

    Attributes:
        vehicle: vehicle parameters.
        pitch, roll: angle per load transferred to the front axle, or to the left side [rad/N].
        pitch_frequency, roll_frequency: undamped natural frequencies [rad/s].
        damping: damping ratio.
        track: distance between left and right wheels [m].
        lift: vertical motion of the body at the rear axle per pitch angle [m/rad].
    """

    vehicle: VehicleParameters
    pitch: float
    roll: float
    pitch_frequency: float
    roll_frequency: float
    damping: float
    track: float
    lift: float


def sprung(
    attitude: BodyAttitude, before: Motion, after: Motion, seconds: float, ego: EgoSpec
) -> BodyAttitude:
    """The attitude ``seconds`` later, at the end of a step.

    Accelerations are limited to the tyre friction, so impacts do not tilt the body. A body without
    suspension or placed by poses is level.

    Args:
        attitude: attitude before the step.
        before, after: vehicle motion; the acceleration of ``after`` is the mean over the step.
        seconds: duration of the step.
        ego: ego options of the episode.
    """
    if ego.suspension is None or ego.tracker == "perfect":
        return LEVEL
    springs = suspension_of(ego)
    vehicle = springs.vehicle
    most = vehicle.friction * GRAVITY
    along = min(max(after.acceleration, -most), most)
    sideways = (before.speed * before.yaw_rate + after.speed * after.yaw_rate) / 2
    left = min(max(sideways, -most), most)
    half = springs.track / 2
    to_front = _transfer(vehicle, vehicle.wheelbase, vehicle.rear, along)
    to_left = _transfer(vehicle, springs.track, half, left)
    pitch = _oscillated(
        attitude.pitch, attitude.pitch_rate, springs.pitch * to_front, seconds,
        (springs.pitch_frequency, springs.damping),
    )  # fmt: skip
    # A body rolls away from the unloaded side.
    roll = _oscillated(
        attitude.roll, attitude.roll_rate, -springs.roll * to_left, seconds,
        (springs.roll_frequency, springs.damping),
    )  # fmt: skip
    return BodyAttitude(*pitch, *roll)


def sprung_side_by_side(
    attitudes: Float, before: Float, after: Float, seconds: float, ego: EgoSpec
) -> Float:
    """:func:`sprung` for many vehicles, with bitwise equal results.

    Args:
        attitudes: [W, 4] float64, one :class:`BodyAttitude` per row.
        before, after: [W, 9] float64, one ``driving.PlanarState`` per row.
        seconds: duration of the step.
        ego: options of a vehicle with suspension that is not placed by poses.
    """
    springs = suspension_of(ego)
    vehicle, mass, height = springs.vehicle, springs.vehicle.mass, springs.vehicle.height

    def transfer(base: float, arm: float, acceleration: Float) -> Float:
        load: Float = np.maximum(mass * (GRAVITY * arm - acceleration * height) / base, 0.0)
        return load - wheel_load(mass, height, base, arm, 0.0)

    most = vehicle.friction * GRAVITY
    along = np.minimum(np.maximum(after[:, ACCELERATION], -most), most)
    sideways = (before[:, SPEED] * before[:, TURN] + after[:, SPEED] * after[:, TURN]) / 2
    left = np.minimum(np.maximum(sideways, -most), most)
    to_front = transfer(vehicle.wheelbase, vehicle.rear, along)
    to_left = transfer(springs.track, springs.track / 2, left)
    pitch = _oscillated(
        attitudes[:, 0], attitudes[:, 1], springs.pitch * to_front, seconds,
        (springs.pitch_frequency, springs.damping),
    )  # fmt: skip
    roll = _oscillated(
        attitudes[:, 2], attitudes[:, 3], -springs.roll * to_left, seconds,
        (springs.roll_frequency, springs.damping),
    )  # fmt: skip
    return np.stack([*pitch, *roll], axis=1)


def tilted(T_world_vehicle: Float, attitude: BodyAttitude, ego: EgoSpec) -> Float:
    """``T_world_body`` [4, 4] of the sprung body of a vehicle that is level on the ground."""
    if attitude == LEVEL or ego.suspension is None:
        return T_world_vehicle
    cos_p, sin_p = math.cos(attitude.pitch), math.sin(attitude.pitch)
    cos_r, sin_r = math.cos(attitude.roll), math.sin(attitude.roll)
    # A flat tuple is twice as fast as nested lists.
    T_vehicle_body = np.array(
        (
            *(cos_p, sin_p * sin_r, sin_p * cos_r, 0.0),
            *(0.0, cos_r, -sin_r, 0.0),
            *(-sin_p, cos_p * sin_r, cos_p * cos_r, suspension_of(ego).lift * attitude.pitch),
            *(0.0, 0.0, 0.0, 1.0),
        )
    ).reshape(4, 4)
    T_world_body: Float = T_world_vehicle @ T_vehicle_body
    return T_world_body


@cache_by_identity
@lru_cache(maxsize=256)
def suspension_of(ego: EgoSpec) -> Suspension:
    """The suspension of a vehicle; the spec must have one."""
    spec, vehicle = ego.suspension, vehicle_parameters(ego)
    assert spec is not None
    length = vehicle.wheelbase
    front, rear = (2 * math.pi * f for f in (spec.front_frequency, spec.rear_frequency))
    # Springs carry the mass at their axle at its ride frequency: k = m w^2.
    at_front, at_rear = vehicle.mass * vehicle.rear / length, vehicle.mass * vehicle.front / length
    soft_front, soft_rear = 1 / (at_front * front**2), 1 / (at_rear * rear**2)
    # Masses at the wheels: inertias m a b in pitch and m (track / 2)^2 in roll.
    pitch_frequency = math.sqrt((vehicle.front * front**2 + vehicle.rear * rear**2) / length)
    stiffness = at_front * front**2 + at_rear * rear**2
    roll_frequency = math.sqrt(stiffness / vehicle.mass / (1 - spec.roll_resistance))
    return Suspension(
        vehicle=vehicle,
        pitch=(1 - spec.pitch_resistance) * (soft_front + soft_rear) / length,
        roll=_roll_per_load(spec, stiffness),
        pitch_frequency=pitch_frequency,
        roll_frequency=roll_frequency,
        damping=spec.damping,
        track=spec.track,
        lift=length * soft_rear / (soft_front + soft_rear),
    )


def _roll_per_load(spec: SuspensionSpec, stiffness: float) -> float:
    """Roll angle per load: each side has half of the springs and moves by its load change."""
    return (1 - spec.roll_resistance) * 2 / (stiffness / 2) / spec.track


def _transfer(vehicle: VehicleParameters, base: float, arm: float, acceleration: float) -> float:
    """Load change [N] at one end of a base as the vehicle accelerates towards it."""
    mass, height = vehicle.mass, vehicle.height
    return wheel_load(mass, height, base, arm, acceleration) - wheel_load(
        mass, height, base, arm, 0.0
    )


def _oscillated(
    value: Value, rate: Value, rest: Value, seconds: float, oscillator: tuple[float, float]
) -> tuple[Value, Value]:
    """Value and rate of a damped oscillator ``seconds`` later; exact for any step length.

    Takes its frequency [rad/s], damping ratio below 1, and equilibrium ``rest``.
    """
    frequency, damping = oscillator
    decay, swing = damping * frequency, frequency * math.sqrt(1 - damping * damping)
    cos, sin = math.cos(swing * seconds), math.sin(swing * seconds)
    fade, away = math.exp(-decay * seconds), value - rest
    return (
        rest + fade * (away * cos + (rate + decay * away) / swing * sin),
        fade * (rate * cos - (decay * rate + frequency**2 * away) / swing * sin),
    )
