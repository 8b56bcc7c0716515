"""State of the vehicle, and commands to it."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..._numba import func

GENTLE_BRAKING = 2.0
"""Deceleration after a plan's end [m/s^2]."""


class PlanarState(NamedTuple):
    """A vehicle on the plane, referred to its rear axle.

    Attributes:
        x, y: rear axle centre, world [m].
        yaw: heading [rad], not wrapped.
        speed: along the heading [m/s].
        acceleration: along the heading, mean over the last step [m/s^2].
        steering: road-wheel angle, positive to the left [rad].
        yaw_rate: [rad/s].
        lateral_speed: of the rear axle, positive to the left; 0 while its wheels roll [m/s].
        drive: acceleration that engine or brakes bring about now [m/s^2].
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
    """``value``, or the bound that it is beyond."""
    return min(max(value, least), most)


@func
def wrapped(angle):
    """The angle [rad] less the full turns in it: within half a turn."""
    return angle - math.tau * math.floor(angle / math.tau + 0.5)
