"""Motion of the controlled vehicle: a bicycle on the plane at its rear axle, and its suspension."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np

from real2sim_proto.episode import EgoSpec, SuspensionSpec

from ...geometry.transform import quaternion_yaw
from ...scene import Trajectory
from ..common import cache_by_identity
from ..driving import (
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
from ..path import Float

SLOW = 0.1
"""Below this speed the steering angle cannot be derived from the motion [m/s]."""

Schedules = tuple[Float, Float, Float, Float]
"""See :func:`..driving.prepare_schedule`."""

NO_PLAN = np.empty((0, 6))
NOTHING_PENDING = np.empty((0, 2))


class Motion(NamedTuple):
    """Planar state of the vehicle: a :class:`..driving.PlanarState`, and delayed commands.

    Attributes:
        pending: commands on their way to the wheels, newest first; one for each 10 ms of delay.
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
        """Of the rear axle in the world [m/s]."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return (
            self.speed * cos - self.lateral_speed * sin,
            self.speed * sin + self.lateral_speed * cos,
        )

    @property
    def numbers(self) -> tuple[float, ...]:
        """All but pending commands and gear, as :mod:`..driving` takes a state."""
        x, y, yaw, speed, acceleration, steering, yaw_rate, lateral_speed, drive, _, _ = self
        kinematic = (float(x), float(y), float(yaw), float(speed), float(acceleration))
        return (*kinematic, float(steering), float(yaw_rate), float(lateral_speed), float(drive))


class ControlLaw(NamedTuple):
    """Gives commands to the vehicle, see :func:`..driving.advance_vehicle`.

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
        """The law ``since`` seconds after its plan began, as :mod:`..driving` takes it."""
        return self.kind, self.knots, self.turn_rate, since, self.hold, schedule


def constant_law(command: Command) -> ControlLaw:
    """Gives the same command all the time."""
    return ControlLaw(HOLD, hold=(float(command.acceleration), float(command.steering)))


def advance_motion(
    motion: Motion, law: ControlLaw, spec: EgoSpec, dt_us: int, *, since: float = 0.0
) -> Motion:
    """The vehicle ``dt_us`` later, see :func:`..driving.advance_vehicle`.

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


# --- Suspension ----------------------------------------------------------------------------------

# Load transfer between axles or sides compresses the springs; the body follows as a damped
# oscillator and moves the cameras. Dynamics and contact ignore it: tyres get the load transfer at
# once, and boxes in contact stay level. A body at constant velocity comes to rest level.
#
# The axes are the vehicle's: pitch is about y, positive nose down; roll is about x, positive to the
# right.


class BodyAttitude(NamedTuple):
    """Pitch and roll against the ground [rad], and their rates [rad/s]."""

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
    """Springs of a body.

    Attributes:
        vehicle: on its wheels.
        pitch, roll: angle per load that goes to the front axle, or to the left side [rad/N].
        pitch_frequency, roll_frequency: natural, undamped [rad/s].
        damping: of the critical one.
        track: between left and right wheels [m].
        lift: height of the rear axle's place in the body per pitch [m/rad].
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

    Tyres make the accelerations that tilt a body, so what is beyond their friction (an impact) does
    not count. A body without suspension, and one that is put somewhere by poses, is level.

    Args:
        attitude: before.
        before, after: motion of the vehicle; the acceleration of ``after`` is the step's mean.
        seconds: of the step.
        ego: of the episode.
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
    # A body rolls away from the side that is relieved.
    roll = _oscillated(
        attitude.roll, attitude.roll_rate, -springs.roll * to_left, seconds,
        (springs.roll_frequency, springs.damping),
    )  # fmt: skip
    return BodyAttitude(*pitch, *roll)


def sprung_side_by_side(
    attitudes: Float, before: Float, after: Float, seconds: float, ego: EgoSpec
) -> Float:
    """What :func:`sprung` does, to the bit, of many vehicles.

    Args:
        attitudes: [W, 4] float64, a :class:`BodyAttitude` a row.
        before, after: [W, 9] float64, a ``driving.PlanarState`` a row.
        seconds: of the step.
        ego: of a vehicle on springs that is steered.
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
    """``T_world_body`` [4, 4] of the body over a vehicle that stands level on the ground."""
    if attitude == LEVEL or ego.suspension is None:
        return T_world_vehicle
    cos_p, sin_p = math.cos(attitude.pitch), math.sin(attitude.pitch)
    cos_r, sin_r = math.cos(attitude.roll), math.sin(attitude.roll)
    # Of one flat tuple: nested lists take twice as long.
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
    """The springs of a vehicle that has some."""
    spec, vehicle = ego.suspension, vehicle_parameters(ego)
    assert spec is not None
    length = vehicle.wheelbase
    front, rear = (2 * math.pi * f for f in (spec.front_frequency, spec.rear_frequency))
    # Springs carry the mass at their axle with its ride frequency: k = m w^2.
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
    """Half of the springs is at each side, and each side moves by the load that it gets."""
    return (1 - spec.roll_resistance) * 2 / (stiffness / 2) / spec.track


def _transfer(vehicle: VehicleParameters, base: float, arm: float, acceleration: float) -> float:
    """Load [N] that goes towards an end of a base as the vehicle accelerates towards it."""
    mass, height = vehicle.mass, vehicle.height
    return wheel_load(mass, height, base, arm, acceleration) - wheel_load(
        mass, height, base, arm, 0.0
    )


def _oscillated(
    value: Value, rate: Value, rest: Value, seconds: float, oscillator: tuple[float, float]
) -> tuple[Value, Value]:
    """Value and rate of a damped oscillator (its frequency [rad/s] and damping, below 1) that is
    drawn to ``rest``, ``seconds`` later: exact for steps of any length."""
    frequency, damping = oscillator
    decay, swing = damping * frequency, frequency * math.sqrt(1 - damping * damping)
    cos, sin = math.cos(swing * seconds), math.sin(swing * seconds)
    fade, away = math.exp(-decay * seconds), value - rest
    return (
        rest + fade * (away * cos + (rate + decay * away) / swing * sin),
        fade * (rate * cos - (decay * rate + frequency**2 * away) / swing * sin),
    )
