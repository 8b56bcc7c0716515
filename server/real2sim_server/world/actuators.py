"""What lies between a command and the wheels: dead times, then lags of the first order."""

from __future__ import annotations

import math
from typing import NamedTuple

from real2sim_proto.episode import EgoSpec


class Command(NamedTuple):
    """What the driver asks for: acceleration [m/s^2] and road-wheel angle [rad]."""

    acceleration: float
    steering: float


Pending = tuple[Command, ...]


def at_wheels(
    asked: Command, pending: Pending, now: Command, spec: EgoSpec, h: float
) -> tuple[Command, Pending]:
    """What engine, brakes and steering gear aim at in this substep, and what is on its way.

    Args:
        asked: by the driver, now.
        pending: asked before, newest first.
        now: acceleration that is brought about so far, and present road-wheel angle; kept until
            the first command arrives.
        spec: limits, delays and lags.
        h: substep [s].
    """
    actuators = spec.actuators
    waits = actuators.drive_delay_us, actuators.steering_delay_us
    if not any(waits) and not actuators.drive_lag and not actuators.steering_lag:
        return asked, ()
    steps = [round(wait * 1e-6 / h) for wait in waits]
    line = (asked, *pending)
    drive, steering = (line[k] if k < len(line) else now for k in steps)
    limited = min(max(drive.acceleration, -spec.max_braking), spec.max_acceleration)
    arrived = Command(
        _approached(now.acceleration, limited, h, actuators.drive_lag),
        _approached(now.steering, steering.steering, h, actuators.steering_lag),
    )
    return arrived, line[: max(steps)]


def _approached(value: float, wanted: float, h: float, lag: float) -> float:
    """Where a first-order lag is ``h`` seconds later."""
    return wanted if lag == 0.0 else value - (wanted - value) * math.expm1(-h / lag)
