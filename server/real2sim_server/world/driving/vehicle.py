"""The controlled vehicle: its constants, state, models and actuators.

A vehicle model is two compiled functions, see :class:`VehicleModel`. A new model needs these two
functions and an entry in :data:`VEHICLE_MODELS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from real2sim_proto.episode import EgoSpec

from ..._numba import func
from ..common import cache_by_identity

# --- State ---------------------------------------------------------------------------------------

GENTLE_BRAKING = 2.0
"""Deceleration after a plan's end [m/s^2]."""


class PlanarState(NamedTuple):
    """Planar vehicle state at the rear axle.

    Attributes:
        x, y: rear axle centre, world frame [m].
        yaw: heading [rad], not wrapped.
        speed: along the heading [m/s].
        acceleration: along the heading, mean over the last step [m/s^2].
        steering: road-wheel angle, positive left [rad].
        yaw_rate: [rad/s].
        lateral_speed: lateral speed of the rear axle, positive left [m/s]; 0 without slip.
        drive: current acceleration by engine or brakes [m/s^2].
    """

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    steering: float
    yaw_rate: float
    lateral_speed: float
    drive: float


class Command(NamedTuple):
    """A command: acceleration [m/s^2] and road-wheel angle [rad]."""

    acceleration: float
    steering: float


@func
def clamped(value, least, most):
    """``value`` clamped to [least, most]."""
    return min(max(value, least), most)


@func
def wrapped(angle):
    """The angle wrapped to [-pi, pi) [rad]."""
    return angle - math.tau * math.floor(angle / math.tau + 0.5)


GRAVITY = 9.81


def wheel_load(mass: float, height: float, base: float, arm: float, acceleration: float) -> float:
    """Load [N] on the wheels at one end of a base, for a mass accelerating towards that end.

    Used for the longitudinal load transfer of tyres, and for both directions of the suspension.
    Compiled code uses it through :func:`real2sim_server._numba.func`.

    Args:
        mass: [kg].
        height: height of the centre of mass [m].
        base: distance between the two ends [m].
        arm: distance from the other end to the centre of mass [m].
        acceleration: [m/s^2].
    """
    return max(mass * (GRAVITY * arm - acceleration * height) / base, 0.0)


class VehicleParameters(NamedTuple):
    """Two-axle vehicle parameters with actuator limits.

    Attributes:
        model: number of the model, see :data:`VEHICLE_MODELS`.
        wheelbase: [m].
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        front, rear: distance of each axle from the centre of mass [m].
        height: height of the centre of mass [m].
        friction: tyre-road friction coefficient.
        front_cornering, rear_cornering: lateral force per load and slip angle [1/rad].
        understeer: steering angle beyond L/R per lateral acceleration [rad s^2/m]: m/L (b/C_f -
            a/C_r) (Gillespie 1992, eq. 6-15) with stiffnesses proportional to the static loads,
            so that the geometry cancels out.
        max_steer, max_steer_rate: limits of the road wheels [rad], [rad/s].
        max_acceleration, max_braking: [m/s^2].
        max_speed: [m/s].
        steering_delay, drive_delay: dead times of commands [s].
        steering_lag, drive_lag: first-order time constants [s].
        known_steering_delay, known_steering_lag, known_drive_delay, known_drive_lag: the same four
            values as assumed by trackers [s]; 0 if trackers do not compensate for them.
        tracker_version: version of the trackers, see ``EgoSpec``.
    """

    model: int
    wheelbase: float
    mass: float
    inertia: float
    front: float
    rear: float
    height: float
    friction: float
    front_cornering: float
    rear_cornering: float
    understeer: float
    max_steer: float
    max_steer_rate: float
    max_acceleration: float
    max_braking: float
    max_speed: float
    steering_delay: float
    steering_lag: float
    drive_delay: float
    drive_lag: float
    known_steering_delay: float
    known_steering_lag: float
    known_drive_delay: float
    known_drive_lag: float
    tracker_version: int


# --- Dispatch ------------------------------------------------------------------------------------


def choice(functions: Sequence[Any]) -> Any:
    """A compiled dispatcher ``call(number, *args)`` over ``functions``.

    All functions must have the same argument and return types. It is a chain of comparisons, so
    that the compiler can inline all of them.
    """
    first, *rest = functions
    if not rest:

        @func
        def last(_number, *args):
            return first(*args)

        return last
    others = choice(rest)

    @func
    def chosen(number, *args):
        if number == 0:
            return first(*args)
        return others(number - 1, *args)

    return chosen


# --- Kinematic bicycle ---------------------------------------------------------------------------


@func
def step_rolling(state, command, vehicle, h):
    """The vehicle ``h`` seconds later."""
    return rolled(state, command, command.acceleration, vehicle, h)


@func
def rolling_steering(rolling, _curvature, _speed, _vehicle):
    """Road-wheel angle [rad] for a curvature, without slip."""
    return rolling


@func
def rolled(state, command, acceleration, vehicle, h):
    """Kinematic bicycle step with ``acceleration``, which may be below the commanded one."""
    steering = _limited_steering(state.steering, command.steering, vehicle, h)
    speed, distance = _limited_speed(state.speed, acceleration, vehicle, h)
    curvature = math.tan((state.steering + steering) / 2) / vehicle.wheelbase
    turn = distance * curvature
    chord = distance * sinc(turn / 2)
    heading = state.yaw + turn / 2
    return PlanarState(
        state.x + chord * math.cos(heading),
        state.y + chord * math.sin(heading),
        state.yaw + turn,
        speed,
        0.0,
        steering,
        speed * math.tan(steering) / vehicle.wheelbase,
        0.0,
        command.acceleration,
    )


@func
def _limited_steering(steering, wanted, vehicle, h):
    most = vehicle.max_steer_rate * h
    wanted = clamped(wanted, -vehicle.max_steer, vehicle.max_steer)
    return steering + clamped(wanted - steering, -most, most)


@func
def _limited_speed(speed, wanted, vehicle, h):
    """Speed after ``h`` seconds and distance covered; linear in time up to the limits."""
    acceleration = clamped(wanted, -vehicle.max_braking, vehicle.max_acceleration)
    if acceleration == 0.0:
        return speed, speed * h
    limit = max(vehicle.max_speed, speed) if acceleration > 0 else min(0.0, speed)
    until_limit = (limit - speed) / acceleration
    if until_limit >= h:
        end = speed + acceleration * h
        return end, (speed + end) / 2 * h
    return limit, (speed + limit) / 2 * until_limit + limit * (h - until_limit)


@func
def sinc(angle):
    """sin(angle) / angle, by its series near 0 to avoid cancellation."""
    if abs(angle) < 1e-4:
        return 1.0 - angle * angle / 6.0
    return math.sin(angle) / angle


# --- Tyres of the dynamic bicycle ----------------------------------------------------------------

_wheel_load = func(wheel_load)

SLOWEST, FASTER = 2.0, 4.0
"""Speeds at which blending from the kinematic to the dynamic bicycle starts and ends [m/s]. Slip
angles are undefined at low speed."""


@func
def tyre_weight(speed):
    """Blending weight of the dynamic bicycle, 0 to 1; the rest is kinematic."""
    return clamped((speed - SLOWEST) / (FASTER - SLOWEST), 0.0, 1.0)


@func
def integrate(vehicle, state, steering, acceleration, h):
    """The state ``h`` seconds later, by the classical Runge-Kutta method.

    Args:
        vehicle: vehicle constants.
        state: state of the centre of mass, see :func:`rates`.
        steering: angle at the start and the end, linear in between [rad].
        acceleration: by engine or brakes [m/s^2].
        h: duration, at most 10 ms [s]; the fastest time constant, of the tyres, is 1/(60 vx) s.
    """
    begin, end = steering
    middle = (begin + end) / 2
    a = rates(vehicle, state, begin, acceleration)
    b = rates(vehicle, _integrated(state, a, h / 2), middle, acceleration)
    c = rates(vehicle, _integrated(state, b, h / 2), middle, acceleration)
    d = rates(vehicle, _integrated(state, c, h), end, acceleration)
    mean = (
        (a[0] + 2 * b[0] + 2 * c[0] + d[0]) / 6,
        (a[1] + 2 * b[1] + 2 * c[1] + d[1]) / 6,
        (a[2] + 2 * b[2] + 2 * c[2] + d[2]) / 6,
        (a[3] + 2 * b[3] + 2 * c[3] + d[3]) / 6,
        (a[4] + 2 * b[4] + 2 * c[4] + d[4]) / 6,
        (a[5] + 2 * b[5] + 2 * c[5] + d[5]) / 6,
    )
    return _integrated(state, mean, h)


@func
def rates(vehicle, state, steering, acceleration):
    """Time derivative of (x, y, yaw, vx, vy, yaw rate) of the centre of mass.

    Position and heading are in the world frame, velocity is in the vehicle frame.
    """
    _, _, yaw, vx, vy, turn = state
    front, rear = axle_forces(vehicle, (vx, vy, turn), steering, acceleration)
    cos, sin = math.cos(yaw), math.sin(yaw)
    across = front * math.cos(steering)
    return (
        vx * cos - vy * sin,
        vx * sin + vy * cos,
        turn,
        acceleration - front * math.sin(steering) / vehicle.mass + vy * turn,
        (across + rear) / vehicle.mass - vx * turn,
        (vehicle.front * across - vehicle.rear * rear) / vehicle.inertia,
    )


@func
def axle_forces(vehicle, moving, steering, acceleration):
    """Lateral forces [N] of front and rear axle, each across its wheels.

    Loads shift with the longitudinal acceleration. The longitudinal force is distributed by load,
    so both axles keep the same fraction of their friction circle for cornering.

    Args:
        vehicle: vehicle constants.
        moving: velocity of the centre of mass in the vehicle frame [m/s], forward above 0, and
            yaw rate [rad/s].
        steering: road-wheel angle [rad].
        acceleration: by engine or brakes, at most friction times gravity [m/s^2].
    """
    vx, vy, turn = moving
    mass, height, wheelbase = vehicle.mass, vehicle.height, vehicle.wheelbase
    load_f = _wheel_load(mass, height, wheelbase, vehicle.rear, acceleration)
    load_r = _wheel_load(mass, height, wheelbase, vehicle.front, -acceleration)
    used = acceleration / GRAVITY
    left = math.sqrt(max(vehicle.friction**2 - used * used, 0.0))
    slip_f = steering - math.atan2(vy + vehicle.front * turn, vx)
    slip_r = -math.atan2(vy - vehicle.rear * turn, vx)
    return (
        fiala(slip_f, vehicle.front_cornering * load_f, left * load_f),
        fiala(slip_r, vehicle.rear_cornering * load_r, left * load_r),
    )


@func
def fiala(slip, stiffness, limit):
    """Lateral force [N] of a tyre: linear for small slip, ``limit`` when it slides.

    The brush model with parabolic pressure (Fiala 1954; Pacejka 2012, Tire and Vehicle Dynamics,
    eq. 3.11).

    Args:
        slip: angle from the wheel's motion to its heading [rad]; the force has its sign.
        stiffness: stiffness at zero slip [N/rad].
        limit: friction times load, reduced by the longitudinal force [N].
    """
    if limit <= 0.0:
        return 0.0
    if abs(slip) >= math.atan(3 * limit / stiffness):
        return math.copysign(limit, slip)
    sliding = stiffness * math.tan(slip) / (3 * limit)
    return 3 * limit * sliding * (1 - abs(sliding) + sliding * sliding / 3)


@func
def _integrated(state, rate, h):
    x, y, yaw, vx, vy, turn = state
    return (
        x + h * rate[0],
        y + h * rate[1],
        yaw + h * rate[2],
        vx + h * rate[3],
        vy + h * rate[4],
        turn + h * rate[5],
    )


# --- Dynamic bicycle -----------------------------------------------------------------------------


@func
def step_slipping(state, command, vehicle, h):
    """The vehicle ``h`` seconds later; blends into the kinematic bicycle at low speed."""
    most = vehicle.friction * GRAVITY
    limited = clamped(command.acceleration, -most, most)
    rolling = rolled(state, command, limited, vehicle, h)
    weight = tyre_weight(min(state.speed, rolling.speed))
    if weight == 0.0:
        return rolling
    cos, sin = math.cos(state.yaw), math.sin(state.yaw)
    centre = (
        state.x + vehicle.rear * cos,
        state.y + vehicle.rear * sin,
        state.yaw,
        state.speed,
        state.lateral_speed + vehicle.rear * state.yaw_rate,
        state.yaw_rate,
    )
    acceleration = (rolling.speed - state.speed) / h
    steering = (state.steering, rolling.steering)
    x, y, yaw, vx, vy, turn = integrate(vehicle, centre, steering, acceleration, h)
    rest = 1 - weight
    return PlanarState(
        weight * (x - vehicle.rear * math.cos(yaw)) + rest * rolling.x,
        weight * (y - vehicle.rear * math.sin(yaw)) + rest * rolling.y,
        weight * yaw + rest * rolling.yaw,
        weight * max(vx, 0.0) + rest * rolling.speed,
        0.0,
        rolling.steering,
        weight * turn + rest * rolling.yaw_rate,
        weight * (vy - vehicle.rear * turn),
        command.acceleration,
    )


@func
def understeer_steering(rolling, curvature, speed, vehicle):
    """Road-wheel angle [rad] for a curvature: the no-slip angle plus the understeer angle."""
    return rolling + vehicle.understeer * speed**2 * curvature


# --- Models --------------------------------------------------------------------------------------


class VehicleModel(NamedTuple):
    """A vehicle model; create both functions with :func:`real2sim_server._numba.func`.

    Attributes:
        step: ``step(state, command, vehicle, h)``, returns the :class:`PlanarState` ``h`` seconds
            later (at most 10 ms) under a :class:`Command` that has reached the wheels; must obey
            the limits of the :class:`.vehicle.VehicleParameters`.
        steady_steering: ``steady_steering(rolling, curvature, speed, vehicle)``, returns the
            road-wheel angle [rad] for a curvature [1/m] at a speed [m/s]; ``rolling`` is the angle
            without slip. Used by trackers.
        backwards: name of the model whose mirror image is used in reverse gear, at low speed; None
            if the model cannot reverse.
    """

    step: Any
    steady_steering: Any
    backwards: str | None = "kinematic_bicycle"


VEHICLE_MODELS: Mapping[str, VehicleModel] = {
    "kinematic_bicycle": VehicleModel(step_rolling, rolling_steering),
    "dynamic_bicycle": VehicleModel(step_slipping, understeer_steering),
}
"""Models by the name in ``EgoSpec.dynamics``; the number of a model is its index."""

step_vehicle = choice([model.step for model in VEHICLE_MODELS.values()])
steady_steering = choice([model.steady_steering for model in VEHICLE_MODELS.values()])


@cache_by_identity
@lru_cache(maxsize=256)
def vehicle_parameters(spec: EgoSpec) -> VehicleParameters:
    """The constants of a spec."""
    figures, actuators = spec.vehicle, spec.actuators
    front = (1 - figures.front_load) * spec.wheelbase
    rear = figures.front_load * spec.wheelbase
    # k^2 / (a b) is close to 1 for passenger cars (Heydinger et al. 1999, SAE 1999-01-1336).
    inertia = figures.yaw_inertia or figures.mass * front * rear
    lags = {
        "steering_delay": actuators.steering_delay_us * 1e-6,
        "steering_lag": actuators.steering_lag,
        "drive_delay": actuators.drive_delay_us * 1e-6,
        "drive_lag": actuators.drive_lag,
    }
    known = {f"known_{name}": value * actuators.foreseen for name, value in lags.items()}
    return VehicleParameters(
        model=list(VEHICLE_MODELS).index(spec.dynamics),
        wheelbase=spec.wheelbase,
        mass=figures.mass,
        inertia=inertia,
        front=front,
        rear=rear,
        height=figures.centre_height,
        friction=figures.friction,
        front_cornering=figures.front_cornering,
        rear_cornering=figures.rear_cornering,
        understeer=(1 / figures.front_cornering - 1 / figures.rear_cornering) / GRAVITY,
        max_steer=spec.max_steer,
        max_steer_rate=spec.max_steer_rate,
        max_acceleration=spec.max_acceleration,
        max_braking=spec.max_braking,
        max_speed=spec.max_speed,
        **lags,
        **known,
        tracker_version=spec.tracker_version,
    )


# --- Actuators -----------------------------------------------------------------------------------

# Commands reach the wheels after a dead time and a first-order lag.


@func
def delay_line(pending, vehicle, h):
    """The delay line of commands in substeps of ``h`` seconds, with one extra row.

    Args:
        pending: [W, 2] float64, delayed commands, newest first.
        vehicle: vehicle constants.
        h: [s].

    Returns:
        Line [D + 1, 2] float64 for delays of D substeps, and the number of rows in use.
    """
    longest = max(delay_substeps(vehicle.drive_delay, h), delay_substeps(vehicle.steering_delay, h))
    line = np.empty((longest + 1, 2))
    waiting = min(len(pending), longest)
    for k in range(waiting):
        line[k, 0], line[k, 1] = pending[k, 0], pending[k, 1]
    return line, waiting


@func
def delayed_commands(line, waiting):
    """The delayed commands [W, 2] float64, newest first."""
    pending = np.empty((min(waiting, len(line) - 1), 2))
    for k in range(len(pending)):
        pending[k, 0], pending[k, 1] = line[k, 0], line[k, 1]
    return pending


@func
def push_command(line, waiting, command):
    """Push a command to the head of the delay line; return the number of rows in use.

    Args:
        line: [W, 2] float64, commands, newest first; the last one drops out of a full line.
        waiting: number of rows in use.
        command: current command.
    """
    waiting = min(waiting + 1, len(line))
    for k in range(waiting - 1, 0, -1):
        line[k, 0], line[k, 1] = line[k - 1, 0], line[k - 1, 1]
    line[0, 0], line[0, 1] = command.acceleration, command.steering
    return waiting


@func
def actuator_outputs(queue, state, vehicle, h, ahead):
    """Targets of engine, brakes and steering in a substep of ``h`` seconds.

    Until the first command arrives, actuators hold their output.

    Args:
        queue: delay line and the number of rows in use.
        state: vehicle state at the start of the substep.
        vehicle: vehicle constants.
        h: [s].
        ahead: substeps since the newest command; future commands are assumed to equal it.
    """
    line, waiting = queue
    drive, steering = state.drive, state.steering
    k = max(delay_substeps(vehicle.drive_delay, h) - ahead, 0)
    if k < waiting:
        drive = clamped(line[k, 0], -vehicle.max_braking, vehicle.max_acceleration)
    k = max(delay_substeps(vehicle.steering_delay, h) - ahead, 0)
    if k < waiting:
        steering = line[k, 1]
    return Command(
        _first_order_lag(state.drive, drive, h, vehicle.drive_lag),
        _first_order_lag(state.steering, steering, h, vehicle.steering_lag),
    )


@func
def delay_substeps(delay, h):
    """A dead time [s] in whole substeps of ``h`` seconds."""
    return math.floor(delay / h + 0.5)


@func
def leading(value, wanted, h, lag):
    """Input that moves a first-order lag from ``value`` to ``wanted`` in ``h`` seconds."""
    if lag == 0.0:
        return wanted
    return value - (wanted - value) / math.expm1(-h / lag)


@func
def _first_order_lag(value, wanted, h, lag):
    """Output of a first-order lag ``h`` seconds later."""
    if lag == 0.0:
        return wanted
    return value - (wanted - value) * math.expm1(-h / lag)


# --- Prediction ----------------------------------------------------------------------------------

# Trackers that know the dead times compute commands for the state at which they take effect (a
# Smith predictor without model error), so that dead time does not destabilise the loop.


@func
def foreseen_state(state, queue, vehicle, h, substeps):
    """The predicted vehicle some substeps later, under the delayed commands.

    Args:
        state: vehicle state.
        queue: delay line and the number of rows in use.
        vehicle: vehicle constants.
        h: length of a substep [s].
        substeps: number of substeps.
    """
    for k in range(substeps):
        outputs = actuator_outputs(queue, state, vehicle, h, k + 1)
        state = step_vehicle(vehicle.model, state, outputs, vehicle, h)
    return state
