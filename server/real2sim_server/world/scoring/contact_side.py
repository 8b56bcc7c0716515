"""The side of the ego on which a contact began."""

from __future__ import annotations

import math

from .hazard_kernels import BEHIND
from .instant import Side

STOPPED = 5e-2
"""Speed at which a vehicle counts as stopped (nuPlan) [m/s]."""


def side_of_contact(
    ego_box: tuple[float, float, float, float, float],
    ego_speed: float,
    box: tuple[float, float, float, float, float],
    speed: float,
    *,
    axle: float,
    reversing: bool = False,
) -> Side:
    """The side of the ego on which two boxes came into contact, after nuPlan's ``CollisionType``.

    Args:
        ego_box, box: centre x, y [m], yaw [rad], length, width [m].
        ego_speed, speed: before the contact, along and across [m/s].
        axle: from the middle of the ego box back to the rear axle, from which what is behind is
            seen [m].
        reversing: whether the ego drives in reverse gear: its tail is then what runs into things,
            as its front does otherwise.
    """
    if abs(ego_speed) <= STOPPED:
        return "stopped_ego"
    if abs(speed) <= STOPPED:
        return "stopped_track"
    x, y, yaw, length, width = ego_box
    if reversing:
        yaw += math.pi
    cos, sin = math.cos(yaw), math.sin(yaw)
    bearing = math.atan2(box[1] - y + axle * sin, box[0] - x + axle * cos) - yaw
    if abs(math.remainder(bearing, math.tau)) > BEHIND:
        return "rear"
    half = width / 2
    bumper = [
        (x + u * cos - v * sin, y + u * sin + v * cos)
        for u, v in ((length / 2, half), (length / 2, -half))
    ]
    return "front" if _segment_intersects(bumper[0], bumper[1], box) else "lateral"


def _segment_intersects(
    a: tuple[float, float], b: tuple[float, float], box: tuple[float, float, float, float, float]
) -> bool:
    """Whether a segment intersects a box: clipped against its two slabs."""
    x, y, yaw, length, width = box
    cos, sin = math.cos(yaw), math.sin(yaw)
    first, last = 0.0, 1.0
    for axis_x, axis_y, half in ((cos, sin, length / 2), (-sin, cos, width / 2)):
        p = (a[0] - x) * axis_x + (a[1] - y) * axis_y
        q = (b[0] - x) * axis_x + (b[1] - y) * axis_y
        if abs(q - p) < 1e-12:
            if abs(p) > half:
                return False
            continue
        enter, leave = sorted(((-half - p) / (q - p), (half - p) / (q - p)))
        first, last = max(first, enter), min(last, leave)
    return first <= last
