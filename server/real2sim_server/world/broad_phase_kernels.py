"""Broad phase of the ego box against boxes of objects, and headings, each in one call."""
# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from .._numba import kernel


@kernel
def shifted(transform, ahead, up):
    """A transform [4, 4] whose origin is moved ``ahead`` and ``up`` along its own axes [m]."""
    found = transform.copy()
    for i in range(3):
        found[i, 3] += transform[i, 0] * ahead + transform[i, 2] * up
    return found


@kernel
def within_reach(T_world_box, size, transforms, sizes):
    """Numbers [H] int64 of the boxes whose enclosing sphere intersects that of one box, of K boxes.

    Args:
        T_world_box: [4, 4] float64.
        size: (length, width, height) of that box [m].
        transforms: [K, 4, 4] float64, ``T_world_object``.
        sizes: [K, 3] float64 [m].
    """
    near, count = np.empty(len(transforms), np.int64), 0
    diagonal = math.sqrt(size[0] * size[0] + size[1] * size[1] + size[2] * size[2])
    for k in range(len(transforms)):
        between = squares = 0.0
        for i in range(3):
            apart = transforms[k, i, 3] - T_world_box[i, 3]
            between += apart * apart
            squares += sizes[k, i] * sizes[k, i]
        reach = (diagonal + math.sqrt(squares)) / 2
        if between < reach * reach:
            near[count] = k
            count += 1
    return near[:count]


@kernel
def may_overlap(ego, size, dt, positions, quaternions, velocities, sizes):
    """Whether a vehicle could touch one of K boxes within a step, by boxes along its heading.

    Args:
        ego: x, y of the middle of its box [m], yaw [rad], speed, lateral speed [m/s], yaw rate
            [rad/s]; at the start of the step.
        size: length and width of its box [m].
        dt: the step [s].
        positions, quaternions, velocities, sizes: [K, 3], [K, 4], [K, 3], [K, 3] float64, of the
            boxes at the end of the step, world [m], [m/s].
    """
    x, y, yaw, forward, lateral, yaw_rate = ego
    cos, sin = math.cos(yaw), math.sin(yaw)
    speed = math.hypot(forward, lateral)
    # The vehicle may turn, brake or speed up within the step.
    drift = dt * (0.15 * speed + abs(lateral) + abs(yaw_rate) * size[0])
    for k in range(len(positions)):
        dx, dy = positions[k, 0] - x, positions[k, 1] - y
        vx, vy = velocities[k, 0], velocities[k, 1]
        turned = heading(quaternions[k]) - yaw
        c, s = abs(math.cos(turned)), abs(math.sin(turned))
        half_length, half_width = sizes[k, 0] / 2, sizes[k, 1] / 2
        slack_along = dt * (speed + abs(vx * cos + vy * sin) + 2.0) + 0.3
        slack_aside = drift + dt * abs(vy * cos - vx * sin) + 0.3
        along = size[0] / 2 + half_length * c + half_width * s + slack_along
        aside = size[1] / 2 + half_length * s + half_width * c + slack_aside
        if abs(dx * cos + dy * sin) < along and abs(dy * cos - dx * sin) < aside:
            return True
    return False


@kernel
def may_meet_any(ego, size, rows, start, end, sizes):
    """Whether a vehicle could touch one of K boxes within a step, by boxes along its heading.

    Args:
        ego: x, y of the middle of its box at the start [m], yaw [rad], how far it may get along
            its heading and across it [m].
        size: length and width of its box [m].
        rows: [K] int64, where each box stands in ``start``; -1 where it was not there.
        start, end: positions [., 3] [m] and quaternions [., 4] of the boxes at the start and the
            end of the step; in between they go straight and turn evenly.
        sizes: [K, 3] float64 [m].
    """
    x, y, yaw, far, aside = ego
    cos, sin = math.cos(yaw), math.sin(yaw)
    for k in range(len(rows)):
        positions, quaternions = end
        dx, dy = positions[k, 0] - x, positions[k, 1] - y
        along = low_along = high_along = dx * cos + dy * sin
        across = low_across = high_across = dy * cos - dx * sin
        turned = heading(quaternions[k]) - yaw
        c, s = abs(math.cos(turned)), abs(math.sin(turned))
        if rows[k] >= 0:
            before, before_turned = start
            dx, dy = before[rows[k], 0] - x, before[rows[k], 1] - y
            along, across = dx * cos + dy * sin, dy * cos - dx * sin
            low_along, high_along = min(low_along, along), max(high_along, along)
            low_across, high_across = min(low_across, across), max(high_across, across)
            if abs(heading(before_turned[rows[k]]) - yaw - turned) > 1e-9:
                c = s = 1.0
        length, width = sizes[k, 0], sizes[k, 1]
        reach_along = (size[0] + length * c + width * s) / 2 + far
        reach_across = (size[1] + length * s + width * c) / 2 + aside
        if (
            low_along < reach_along
            and high_along > -reach_along
            and low_across < reach_across
            and high_across > -reach_across
        ):
            return True
    return False


@kernel
def headings(quaternions):
    """Headings [K] [rad] of quaternions [K, 4] wxyz, as ``geometry.rotation.quaternion_yaw``."""
    found = np.empty(len(quaternions))
    for k in range(len(quaternions)):
        found[k] = heading(quaternions[k])
    return found


@kernel
def heading(quaternion):
    """Heading [rad] in (-pi, pi] of a quaternion [4] wxyz."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
