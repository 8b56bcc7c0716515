"""When to change lanes: MOBIL, minimising overall braking induced by lane changes.

Kesting, Treiber and Helbing 2007, "General lane-changing model MOBIL for car-following models",
Transportation Research Record 1999, equations 2 (safety) and 3 (incentive).
"""

from __future__ import annotations

from real2sim_proto.episode import LaneDriver

from .idm import acceleration
from .leader import Leader, Neighbours


def incentive(
    spec: LaneDriver,
    speed: float,
    length: float,
    *,
    here: tuple[Neighbours, float],
    there: tuple[Neighbours, float],
) -> float | None:
    """What a change of lanes gains, beyond the threshold [m/s^2]; None where it is not safe.

    Others are taken to drive by the same parameters, at least as fast as they do now.

    Args:
        spec: of the driver.
        speed: its speed [m/s].
        length: of its vehicle [m].
        here, there: neighbours in a lane, and the desired speed in it [m/s].
    """
    (now, desired_here), (then, desired_there) = here, there
    me = speed
    if any(other is not None and other.gap <= 0.0 for other in then):
        return None
    own = acceleration(spec, speed, desired_there, then.leader)
    gain = own - acceleration(spec, speed, desired_here, now.leader)
    new_before, new_after = _with_and_without(spec, me, length, then, desired_there)
    if min(own, new_after) < -spec.safe_braking:
        return None
    old_after, old_before = _with_and_without(spec, me, length, now, desired_here)
    others = (new_after - new_before) + (old_after - old_before)
    return gain + spec.politeness * others - spec.threshold


def _with_and_without(
    spec: LaneDriver, speed: float, length: float, lane: Neighbours, desired: float
) -> tuple[float, float]:
    """Acceleration of the one behind in a lane without the driver, and with it; 0 where nobody is
    behind."""
    behind, ahead = lane.follower, lane.leader
    if behind is None:
        return 0.0, 0.0
    wanted = max(desired, behind.speed)
    beyond = None if ahead is None else Leader(behind.gap + length + ahead.gap, ahead.speed)
    without = acceleration(spec, behind.speed, wanted, beyond)
    return without, acceleration(spec, behind.speed, wanted, Leader(behind.gap, speed))
