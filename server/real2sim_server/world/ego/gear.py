"""Reverse gear: a vehicle that drives backwards is its mirror image driving forwards.

Turned round by half a turn, with speeds, accelerations and steering angles of the opposite sign, a
vehicle on its rear axle obeys the same equations. So dynamics and trackers know driving forwards
alone, and here is what goes with the gear: it changes at rest only, it has a top speed of its own,
and commands on their way through actuators were given in the gear of then.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

from real2sim_proto.episode import EgoSpec

from ..common import cache_by_identity
from ..driving import GRAVITY, HOLD, VEHICLE_MODELS, Command
from .motion import ControlLaw, Motion, advance_motion, commanded, constant_law

SHIFT_BRAKING = 6.0
"""Deceleration of a vehicle that still rolls on when its plan has turned back already, where it can
[m/s^2]."""

SHIFT_LOOK_US = 10_000
"""How often a vehicle that brakes for the other gear is looked at [us]."""


def can_reverse(spec: EgoSpec) -> bool:
    """Whether a vehicle has a reverse gear: a speed for it, and a model that goes backwards."""
    return spec.max_reverse_speed > 0 and VEHICLE_MODELS[spec.dynamics].backwards is not None


@cache_by_identity
@lru_cache(maxsize=256)
def backwards_spec(spec: EgoSpec) -> EgoSpec:
    """The mirror image of a vehicle with a reverse gear."""
    model = VEHICLE_MODELS[spec.dynamics].backwards
    change: dict[str, Any] = {"max_speed": spec.max_reverse_speed, "dynamics": model}
    if model != spec.dynamics:
        # Tyres that slip set a limit which wheels that only roll do not know.
        grip = spec.vehicle.friction * GRAVITY
        change["max_acceleration"] = min(spec.max_acceleration, grip)
        change["max_braking"] = min(spec.max_braking, grip)
    return spec.model_copy(update=change)


def mirrored(motion: Motion, half_turn: float = math.pi) -> Motion:
    """The mirror image of a vehicle, which drives forwards where that drives backwards.

    Args:
        motion: of the vehicle.
        half_turn: pi, and minus pi for the way back.
    """
    return motion._replace(
        yaw=motion.yaw + half_turn,
        speed=_negative(motion.speed),
        acceleration=_negative(motion.acceleration),
        steering=_negative(motion.steering),
        lateral_speed=_negative(motion.lateral_speed),
        drive=_negative(motion.drive),
        pending=tuple([_mirrored_command(c) for c in motion.pending]),
    )


def advance_in_gear(
    motion: Motion,
    law: ControlLaw,
    spec: EgoSpec,
    dt_us: int,
    *,
    since: float,
    backwards: bool,
) -> Motion:
    """The vehicle ``dt_us`` later under a law of one gear.

    Args:
        motion: now.
        law: in the frame of that gear: of the mirror image where it leads backwards.
        spec: of a vehicle with a reverse gear.
        dt_us: how far to go [us].
        since: time since the law's plan began [s].
        backwards: whether the gear is the reverse one.
    """
    end_us = dt_us
    at_us = 0
    while at_us < end_us:
        motion = _in_gear_of_its_motion(motion)
        if motion.reversing != backwards and motion.speed == 0.0:
            motion = _shifted(motion)
        if motion.reversing == backwards:
            rest_us, later = end_us - at_us, since + at_us * 1e-6
            return _advanced(motion, law, spec, rest_us, since=later)
        piece_us = min(SHIFT_LOOK_US, end_us - at_us)
        motion = _advanced(motion, _braking(law, motion, spec), spec, piece_us, since=0.0)
        at_us += piece_us
    return _in_gear_of_its_motion(motion)


def command_in_gear(
    motion: Motion, law: ControlLaw, spec: EgoSpec, *, since: float, backwards: bool
) -> Command:
    """What a law of one gear would do, as :func:`advance_in_gear` takes it; along the heading."""
    if not backwards:
        return commanded(motion, law, spec, since=since)
    return _mirrored_command(commanded(mirrored(motion), law, backwards_spec(spec), since=since))


def _advanced(
    motion: Motion, law: ControlLaw, spec: EgoSpec, dt_us: int, *, since: float
) -> Motion:
    """By a law of the gear that is engaged."""
    if not motion.reversing:
        return advance_motion(motion, law, spec, dt_us, since=since)
    image = advance_motion(mirrored(motion), law, backwards_spec(spec), dt_us, since=since)
    return mirrored(image, -math.pi)._replace(reversing=True)


def _braking(law: ControlLaw, motion: Motion, spec: EgoSpec) -> ControlLaw:
    """Brakes in the gear that is engaged. A held command, which is in the frame of the other one,
    does by its own strength and steers; else the wheels stay as they are."""
    if law.kind == HOLD:
        return constant_law(Command(-abs(law.hold[0]), -law.hold[1]))
    steering = -motion.steering if motion.reversing else motion.steering
    return constant_law(Command(-min(SHIFT_BRAKING, spec.max_braking), steering))


def _in_gear_of_its_motion(motion: Motion) -> Motion:
    """What pushed a vehicle backwards, or forwards again, has changed its gear."""
    backwards = motion.speed < 0.0
    return _shifted(motion) if motion.speed and backwards != motion.reversing else motion


def _shifted(motion: Motion) -> Motion:
    """In the other gear: what brakes goes on braking, and what drives is let go."""

    def kept(acceleration: float) -> float:
        brakes = acceleration > 0.0 if motion.reversing else acceleration < 0.0
        return -acceleration if brakes else 0.0

    pending = tuple([Command(kept(c.acceleration), c.steering) for c in motion.pending])
    return motion._replace(
        reversing=not motion.reversing, drive=kept(motion.drive), pending=pending
    )


def _mirrored_command(command: Command) -> Command:
    return Command(_negative(command.acceleration), _negative(command.steering))


def _negative(value: float) -> float:
    """Never minus zero, which would show on the wire."""
    return 0.0 - value
