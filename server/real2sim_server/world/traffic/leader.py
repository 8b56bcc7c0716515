"""Who is ahead on a path."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...scene.rotation import quaternion_yaw
from ..path import Float, LoggedPath
from .driver import Surroundings

REACH = 80.0
SPACING = 1.0
SIDE = 0.3
"""Room beside an object that counts as in the way [m]."""


class Leader(NamedTuple):
    """The nearest body ahead: bumper to bumper [m], and its speed along the path [m/s]."""

    gap: float
    speed: float


def leader_on(
    path: LoggedPath,
    s: float,
    *,
    offset: float,
    length: float,
    width: float,
    object_id: str,
    seen: Surroundings,
) -> Leader | None:
    """The body that is next in the strip an object sweeps along a path.

    Args:
        path: of the object.
        s, offset: of its centre along the path, and from it [m].
        length, width: of its box [m].
        object_id: of the object, which is not its own leader.
        seen: everybody.
    """
    centres, yaws, sizes, velocities = _bodies(seen, object_id)
    at = s + np.arange(0.0, REACH, SPACING)
    x, y, heading = _strip(path, at, offset)
    apart = (centres[:, 0, None] - x) ** 2 + (centres[:, 1, None] - y) ** 2
    nearest = apart.argmin(axis=1)
    dx, dy = centres[:, 0] - x[nearest], centres[:, 1] - y[nearest]
    cos, sin = np.cos(heading[nearest]), np.sin(heading[nearest])
    along, aside = dx * cos + dy * sin, dy * cos - dx * sin
    turned = yaws - heading[nearest]
    c, n = np.abs(np.cos(turned)), np.abs(np.sin(turned))
    half_along = (sizes[:, 0] * c + sizes[:, 1] * n) / 2
    half_aside = (sizes[:, 0] * n + sizes[:, 1] * c) / 2
    gaps = nearest * SPACING + along - length / 2 - half_along
    in_way = np.abs(aside) < width / 2 + half_aside + SIDE
    # Bodies whose centre is beside or behind the own one are not followed.
    ahead = (nearest * SPACING + along > 0.5) & (nearest < len(at) - 1)
    found = np.flatnonzero(in_way & ahead)
    if not len(found):
        return None
    k = int(found[gaps[found].argmin()])
    return Leader(float(gaps[k]), float(velocities[k, 0] * cos[k] + velocities[k, 1] * sin[k]))


def _bodies(seen: Surroundings, object_id: str) -> tuple[Float, Float, Float, Float]:
    ego, others = seen.ego, seen.others
    keep = np.array([o.object_id != object_id for o in others.objects], dtype=bool)
    own = np.array([ego.x, ego.y])
    moving = ego.speed * np.array([math.cos(ego.yaw), math.sin(ego.yaw)])
    return (
        np.vstack([others.positions[keep, :2], own]),
        np.append(quaternion_yaw(others.quaternions[keep]), ego.yaw),
        np.vstack([others.sizes[keep, :2], [ego.length, ego.width]]),
        np.vstack([others.velocities[keep, :2], moving]),
    )


def _strip(path: LoggedPath, at: Float, offset: float) -> tuple[Float, Float, Float]:
    x = np.interp(at, path.s, path.positions[:, 0])
    y = np.interp(at, path.s, path.positions[:, 1])
    heading: Float = np.interp(at, path.s, path.yaws)
    cos, sin = np.cos(heading), np.sin(heading)
    beyond = np.maximum(at - path.length, 0.0)
    return x + beyond * cos - offset * sin, y + beyond * sin + offset * cos, heading
