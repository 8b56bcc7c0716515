"""What lies between a command and the wheels: dead times, then lags of the first order."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import func
from .state import Command, clamped


@func
def delay_line(pending, vehicle, h):
    """The line of delayed commands in substeps of ``h`` seconds, and one more.

    Args:
        pending: [W, 2] float64, on their way, newest first.
        vehicle: constants.
        h: [s].

    Returns:
        Line [D + 1, 2] float64 for delays of D substeps, and how many of its rows are in use.
    """
    longest = max(delay_substeps(vehicle.drive_delay, h), delay_substeps(vehicle.steering_delay, h))
    line = np.empty((longest + 1, 2))
    waiting = min(len(pending), longest)
    for k in range(waiting):
        line[k, 0], line[k, 1] = pending[k, 0], pending[k, 1]
    return line, waiting


@func
def delayed_commands(line, waiting):
    """The commands still on their way: [W, 2] float64, newest first."""
    pending = np.empty((min(waiting, len(line) - 1), 2))
    for k in range(len(pending)):
        pending[k, 0], pending[k, 1] = line[k, 0], line[k, 1]
    return pending


@func
def push_command(line, waiting, command):
    """Puts a command at the head of those on their way; how many they are now.

    Args:
        line: [W, 2] float64, commands newest first; the last drops out where it is full.
        waiting: rows of it in use.
        command: the command now.
    """
    waiting = min(waiting + 1, len(line))
    for k in range(waiting - 1, 0, -1):
        line[k, 0], line[k, 1] = line[k - 1, 0], line[k - 1, 1]
    line[0, 0], line[0, 1] = command.acceleration, command.steering
    return waiting


@func
def actuator_outputs(queue, state, vehicle, h, ahead):
    """What engine, brakes and steering gear aim at in a substep of ``h`` seconds.

    Until the first command arrives they keep what they do.

    Args:
        queue: line of commands and how many of its rows are in use.
        state: of the vehicle when the substep begins.
        vehicle: constants.
        h: [s].
        ahead: substeps after that in which the newest command was given; commands that are not
            given yet are taken to be like the newest.
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
    """What to ask of a first-order lag at ``value`` so that it is at ``wanted`` ``h`` seconds
    later."""
    if lag == 0.0:
        return wanted
    return value - (wanted - value) / math.expm1(-h / lag)


@func
def _first_order_lag(value, wanted, h, lag):
    """Where a first-order lag is ``h`` seconds later."""
    if lag == 0.0:
        return wanted
    return value - (wanted - value) * math.expm1(-h / lag)
