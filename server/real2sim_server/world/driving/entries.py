"""Entry points for Python, with plain tuples and arrays: other types are slow to pass to Numba."""

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
"""Schedules of trackers that do not plan ahead."""


@func
def world_poses(poses, frame):
    """Poses x, y [m], yaw [rad] of a frame in the world.

    Args:
        poses: [N, 3] float64, in the frame.
        frame: pose x, y [m], yaw [rad] of the frame in the world.

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
    """World poses as :func:`world_poses`, and whether they clearly lead forwards.

    They do if each pose is at least ``clearly`` [m] ahead of its predecessor along the sum of their
    headings.
    """
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
    """A plan as a curve, see :class:`.curve.PlanCurve`.

    Args:
        state: nine floats of a :class:`.vehicle.PlanarState`.
        start_us: time of that state [us].
        plan: times [N] int64, increasing, after ``start_us`` [us]; poses [N, 3] float64, x, y [m],
            yaw [rad], world frame; and time from the start [s], x, y, yaw of the previous plan's
            pose if both plans have a single pose, else ``NO_POSE``.
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
    """The schedule of a tracker that plans ahead; arguments as in :func:`advance_vehicle`.

    A separate entry point, because it dominates the compile time and few drives need it.

    Returns:
        Four 2-D float64 arrays: the schedule (see :class:`.trackers.Tracker`) for engine and
        brakes, then that for the steering. Each starts at the arrival time of a command given now.
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
    """Advance the vehicle by ``dt_us``, in equal substeps of at most 10 ms.

    Within a substep the steering angle obeys its rate limit. The kinematic bicycle follows the arc
    of the mean steering angle exactly; speed changes linearly until it reaches 0 or the maximum
    speed. The dynamic bicycle equals it at walking pace and has tyre slip above, see
    :mod:`.vehicle`. Braking stops at rest.

    Args:
        state: nine floats of a :class:`.vehicle.PlanarState`.
        pending: [W, 2] float64, delayed commands, newest first.
        law: kind, knots and turn rate of its plan, seconds since its start, the command to hold
            (ignored by trackers), and the schedules: of :func:`prepare_schedule` for trackers
            that plan ahead, else :data:`NO_SCHEDULE`.
        vehicle: the members of a :class:`.vehicle.VehicleParameters`.

    Returns:
        State and delayed commands, in the form of the arguments.
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
    """The command of a law: acceleration [m/s^2] and road-wheel angle [rad].

    Arguments as in :func:`advance_vehicle`. Trackers that plan ahead return the LQR command.
    """
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
    """Number of substeps of a step, and their length [s]."""
    count = -(-dt_us // SUBSTEP_US)
    return count, dt_us * 1e-6 / count


@func
def _arrivals(vehicle, h):
    """Known delays of commands to engine and brakes, and to the steering, in substeps."""
    return (
        delay_substeps(vehicle.known_drive_delay, h),
        delay_substeps(vehicle.known_steering_delay, h),
    )


@func
def _timely_command(law, now, queue, vehicle, timing):
    """The command of a law for a substep, computed for the arrival times of its two parts.

    Args:
        law, vehicle: as in :func:`advance_vehicle`.
        now: vehicle state.
        queue: delayed commands and their number.
        timing: seconds since the start of the plan and of the step, length of the substep.
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
