"""What Python calls: plain tuples and arrays in and out, since others are slow to pass."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import func, kernel
from .actuators import actuator_outputs, delay_line, delayed_commands, push_command
from .curve import PlanCurve, at, curve_through, heading
from .state import Command, PlanarState
from .trackers import HOLD, tracker_command, tracker_schedule
from .vehicle import VehicleParameters
from .vehicle_models import step_vehicle

SUBSTEP_US = 10_000

NO_SCHEDULE = np.empty((0, 0)), np.empty((0, 0))
"""Of trackers that do not plan ahead."""


@kernel
def world_poses(poses, frame):
    """Poses x, y [m], yaw [rad] of a frame in the world.

    Args:
        poses: [N, 3] float64, in the frame.
        frame: x, y [m], yaw [rad] of the frame in the world.

    Returns:
        [N, 3] float64.
    """
    x, y, yaw = frame
    cos, sin = math.cos(yaw), math.sin(yaw)
    moved = np.empty_like(poses)
    for k in range(len(poses)):
        px, py = poses[k, 0], poses[k, 1]
        moved[k, 0], moved[k, 1] = x + cos * px - sin * py, y + sin * px + cos * py
        moved[k, 2] = yaw + poses[k, 2]
    return moved


@kernel
def plan_curve(state, times_us, start_us, poses, vehicle):
    """A plan as a curve, see :class:`.curve.Curve`.

    Args:
        state: nine floats of a :class:`.state.PlanarState`.
        times_us: [N] int64, increasing, after ``start_us`` [us].
        start_us: when the vehicle is in that state [us].
        poses: [N, 3] float64, x, y [m], yaw [rad], world.
        vehicle: the members of a :class:`.vehicle.Vehicle`.

    Returns:
        Knots [N + 1, 6] float64 and the turn rate at the end [rad/s].
    """
    seconds = (times_us - start_us) * 1e-6
    curve = curve_through(PlanarState(*state), seconds, poses, VehicleParameters(*vehicle))
    return curve.knots, curve.turn_rate


@kernel
def curve_at(curve, t):
    """x, y [m], velocity x, y [m/s] and planned heading [rad], ``t`` seconds after the start."""
    named = PlanCurve(*curve)
    x, y, vx, vy = at(named, t)
    return x, y, vx, vy, heading(named, t)


@kernel
def prepare_schedule(state, law, vehicle):
    """The schedule of a tracker that plans ahead, from a state on; arguments as in
    :func:`advance_vehicle`.

    Apart from it, since planning ahead takes most of the time that all of this takes to compile,
    and few drives plan ahead.

    Returns:
        Two float64 arrays of two dimensions, see :class:`.trackers.Tracker`.
    """
    kind, knots, turn_rate, since, _, _ = law
    curve = PlanCurve(knots, turn_rate)
    return tracker_schedule(
        kind - 1, PlanarState(*state), curve, since, VehicleParameters(*vehicle)
    )


@kernel
def advance_vehicle(state, pending, law, vehicle, dt_us):
    """The vehicle ``dt_us`` later, in equal substeps of 10 ms at most.

    Within a substep the steering angle moves at most at its rate limit. The kinematic bicycle
    follows the arc of its mean exactly; speed changes linearly until it reaches 0 or the greatest
    speed. The dynamic bicycle does the same at walking pace and slips on its tyres above, see
    :mod:`.tyres`. Braking never ends in reversing.

    Args:
        state: nine floats of a :class:`.state.PlanarState`.
        pending: [W, 2] float64, commands on their way to the wheels, newest first.
        law: kind, knots and turn rate of its plan, seconds since that began, the command to hold,
            which trackers ignore, and the schedule: of :func:`prepare_schedule` for trackers that
            plan ahead, else :data:`NO_SCHEDULE`.
        vehicle: the members of a :class:`.vehicle.Vehicle`.

    Returns:
        State and commands on their way, in the form in which they came.
    """
    since, schedule = law[3], law[5]
    substeps = -(-dt_us // SUBSTEP_US)
    h = dt_us * 1e-6 / substeps
    start, parameters = PlanarState(*state), VehicleParameters(*vehicle)
    line, waiting = delay_line(pending, parameters, h)
    now = start
    for k in range(substeps):
        command = _command(law, now, since + k * h, parameters, (*schedule, k * h))
        waiting = push_command(line, waiting, command)
        outputs = actuator_outputs(line, waiting, now, parameters, h)
        now = step_vehicle(parameters.model, now, outputs, parameters, h)
    return _numbers(now, start.speed, substeps * h), delayed_commands(line, waiting)


@kernel
def driver_command(state, law, vehicle):
    """The command of a law: acceleration [m/s^2] and road-wheel angle [rad]; arguments as in
    :func:`advance_vehicle`. Trackers that plan ahead do here what the plain LQR would."""
    schedule = np.empty((0, 0)), np.empty((0, 0)), 0.0
    command = _command(law, PlanarState(*state), law[3], VehicleParameters(*vehicle), schedule)
    return command.acceleration, command.steering


@func
def _command(law, state, t, vehicle, schedule):
    kind, knots, turn_rate, _, (acceleration, steering), _ = law
    if kind == HOLD:
        return Command(acceleration, steering)
    curve = PlanCurve(knots, turn_rate)
    return tracker_command(kind - 1, state, curve, t, vehicle, schedule)


@func
def _numbers(state, speed_before, seconds):
    return (
        state.x,
        state.y,
        state.yaw,
        state.speed,
        (state.speed - speed_before) / seconds,
        state.steering,
        state.yaw_rate,
        state.lateral_speed,
        state.drive,
    )
