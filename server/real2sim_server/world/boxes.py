"""Boxes in the plane: broad phase, headings, and first contact of moving boxes."""

# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from .._numba import kernel
from ..geometry import MIN_OVERLAP
from .path import Float


@kernel
def shifted(transform, ahead, up):
    """A transform [4, 4] whose origin is moved ``ahead`` and ``up`` along its own axes [m]."""
    found = transform.copy()
    for i in range(3):
        found[i, 3] += transform[i, 0] * ahead + transform[i, 2] * up
    return found


@kernel
def within_reach(T_world_box, size, transforms, sizes):
    """Indices [H] int64 of the boxes, out of K, whose bounding sphere intersects that of one box.

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
    """Conservative test whether a vehicle could touch one of K boxes within a step.

    Compares bounds along the vehicle's heading.

    Args:
        ego: x, y of the box centre [m], yaw [rad], speed, lateral speed [m/s], yaw rate [rad/s];
            at the start of the step.
        size: length and width of its box [m].
        dt: time step [s].
        positions, quaternions, velocities, sizes: [K, 3], [K, 4], [K, 3], [K, 3] float64, boxes at
            the end of the step, world frame [m], [m/s].
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
    """Conservative test whether a vehicle could touch one of K boxes within a step.

    Compares bounds along the vehicle's heading.

    Args:
        ego: x, y of the box centre at the start [m], yaw [rad], maximum displacement along its
            heading and across it [m].
        size: length and width of its box [m].
        rows: [K] int64, row of each box in ``start``; -1 if it was not present.
        start, end: positions [., 3] [m] and quaternions [., 4] of the boxes at the start and end
            of the step; position and yaw are interpolated linearly.
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


# --- First contact -------------------------------------------------------------------------------

# Conservative advancement (Mirtich 1996): two boxes at distance ``d`` whose points move at most
# at relative speed ``u`` cannot touch before ``d / u``. The largest gap along a side normal never
# exceeds ``d``, so time advances by gap / speed until the gap is closed.

WAY = 5
"""Columns of a box motion: fraction of the step, centre x, y [m], yaw [rad], bottom height [m]."""

MAX_PIECES = 64
"""Maximum number of subdivisions of a segment for boxes that overlap in the plane but not in
height."""


@kernel
def first_contacts(way, size, rows, start, end, sizes, slack, tolerance):
    """First contact of a vehicle's box with each of K boxes within a step.

    Args:
        way: [M, 5] float64, motion of the vehicle's box by fraction of the step, linear between
            rows; see ``WAY``. Yaws are continuous.
        size: (length, width, height) of that box [m].
        rows: [K] int64, row of each object in ``start``; -1 if it was not present, in which case
            it stays at its end pose.
        start, end: positions [., 3] [m] and quaternions [., 4] of the objects, world frame.
        sizes: [K, 3] float64 [m].
        slack: margin added to all sides of the vehicle's box [m].
        tolerance: minimum advance between two distance checks [m].

    Returns:
        Fractions [K] float64 of the step, inf without contact; and [K] bool, whether the boxes
        overlap at the end of the step.
    """
    count = len(sizes)
    first, touching = np.full(count, np.inf), np.zeros(count, np.bool_)
    length, width, height = size[0] + 2 * slack, size[1] + 2 * slack, size[2] + 2 * slack
    reach = math.sqrt(length * length + width * width) / 2
    for k in range(count):
        positions, quaternions = end
        bx, by, bz = positions[k, 0], positions[k, 1], positions[k, 2]
        b_yaw = heading(quaternions[k])
        ax, ay, az, a_yaw = bx, by, bz, b_yaw
        if rows[k] >= 0:
            before, before_turned = start
            ax, ay, az = before[rows[k], 0], before[rows[k], 1], before[rows[k], 2]
            a_yaw = heading(before_turned[rows[k]])
        turn = (b_yaw - a_yaw + math.pi) % math.tau - math.pi
        other_reach = math.hypot(sizes[k, 0], sizes[k, 1]) / 2
        for i in range(len(way) - 1):
            f, g = way[i, 0], way[i + 1, 0]
            # Centre of the object relative to the vehicle's, at both ends of this segment.
            px, py = ax + (bx - ax) * f - way[i, 1], ay + (by - ay) * f - way[i, 2]
            qx, qy = ax + (bx - ax) * g - way[i + 1, 1], ay + (by - ay) * g - way[i + 1, 2]
            if _nearest(px, py, qx - px, qy - py) > reach + other_reach:
                continue
            low_p = az + (bz - az) * f - sizes[k, 2] / 2 - way[i, 4] + slack
            low_q = az + (bz - az) * g - sizes[k, 2] / 2 - way[i + 1, 4] + slack
            if min(low_p, low_q) >= height or max(low_p, low_q) + sizes[k, 2] <= 0.0:
                continue
            yaw, yaw_change = way[i, 3], way[i + 1, 3] - way[i, 3]
            other, other_change = a_yaw + turn * f, turn * (g - f)
            if first[k] == np.inf:
                speed = math.hypot(qx - px, qy - py) + abs(yaw_change) * reach
                speed += abs(other_change) * other_reach
                t = 0.0
                while t <= 1.0:
                    gap = _gap(
                        px + (qx - px) * t,
                        py + (qy - py) * t,
                        yaw + yaw_change * t,
                        length,
                        width,
                        other + other_change * t,
                        sizes[k, 0],
                        sizes[k, 1],
                    )
                    step = max(gap, tolerance)
                    if gap < -MIN_OVERLAP:
                        low = low_p + (low_q - low_p) * t
                        if low < height and low + sizes[k, 2] > 0.0:
                            first[k] = f + (g - f) * t
                            break
                        step = max(tolerance, speed / MAX_PIECES)
                    if t == 1.0:
                        break
                    t = min(t + step / speed, 1.0) if speed > 0.0 else 1.0
            if i == len(way) - 2 and low_q < height and low_q + sizes[k, 2] > 0.0:
                gap = _gap(
                    qx,
                    qy,
                    yaw + yaw_change,
                    length,
                    width,
                    b_yaw,
                    sizes[k, 0],
                    sizes[k, 1],
                )
                touching[k] = gap < -MIN_OVERLAP
    return first, touching


@kernel
def _nearest(x, y, dx, dy):
    """Distance [m] from the origin to the segment from (x, y) to (x + dx, y + dy) [m]."""
    squared = dx * dx + dy * dy
    t = min(max(-(x * dx + y * dy) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    return math.hypot(x + dx * t, y + dy * t)


@kernel
def _gap(x, y, yaw, length, width, other_yaw, other_length, other_width):
    """Largest gap [m] of two boxes along a side normal; negative if they overlap.

    (x, y) is the centre of the second box relative to the first.
    """
    cos_a, sin_a = math.cos(yaw), math.sin(yaw)
    cos_b, sin_b = math.cos(other_yaw), math.sin(other_yaw)
    c, s = abs(cos_a * cos_b + sin_a * sin_b), abs(sin_b * cos_a - cos_b * sin_a)
    la, wa, lb, wb = length / 2, width / 2, other_length / 2, other_width / 2
    return max(
        abs(x * cos_a + y * sin_a) - la - lb * c - wb * s,
        abs(y * cos_a - x * sin_a) - wa - lb * s - wb * c,
        abs(x * cos_b + y * sin_b) - lb - la * c - wa * s,
        abs(y * cos_b - x * sin_b) - wb - la * s - wa * c,
    )


@kernel
def first_occupied(way, size, spacing, origin, cell, occupied, sums):
    """First overlap of a vehicle's box with an occupied grid cell within a step.

    Args:
        way: [M, 5] float64, as in :func:`first_contacts`.
        size: (length, width, height) of that box [m].
        spacing: distance of the sample points in the box, and maximum motion of its corners between
            two checks [m].
        origin: [2] float64, lowest corner of the grid [m].
        cell: edge length of a cell [m].
        occupied: [nx, ny] bool.
        sums: [nx + 1, ny + 1] int64, summed-area table of ``occupied``.

    Returns:
        Fraction of the step, inf without overlap; mean position x, y [m] of the hit cells; and
        whether the box overlaps an occupied cell at the end.
    """
    half = math.hypot(size[0], size[1]) / 2
    first, at_x, at_y, touching = np.inf, 0.0, 0.0, False
    for i in range(len(way) - 1):
        last = i == len(way) - 2
        dx, dy = way[i + 1, 1] - way[i, 1], way[i + 1, 2] - way[i, 2]
        turn = way[i + 1, 3] - way[i, 3]
        low_x, high_x = min(way[i, 1], way[i + 1, 1]) - half, max(way[i, 1], way[i + 1, 1]) + half
        low_y, high_y = min(way[i, 2], way[i + 1, 2]) - half, max(way[i, 2], way[i + 1, 2]) + half
        if not _any_occupied(low_x, high_x, low_y, high_y, origin, cell, sums):
            continue
        if first == np.inf:
            looks = max(math.ceil((math.hypot(dx, dy) + abs(turn) * half) / spacing), 1)
            for n in range(looks + 1):
                t = n / looks
                hits, x, y = _hits(
                    way[i, 1] + dx * t,
                    way[i, 2] + dy * t,
                    way[i, 3] + turn * t,
                    size,
                    spacing,
                    origin,
                    cell,
                    occupied,
                )
                if hits:
                    first, at_x, at_y = way[i, 0] + (way[i + 1, 0] - way[i, 0]) * t, x, y
                    break
        if last:
            hits, x, y = _hits(
                way[i + 1, 1], way[i + 1, 2], way[i + 1, 3], size, spacing, origin, cell, occupied
            )
            touching = hits > 0
    return first, at_x, at_y, touching


@kernel
def holds_any(way, reach, origin, cell, sums):
    """Whether the bounds of a motion, grown by ``reach`` [m], contain an occupied cell.

    See :func:`first_occupied`.
    """
    return _any_occupied(
        way[:, 1].min() - reach,
        way[:, 1].max() + reach,
        way[:, 2].min() - reach,
        way[:, 2].max() + reach,
        origin,
        cell,
        sums,
    )


@kernel
def _any_occupied(low_x, high_x, low_y, high_y, origin, cell, sums):
    """Whether an axis-aligned rectangle [m] contains an occupied cell."""
    nx, ny = sums.shape[0] - 1, sums.shape[1] - 1
    a = min(max(math.floor((low_x - origin[0]) / cell), 0), nx)
    b = min(max(math.floor((high_x - origin[0]) / cell) + 1, 0), nx)
    c = min(max(math.floor((low_y - origin[1]) / cell), 0), ny)
    d = min(max(math.floor((high_y - origin[1]) / cell) + 1, 0), ny)
    return sums[b, d] - sums[a, d] - sums[b, c] + sums[a, c] > 0


@kernel
def _hits(x, y, yaw, size, spacing, origin, cell, occupied):
    """Number of sample points of a box in occupied cells, and their mean position [m]."""
    rows = max(math.ceil(size[0] / spacing), 1) + 1
    columns = max(math.ceil(size[1] / spacing), 1) + 1
    cos, sin = math.cos(yaw), math.sin(yaw)
    hits, sum_x, sum_y = 0, 0.0, 0.0
    for i in range(rows):
        u = size[0] * (i / (rows - 1) - 0.5)
        for j in range(columns):
            v = size[1] * (j / (columns - 1) - 0.5)
            px, py = x + u * cos - v * sin, y + u * sin + v * cos
            a = math.floor((px - origin[0]) / cell)
            b = math.floor((py - origin[1]) / cell)
            inside = 0 <= a < occupied.shape[0] and 0 <= b < occupied.shape[1]
            if inside and occupied[a, b]:
                hits, sum_x, sum_y = hits + 1, sum_x + px, sum_y + py
    return hits, sum_x / max(hits, 1), sum_y / max(hits, 1)


# --- Ego box -------------------------------------------------------------------------------------

REAR_OVERHANG = 0.95
"""Distance from the rear axle to the rear end of the ego box [m]. Recordings store the box size,
but not the position of the axle; 0.95 m is usual for passenger cars between 4.3 and 4.9 m long."""


def ego_box(T_world_vehicle: Float, size: tuple[float, float, float]) -> Float:
    """``T_world_box`` [4, 4] of the ego box, whose bottom is on the ground."""
    length, _, height = size
    T_world_box: Float = shifted(T_world_vehicle, length / 2 - REAR_OVERHANG, height / 2)
    return T_world_box
