"""What Python calls: plain tuples and arrays in and out, since others are slow to pass."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import func, kernel
from .actuators import at_wheels, begun, left, sent
from .bicycle import moved_on
from .curve import PlanCurve, at, curve_through, end_of, heading
from .ilqr import played, scheduled
from .lqr import regulate
from .pursuit import pursue
from .state import Command, PlanarState
from .vehicle import VehicleParameters

HOLD, PURSUIT, LQR, ILQR = range(4)
"""Kinds of drivers: one command all the time, or trackers of a plan."""

SUBSTEP_US = 10_000


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
def advance_vehicle(state, pending, driver, vehicle, dt_us):
    """The vehicle ``dt_us`` later, in equal substeps of 10 ms at most.

    Within a substep the steering angle moves at most at its rate limit. The kinematic bicycle
    follows the arc of its mean exactly; speed changes linearly until it meets 0 or the greatest
    speed. The dynamic bicycle does the same at walking pace and slips on its tyres above, see
    :mod:`.tyres`. Braking never ends in reversing.

    Args:
        state: nine floats of a :class:`.state.PlanarState`.
        pending: [W, 2] float64, commands on their way to the wheels, newest first.
        driver: kind, knots and turn rate of its plan, seconds since that began, and the command
            to hold, which trackers do not look at.
        vehicle: the members of a :class:`.vehicle.Vehicle`.

    Returns:
        State and commands on their way, in the form in which they came.
    """
    kind, knots, turn_rate, since, _ = driver
    substeps = -(-dt_us // SUBSTEP_US)
    h = dt_us * 1e-6 / substeps
    curve = PlanCurve(knots, turn_rate)
    start, car = PlanarState(*state), VehicleParameters(*vehicle)
    line, waiting = begun(pending, car, h)
    planning = kind == ILQR and since < end_of(curve)
    if planning:
        schedule = scheduled(start, curve, since, car)
    else:
        schedule = np.empty((0, 0)), np.empty((0, 0))
    now = start
    for k in range(substeps):
        if planning:
            asked = played(schedule, now, k * h, car)
        else:
            asked = _asked(driver, now, since + k * h, car)
        waiting = sent(line, waiting, asked)
        now = moved_on(now, at_wheels(line, waiting, now, car, h), car, h)
    return _numbers(now, start.speed, substeps * h), left(line, waiting)


@kernel
def driver_command(state, driver, vehicle):
    """What a driver asks for: acceleration [m/s^2] and road-wheel angle [rad]; arguments as in
    :func:`advance_vehicle`. Who plans ahead does here what the plain LQR would."""
    command = _asked(driver, PlanarState(*state), driver[3], VehicleParameters(*vehicle))
    return command.acceleration, command.steering


@func
def _asked(driver, state, t, vehicle):
    kind, knots, turn_rate, _, (acceleration, steering) = driver
    if kind == HOLD:
        return Command(acceleration, steering)
    if kind == PURSUIT:
        return pursue(state, PlanCurve(knots, turn_rate), t, vehicle)
    return regulate(state, PlanCurve(knots, turn_rate), t, vehicle)


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
