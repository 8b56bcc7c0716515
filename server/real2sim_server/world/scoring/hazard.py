"""Time to collision by constant velocity."""

from __future__ import annotations

import math

import numpy as np

from .boxes import AHEAD, BEHIND, MovingBoxes, bearings, ego_centre, on_level, overlap
from .instant import Instant, ScoringContext

HORIZON, STEP = 3.0, 0.1
TIMES = np.arange(0, round(HORIZON / STEP) + 1) * STEP
STANDSTILL = 5e-3
"""Below this speed nobody asks for the time to collision (NAVSIM) [m/s]."""

NEVER = math.inf


def time_to_collision(
    instant: Instant, context: ScoringContext, *, off_lane: bool, hit: frozenset[str]
) -> float:
    """First time [s] in steps of 0.1 s up to 3 s at which the ego box meets an object's.

    All keep their velocities. Objects ahead count; when the ego is in several lanes or off the
    road, all that are not behind it (nuPlan, NAVSIM).

    Args:
        instant: now.
        context: the ego's size.
        off_lane: whether the ego is in several lanes or off the road.
        hit: objects it is in contact with already, which do not count.
    """
    ego, others = instant.ego, instant.others
    if not others.ids or math.hypot(ego.speed, ego.lateral_speed) < STANDSTILL:
        return NEVER
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    velocity = np.array(
        [ego.speed * cos - ego.lateral_speed * sin, ego.speed * sin + ego.lateral_speed * cos]
    )
    centre = ego_centre(ego, context)
    reach = (math.hypot(*context.ego_size[:2]) + np.hypot(*others.sizes[:, :2].T)) / 2
    near = _closest(others.centres[:, :2] - centre, others.velocities - velocity) < reach
    if not near.any():
        return NEVER
    angles = bearings(ego, others)
    asked = near & ((angles < AHEAD) | (off_lane & (angles <= BEHIND)))
    asked &= on_level(instant, context)
    asked &= np.array([i not in hit for i in others.ids])
    rows = np.flatnonzero(asked)
    if not len(rows):
        return NEVER
    moved = others.centres[rows, None, :2] + others.velocities[rows, None] * TIMES[:, None]
    boxes = MovingBoxes(moved, others.yaws[rows], others.sizes[rows, :2])
    centres = centre + velocity * TIMES[:, None]
    meets = overlap(centres, ego.yaw, context.ego_size[:2], boxes).any(axis=0)
    return float(TIMES[meets.argmax()]) if meets.any() else NEVER


def _closest(apart: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Smallest distance [K] [m] of points apart [K, 2] that move relatively [K, 2] for 3 s."""
    squared = np.maximum((relative * relative).sum(axis=1), 1e-12)
    t = np.clip(-(apart * relative).sum(axis=1) / squared, 0.0, HORIZON)
    return np.hypot(*(apart + relative * t[:, None]).T)
