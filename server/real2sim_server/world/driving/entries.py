"""What Python calls: plain tuples and arrays in and out, since others are slow to pass."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import func, kernel
from .curve import PlanCurve, at, curve_through, heading
from .trackers import HOLD, tracker_command, tracker_schedule
from .vehicle import (
    Command,
    PlanarState,
    VehicleParameters,
    actuator_outputs,
    delay_line,
    delay_substeps,
    delayed_commands,
    foreseen_state,
    push_command,
    step_vehicle,
)

SUBSTEP_US = 10_000

_NOTHING = np.empty((0, 0))
NO_SCHEDULE = _NOTHING, _NOTHING, _NOTHING, _NOTHING
"""Of trackers that do not plan ahead."""


@func
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
def placed_poses(poses, frame, clearly):
    """Poses of a frame in the world, see :func:`world_poses`; and whether each lies ahead of the
    one before by ``clearly`` [m] along the sum of their headings."""
    moved, ahead = world_poses(poses, frame), True
    cos, sin = math.cos(moved[0, 2]), math.sin(moved[0, 2])
    for k in range(1, len(moved)):
        before = cos, sin
        cos, sin = math.cos(moved[k, 2]), math.sin(moved[k, 2])
        along = (moved[k, 0] - moved[k - 1, 0]) * (before[0] + cos)
        along += (moved[k, 1] - moved[k - 1, 1]) * (before[1] + sin)
        ahead &= along >= clearly
    return moved, ahead


@kernel
def plan_curve(state, start_us, plan, vehicle):
    """A plan as a curve, see :class:`.curve.Curve`.

    Args:
        state: nine floats of a :class:`.vehicle.PlanarState`.
        start_us: when the vehicle is in that state [us].
        plan: times [N] int64, increasing, after ``start_us`` [us]; poses [N, 3] float64, x, y [m],
            yaw [rad], world; and seconds from the start, x, y, yaw of the single pose of the plan
            before, which one of a single pose goes on from, else ``NO_POSE``.
        vehicle: the members of a :class:`.vehicle.VehicleParameters`.

    Returns:
        Knots [N + 1, 6] float64 and the turn rate at the end [rad/s].
    """
    times_us, poses, before = plan
    seconds = (times_us - start_us) * 1e-6
    parameters = VehicleParameters(*vehicle)
    curve = curve_through(PlanarState(*state), seconds, poses, parameters, before)
    return curve.knots, curve.turn_rate


@kernel
def curve_at(curve, t):
    """x, y [m], velocity x, y [m/s] and planned heading [rad], ``t`` seconds after the start."""
    named = PlanCurve(*curve, 0.0)
    x, y, vx, vy = at(named, t)
    return x, y, vx, vy, heading(named, t)


@kernel
def prepare_schedule(state, pending, law, vehicle, dt_us):
    """The schedule of a tracker that plans ahead, from a state on; arguments as in
    :func:`advance_vehicle`.

    Apart from it, since planning ahead takes most of the time that all of this takes to compile,
    and few drives plan ahead.

    Returns:
        Four float64 arrays of two dimensions: the schedule (see :class:`.trackers.Tracker`) by
        which engine and brakes go, then the one of the steering gear. Each begins when a command
        given now arrives there.
    """
    kind, knots, turn_rate, since, _, _ = law
    parameters = VehicleParameters(*vehicle)
    _, h = _substeps(dt_us)
    queue = delay_line(pending, parameters, h)
    drive, steering = _arrivals(parameters, h)
    curve = PlanCurve(knots, turn_rate, drive * h)
    start = foreseen_state(PlanarState(*state), queue, parameters, h, drive)
    schedule = tracker_schedule(kind - 1, start, curve, since + drive * h, parameters)
    first = schedule
    if steering != drive:
        curve = PlanCurve(knots, turn_rate, steering * h)
        start = foreseen_state(PlanarState(*state), queue, parameters, h, steering)
        schedule = tracker_schedule(kind - 1, start, curve, since + steering * h, parameters)
    return first[0], first[1], schedule[0], schedule[1]


@kernel
def advance_vehicle(state, pending, law, vehicle, dt_us):
    """The vehicle ``dt_us`` later, in equal substeps of 10 ms at most.

    Within a substep the steering angle moves at most at its rate limit. The kinematic bicycle
    follows the arc of its mean exactly; speed changes linearly until it reaches 0 or the greatest
    speed. The dynamic bicycle does the same at walking pace and slips on its tyres above, see
    :mod:`.vehicle`. Braking never ends in reversing.

    Args:
        state: nine floats of a :class:`.vehicle.PlanarState`.
        pending: [W, 2] float64, commands on their way to the wheels, newest first.
        law: kind, knots and turn rate of its plan, seconds since that began, the command to hold,
            which trackers ignore, and the schedules: of :func:`prepare_schedule` for trackers
            that plan ahead, else :data:`NO_SCHEDULE`.
        vehicle: the members of a :class:`.vehicle.VehicleParameters`.

    Returns:
        State and commands on their way, in the form in which they came.
    """
    since = law[3]
    substeps, h = _substeps(dt_us)
    start, parameters = PlanarState(*state), VehicleParameters(*vehicle)
    line, waiting = delay_line(pending, parameters, h)
    now = start
    for k in range(substeps):
        timing = since + k * h, k * h, h
        command = _timely_command(law, now, (line, waiting), parameters, timing)
        waiting = push_command(line, waiting, command)
        outputs = actuator_outputs((line, waiting), now, parameters, h, 0)
        now = step_vehicle(parameters.model, now, outputs, parameters, h)
    return _numbers(now, start.speed, substeps * h), delayed_commands(line, waiting)


@kernel
def driver_command(state, law, vehicle):
    """The command of a law: acceleration [m/s^2] and road-wheel angle [rad]; arguments as in
    :func:`advance_vehicle`. Trackers that plan ahead do here what the plain LQR would."""
    kind, knots, turn_rate, since, hold, _ = law
    if kind == HOLD:
        return hold
    curve, schedule = PlanCurve(knots, turn_rate, 0.0), (np.empty((0, 0)), np.empty((0, 0)), 0.0)
    command = tracker_command(
        kind - 1, PlanarState(*state), curve, since, VehicleParameters(*vehicle), schedule
    )
    return command.acceleration, command.steering


@func
def _substeps(dt_us):
    """How many substeps a step has, and their length [s]."""
    count = -(-dt_us // SUBSTEP_US)
    return count, dt_us * 1e-6 / count


@func
def _arrivals(vehicle, h):
    """Substeps until a command is known to reach engine and brakes, and the steering gear."""
    return (
        delay_substeps(vehicle.known_drive_delay, h),
        delay_substeps(vehicle.known_steering_delay, h),
    )


@func
def _timely_command(law, now, queue, vehicle, timing):
    """The command of a law for a substep, each part of it for the time at which it arrives.

    Args:
        law, vehicle: as in :func:`advance_vehicle`.
        now: state of the vehicle.
        queue: commands on their way, and how many.
        timing: seconds since the plan began, seconds since the step began, length of the substep.
    """
    if law[0] == HOLD:
        return Command(*law[4])
    drive, steering = _arrivals(vehicle, timing[2])
    schedules = law[5]
    command = _command_after(drive, (law, schedules[:2]), (now, queue), vehicle, timing)
    if steering == drive:
        return command
    later = _command_after(steering, (law, schedules[2:]), (now, queue), vehicle, timing)
    return Command(command.acceleration, later.steering)


@func
def _command_after(substeps, driver, moving, vehicle, timing):
    """The command of a law and its schedule for the state after some substeps."""
    (law, schedule), (now, queue), (t, elapsed, h) = driver, moving, timing
    curve = PlanCurve(law[1], law[2], substeps * h)
    there = foreseen_state(now, queue, vehicle, h, substeps)
    t += curve.early
    return tracker_command(law[0] - 1, there, curve, t, vehicle, (*schedule, elapsed))


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
