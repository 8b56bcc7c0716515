"""Time to collision by constant velocity."""

from __future__ import annotations

import math

import numpy as np

from .hazard_kernels import STEP, first_overlap_step
from .instant import Instant, ScoringContext

STANDSTILL = 5e-3
"""Below this speed the time to collision is not defined (NAVSIM) [m/s]."""

NEVER = math.inf


def time_to_collision(
    instant: Instant, context: ScoringContext, *, off_lane: bool, hit: frozenset[str]
) -> float:
    """First time [s] in steps of 0.1 s up to 3 s at which the ego box overlaps an object's.

    All keep their velocities. Objects ahead count, or behind an ego that drives backwards; when
    the ego is in several lanes or off the road, all that are not on its other side (nuPlan,
    NAVSIM).

    Args:
        instant: now.
        context: the ego's size.
        off_lane: whether the ego is in several lanes or off the road.
        hit: objects it is in contact with already, which do not count.
    """
    ego, others = instant.ego, instant.others
    if not others.ids or math.hypot(ego.speed, ego.lateral_speed) < STANDSTILL:
        return NEVER
    moving = (ego.x, ego.y, ego.yaw, ego.speed, ego.lateral_speed, ego.z)
    ahead = context.centre_ahead
    if ego.speed < -STANDSTILL:
        # The mirror image, for which what lies where it drives to is ahead.
        moving = (ego.x, ego.y, ego.yaw + math.pi, -ego.speed, -ego.lateral_speed, ego.z)
        ahead = -ahead
    step: int = first_overlap_step(
        moving,
        context.ego_size,
        ahead,
        off_lane,
        (others.centres, others.yaws, others.sizes, others.velocities),
        np.array([i in hit for i in others.ids]) if hit else np.zeros(len(others.ids), np.bool_),
    )
    return NEVER if step < 0 else step * STEP
