"""Boxes on the plane, many at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..path import Float
from .instant import EgoSample, Instant, Others, ScoringContext, Side

AHEAD, BEHIND = math.radians(30), math.radians(150)
"""Bearings within which an object counts as ahead, beyond which as behind (nuPlan)."""

STOPPED = 5e-2
"""Speed at which a vehicle counts as stopped (nuPlan) [m/s]."""


def ego_centre(ego: EgoSample, context: ScoringContext) -> Float:
    """Centre [2] of the ego box [m]."""
    ahead = context.centre_ahead
    return np.array([ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)])


def ego_corners(ego: EgoSample, context: ScoringContext) -> Float:
    """Corners [4, 2] of the ego box [m]: front left, front right, rear right, rear left."""
    length, width, _ = context.ego_size
    u, v = length / 2, width / 2
    local = np.array([[u, v], [u, -v], [-u, -v], [-u, v]])
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    corners: Float = local @ np.array([[cos, sin], [-sin, cos]]) + ego_centre(ego, context)
    return corners


def on_level(instant: Instant, context: ScoringContext) -> NDArray[np.bool_]:
    """Which objects stand on the ego's level, not on a bridge above it."""
    others, bottom = instant.others, instant.ego.z
    low = others.centres[:, 2] - others.sizes[:, 2] / 2
    level: NDArray[np.bool_] = (low < bottom + context.ego_size[2]) & (
        low + others.sizes[:, 2] > bottom
    )
    return level


def bearings(ego: EgoSample, others: Others) -> Float:
    """Angles [K] from the ego's heading to the centres of objects, seen from its rear axle."""
    dx, dy = others.centres[:, 0] - ego.x, others.centres[:, 1] - ego.y
    angles: Float = np.abs(np.remainder(np.arctan2(dy, dx) - ego.yaw + math.pi, math.tau) - math.pi)
    return angles


class MovingBoxes(NamedTuple):
    """K boxes over T times: centres [K, T, 2] [m], yaws [K] [rad], sizes [K, 2] [m]."""

    centres: Float
    yaws: Float
    sizes: Float


def overlap(
    centres: Float, yaw: float, size: tuple[float, float], others: MovingBoxes
) -> NDArray[np.bool_]:
    """Whether one box over T times overlaps others on the plane, [K, T]: separating axes.

    Args:
        centres: [T, 2] of the box [m].
        yaw: of it [rad].
        size: its length and width [m].
        others: at the same times.
    """
    d = others.centres - centres
    cos_a, sin_a = math.cos(yaw), math.sin(yaw)
    cos_b, sin_b = np.cos(others.yaws)[:, None], np.sin(others.yaws)[:, None]
    turn = others.yaws - yaw
    c, s = np.abs(np.cos(turn))[:, None], np.abs(np.sin(turn))[:, None]
    (la, wa), lb, wb = size, others.sizes[:, :1], others.sizes[:, 1:2]
    along_a = np.abs(d[..., 0] * cos_a + d[..., 1] * sin_a) < (la + lb * c + wb * s) / 2
    across_a = np.abs(d[..., 1] * cos_a - d[..., 0] * sin_a) < (wa + lb * s + wb * c) / 2
    along_b = np.abs(d[..., 0] * cos_b + d[..., 1] * sin_b) < (lb + la * c + wa * s) / 2
    across_b = np.abs(d[..., 1] * cos_b - d[..., 0] * sin_b) < (wb + la * s + wa * c) / 2
    hit: NDArray[np.bool_] = along_a & across_a & along_b & across_b
    return hit


def side_of_contact(
    ego_box: tuple[float, float, float, float, float],
    ego_speed: float,
    box: tuple[float, float, float, float, float],
    speed: float,
) -> Side:
    """How two boxes met, after nuPlan's ``CollisionType``.

    Args:
        ego_box, box: centre x, y [m], yaw [rad], length, width [m].
        ego_speed, speed: before they met [m/s].
    """
    if abs(ego_speed) <= STOPPED:
        return "stopped_ego"
    if abs(speed) <= STOPPED:
        return "stopped_track"
    x, y, yaw, length, width = ego_box
    cos, sin = math.cos(yaw), math.sin(yaw)
    bearing = math.atan2(box[1] - y, box[0] - x) - yaw
    if abs(math.remainder(bearing, math.tau)) > BEHIND:
        return "rear"
    half = width / 2
    bumper = [
        (x + u * cos - v * sin, y + u * sin + v * cos)
        for u, v in ((length / 2, half), (length / 2, -half))
    ]
    return "front" if _segment_meets(bumper[0], bumper[1], box) else "lateral"


def _segment_meets(
    a: tuple[float, float], b: tuple[float, float], box: tuple[float, float, float, float, float]
) -> bool:
    """Whether a segment meets a box: clipped against its two slabs."""
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
