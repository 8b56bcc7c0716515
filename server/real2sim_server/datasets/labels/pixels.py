"""Compiled per-pixel operations of labels: the visible surface, and its flow."""

# Kernels take arrays by position.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from real2sim_proto.conventions import GROUND, STATIC

from ..._numba import PARALLEL_LOOPS, func, kernel

F32 = np.float32
BODY = 25
"""Number of values of a body, see is_surface and shows_surface."""

TOLERANCE = 0.15
"""Maximum distance from the ground's height of pixels that show the ground [m]."""

UNDER_BODY = 0.6
"""Maximum height of a shadow above the ground [m], the height of the body's underside. Higher
pixels of an object outside its body are background behind it.
"""

AROUND = 1.0
"""Margin around a box in which LiDAR surfaces decide between the object and the ground [m]."""

TYRE = 0.24
"""Width of the wheels, from the sides of the box inwards [m]."""

ROUNDED = 0.06
"""Rounding of a vehicle's lower sides and corners inside its box [m]."""

SEEN_FARTHER = 0.05
"""Additional tolerance outside the box for a pixel's point [m]; subtracted for its ray."""

NO_STEP = 1e-9
"""Minimum length to which rays are extended [m]."""

FLATTEST = 0.01
"""Minimum descent per metre of depth of rays that are followed to the ground."""

MET = 0.05
"""Tolerance in height from the second step towards the ground on [m]."""

BEHIND = F32(1e-3)
"""Minimum depth in the other camera; nearer points count as behind it [m]."""

SAME_SURFACE, SLACK = F32(0.03), F32(0.05)
"""Maximum depth difference of a point that is visible in the other image: relative, plus absolute
[m]."""


@func(inline="always")
def is_surface(body: Any, x: float, y: float, z: float) -> bool:
    """Whether a point of the world belongs to a body and not to its shadow.

    Args:
        body: at least 21 numbers: ``T_object_world`` [3, 4]; half length, width and height; margin
            about the box; lowest point of the surface; sill, below which there are only wheels;
            and wheels: their inner lateral limit, and their range in front of and behind the
            centre [m].
        x, y, z: point in the world [m].
    """
    a = abs(body[0] * x + body[1] * y + body[2] * z + body[3])
    b = abs(body[4] * x + body[5] * y + body[6] * z + body[7])
    c = body[8] * x + body[9] * y + body[10] * z + body[11]
    if a > body[12] + body[15] or b > body[13] + body[15] or c > body[14] + body[15]:
        return False
    if c < body[16]:
        return False
    if c < body[17]:
        return b > body[18] and body[19] < a < body[20]
    return True


@func(inline="always")
def within(a: float, b: float, reach: float, other: float, from_a: float, from_b: float) -> Any:
    """Fractions along a segment from ``from`` through (a, b) between which it is inside a rectangle
    of half sizes ``reach`` and ``other``; the first is larger if it is never inside.
    """
    first, last = 0.0, 1e9
    for size, start, end in ((reach, from_a, a), (other, from_b, b)):
        step = end - start
        step = step if abs(step) > NO_STEP else NO_STEP
        one, two = (-size - start) / step, (size - start) / step
        first, last = max(first, min(one, two)), min(last, max(one, two))
    return first, last


@func(inline="always")
def meets_wheel(body: Any, a: float, b: float, c: float, fa: float, fb: float, fc: float) -> bool:
    """Whether the ray from (fa, fb, fc) through (a, b, c) hits one of a body's four tyres."""
    radius = body[22]
    up, along, across = c - fc, a - fa, b - fb
    across = across if abs(across) > NO_STEP else NO_STEP
    squared = along * along + up * up
    above = fc + body[14] - radius
    for side in (-1.0, 1.0):
        one = (side * body[13] - fb) / across
        two = (side * (body[13] - TYRE) - fb) / across
        first, last = max(min(one, two), 0.0), max(one, two)
        for end in (-1.0, 1.0):
            ahead = fa - (body[23] if end > 0 else -body[24])
            half = ahead * along + above * up
            root = half * half - squared * (ahead * ahead + above * above - radius * radius)
            if root <= 0:
                continue
            root = math.sqrt(root)
            if max(first, (-half - root) / squared) < min(last, (-half + root) / squared):
                return True
    return False


@func(inline="always")
def shows_surface(
    body: Any, x: float, y: float, z: float, from_x: float, from_y: float, from_z: float
) -> bool:
    """Whether a ray that ends at a point of the world shows a body there and not its shadow.

    The point of a pixel below a vehicle is only accurate to decimetres: at a grazing angle, the
    road appears just below the sill. The point at which the ray enters below the sides is as
    accurate as the box.

    Args:
        body: as in is_surface; and from [21] the sill of vehicles with wheels, 0 for other bodies,
            radius of the wheels, and distance of their axles in front of and behind the centre [m].
        x, y, z: point in the world [m].
        from_x, from_y, from_z: position of the camera [m].
    """
    if body[21] <= 0:
        return is_surface(body, x, y, z)
    a = body[0] * x + body[1] * y + body[2] * z + body[3]
    b = body[4] * x + body[5] * y + body[6] * z + body[7]
    c = body[8] * x + body[9] * y + body[10] * z + body[11]
    far = body[15] + SEEN_FARTHER
    if abs(a) > body[12] + far or abs(b) > body[13] + far or c > body[14] + far:
        return False
    fa = body[0] * from_x + body[1] * from_y + body[2] * from_z + body[3]
    fb = body[4] * from_x + body[5] * from_y + body[6] * from_z + body[7]
    fc = body[8] * from_x + body[9] * from_y + body[10] * from_z + body[11]
    slack = body[15] - SEEN_FARTHER
    first, last = within(a, b, body[12] + slack, body[13] + slack, fa, fb)
    if first >= last or min(fc + first * (c - fc), fc + last * (c - fc)) > body[14] + slack:
        return False
    first, last = within(a, b, body[12] - ROUNDED, body[13] - ROUNDED, fa, fb)
    entry = fc + first * (c - fc) if first < last else c
    if (entry + c) / 2 + body[14] > body[21]:
        return True
    return meets_wheel(body, a, b, c, fa, fb, fc)


@func(inline="always")
def near_footprint(body: Any, x: float, y: float, z: float) -> bool:
    """Whether a point of the world is above or below a body's footprint, extended by AROUND.

    The ground that beams hit through a vehicle's windows is farther away.
    """
    a = body[0] * x + body[1] * y + body[2] * z + body[3]
    b = body[4] * x + body[5] * y + body[6] * z + body[7]
    return abs(a) < body[12] + AROUND and abs(b) < body[13] + AROUND


@kernel(parallel=PARALLEL_LOOPS)
def tell_apart(
    depth, instance, semantic, rays, slots, bodies, classes, behind, lidar, heights, frame
):
    """Write the semantic image, and correct depth and instance image; shadows of objects become
    ground.

    A pixel of an object shows its shadow where LiDAR surfaces are ground near its footprint.
    Where they are the same object, they also give its depth. Elsewhere the object's body decides.

    Args:
        depth: [H, W] float32 [m], 0 for empty pixels; changed to the depth of LiDAR surfaces of the
            same object, and of ``heights`` on the ground.
        instance: [H, W] uint16, changed.
        semantic: [H, W] uint8, written.
        rays: [3, 4] float64: a pixel (x, y) of depth d is at d * rays[:, :3] @ (x, y, 1)
            + rays[:, 3] in the world.
        slots: [65536] int16, body of an instance id, -1 for none.
        bodies: [K, BODY] see shows_surface.
        classes: [65536] uint8, by instance id.
        behind: class of empty pixels.
        lidar: depth and instance images of LiDAR surfaces, or two images of no pixels.
        heights, frame: grid of the ground.
    """
    x0, y0, per_cell = frame[0], frame[1], 1.0 / frame[2]
    lidar_depth, lidar_instance = lidar
    for row in prange(depth.shape[0]):
        v = row + 0.5
        for column in range(depth.shape[1]):
            d = np.float64(depth[row, column])
            if d == 0:
                semantic[row, column] = behind
                continue
            u = column + 0.5
            across = rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]
            along = rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]
            slope = rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]
            number = instance[row, column]
            found, slot = classes[number], slots[number]
            same, shadow = False, False
            measured = np.float64(lidar_depth[row, column]) if lidar_depth.shape[0] else 0.0
            if measured > 0:
                other = lidar_instance[row, column]
                same = other == number
                if slot >= 0 and other == 0:
                    x, y = measured * across + rays[0, 3], measured * along + rays[1, 3]
                    z = measured * slope + rays[2, 3]
                    above = z - height_over(heights, x0, y0, per_cell, x, y)
                    shadow = abs(above) < TOLERANCE and near_footprint(bodies[slot], x, y, z)
                if same or shadow:
                    d = measured
                    depth[row, column] = d
            x, y = d * across + rays[0, 3], d * along + rays[1, 3]
            z = d * slope + rays[2, 3]
            if slot >= 0 and not shadow:
                body = bodies[slot]
                low = body[8] * x + body[9] * y + body[10] * z + body[11] < body[16]
                shown = shows_surface(body, x, y, z, rays[0, 3], rays[1, 3], rays[2, 3])
                shadow = low if same else not shown
            if shadow:
                instance[row, column], found = 0, STATIC
            if shadow or found == STATIC:
                above = z - height_over(heights, x0, y0, per_cell, x, y)
                if abs(above) < (UNDER_BODY if shadow else TOLERANCE):
                    found = GROUND
                if found == GROUND and slope < -FLATTEST:
                    # The ground is more accurate than rendered surfaces (1 cm against several):
                    # along a road, a centimetre of height is a decimetre of depth.
                    steepness = 1.0 / slope
                    met = d - above * steepness
                    x, y = met * across + rays[0, 3], met * along + rays[1, 3]
                    height = height_over(heights, x0, y0, per_cell, x, y)
                    miss = met * slope + rays[2, 3] - height
                    if abs(miss) < MET and met > 0:
                        depth[row, column] = met - miss * steepness
            semantic[row, column] = found


@func(inline="always")
def height_over(heights: Any, x0: float, y0: float, per_cell: float, x: float, y: float) -> float:
    """Like height_under, with the inverse of the cell size."""
    rows, columns = heights.shape
    u = min(max((x - x0) * per_cell, 0.0), rows - 1.0)
    v = min(max((y - y0) * per_cell, 0.0), columns - 1.0)
    i, j = min(np.uint64(u), np.uint64(rows - 2)), min(np.uint64(v), np.uint64(columns - 2))
    a, b = u - i, v - j
    one = np.uint64(1)
    low = heights[i, j] + (heights[i + one, j] - heights[i, j]) * a
    high = heights[i, j + one] + (heights[i + one, j + one] - heights[i, j + one]) * a
    return low + (high - low) * b


@kernel
def surface_mask(depth, left, top, rays, body, mask):
    """Write to ``mask`` [h, w] uint8 where a window [h, w] of depths shows a body's surface."""
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            d = np.float64(depth[row, column])
            u, v = column + left + 0.5, row + top + 0.5
            x = d * (rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]) + rays[0, 3]
            y = d * (rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]) + rays[1, 3]
            z = d * (rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]) + rays[2, 3]
            mask[row, column] = d > 0 and shows_surface(
                body, x, y, z, rays[0, 3], rays[1, 3], rays[2, 3]
            )


@kernel
def on_bodies(points, body, found):
    """Write to ``found`` [N] bool whether world points [N, 3] belong to a body."""
    for k in range(points.shape[0]):
        found[k] = is_surface(body, points[k, 0], points[k, 1], points[k, 2])


@kernel(parallel=PARALLEL_LOOPS)
def carry(depth, instance, slots, motions, there, flow, valid, occluded):
    """Flow of each pixel, its validity, and whether the other image shows something else.

    Args:
        depth: [H, W] float32 [m], 0 for infinity.
        instance: [H, W] uint16.
        slots: [65536] int16, motion of an instance id, 0 for static, -1 for absent in the other
            image.
        motions: [K, 3, 4] float32, K_there times T_there_here, so that a pixel (x, y) of depth d is
            at d * motion[:, :3] @ (x, y, 1) + motion[:, 3] there, times its depth.
        there: lowest and highest depth about each pixel of the other image [H, W] float32, and its
            instances.
        flow, valid, occluded: [H, W, 2] float32, [H, W] bool twice, written.
    """
    low, high, shown = there
    height, width = low.shape
    still = motions[0]
    for row in prange(depth.shape[0]):
        v = F32(row) + F32(0.5)
        # Positions under the assumption of a static scene, in a branch-free loop.
        places = np.empty((3, depth.shape[1]), np.float32)
        xs, ys, zs = places[0], places[1], places[2]
        first = still[0, 1] * v + still[0, 2]
        second = still[1, 1] * v + still[1, 2]
        third = still[2, 1] * v + still[2, 2]
        for column in range(depth.shape[1]):
            u, d = F32(column) + F32(0.5), depth[row, column]
            near = F32(1) if d > 0 else F32(0)
            d = d if d > 0 else F32(1)
            z = (still[2, 0] * u + third) * d + still[2, 3] * near
            one = F32(1) / z
            xs[column] = ((still[0, 0] * u + first) * d + still[0, 3] * near) * one
            ys[column] = ((still[1, 0] * u + second) * d + still[1, 3] * near) * one
            zs[column] = z
        for column in range(depth.shape[1]):
            number = instance[row, column]
            u, d = F32(column) + F32(0.5), depth[row, column]
            x, y, z = xs[column], ys[column], zs[column]
            slot = slots[number]
            if slot > 0:
                m = motions[slot]
                z = (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * d + m[2, 3]
                x = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) * d + m[0, 3]) / z
                y = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) * d + m[1, 3]) / z
            good = slot >= 0 and z > BEHIND
            valid[row, column] = good
            flow[row, column, 0] = x - u if good else F32(0)
            flow[row, column, 1] = y - v if good else F32(0)
            hidden = good
            if good and x >= 0 and x < width and y >= 0 and y < height:
                i, j = np.uint64(y), np.uint64(x)
                slack = SAME_SURFACE * z + SLACK
                z = z if d > 0 else F32(0)
                slack = slack if d > 0 else F32(0)
                same = low[i, j] - slack <= z <= high[i, j] + slack
                # Sky has sky around it; nothing else has depth 0.
                hidden = not (same and shown[i, j] == number)
            occluded[row, column] = hidden
