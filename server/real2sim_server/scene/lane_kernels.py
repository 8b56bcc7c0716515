"""Lanes near places, compiled: traffic, planners and scores ask at every step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._numba import func, kernel

HEADING_COST = 2.5
"""What a heading across a lane counts as, beside the distance [m]; against it, twice that: lanes
of both directions that share a place are told apart, and the next lane beside is none the nearer.
"""


@func
def cell_of(frame: Any, columns: int, rows: int, x: float, y: float) -> Any:
    """Cell of a place, clamped into the grid of ``frame`` (x0, y0, edge)."""
    i = min(max(math.floor((x - frame[0]) / frame[2]), 0), columns - 1)
    j = min(max(math.floor((y - frame[1]) / frame[2]), 0), rows - 1)
    return i, j


@func
def on_segment(segments: Any, k: int, x: float, y: float) -> Any:
    """Share along segment ``k`` of its place nearest to (x, y), and the signed distance: positive
    to its left [m]."""
    ax, ay, bx, by = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
    dx, dy = bx - ax, by - ay
    along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)
    along = min(max(along, 0.0), 1.0)
    ex, ey = x - (ax + along * dx), y - (ay + along * dy)
    distance = math.hypot(ex, ey)
    return along, math.copysign(distance, dx * ey - dy * ex)


@func
def nearest_segment(grid: Any, segments: Any, lane_of: Any, allowed: Any, place: Any) -> Any:
    """Segment of an allowed lane that costs least, or -1; share along it, signed distance.

    The heading of ``place`` (x, y, heading) may be NaN: then the distance alone decides.
    Cells are visited in rings, until no farther one can hold anything nearer.
    """
    x, y, heading = place
    first, entries, frame, columns, rows = grid
    u, v = cell_of(frame, columns, rows, x, y)
    best, best_cost, best_along, best_offset = -1, np.inf, 0.0, 0.0
    for ring in range(max(columns, rows)):
        if (ring - 1) * frame[2] > best_cost:
            break
        for i in range(max(u - ring, 0), min(u + ring, columns - 1) + 1):
            edge = abs(i - u) == ring
            step = 1 if edge or ring == 0 else 2 * ring
            for j in range(v - ring, v + ring + 1, step):
                if j < 0 or j >= rows:
                    continue
                cell = i * rows + j
                for e in range(first[cell], first[cell + 1]):
                    k = entries[e]
                    if not allowed[lane_of[k]]:
                        continue
                    along, offset = on_segment(segments, k, x, y)
                    cost = abs(offset)
                    if not math.isnan(heading):
                        cost += HEADING_COST * (1.0 - math.cos(heading - segments[k, 4]))
                    if cost < best_cost or (cost == best_cost and k < best):
                        best, best_cost, best_along, best_offset = k, cost, along, offset
    return best, best_along, best_offset


@kernel
def nearest_lanes(table: Any, allowed: Any, places: Any, found: Any, values: Any) -> None:
    """For each place [S, 3] (x, y, heading or NaN) the lane, its arc length and the offset.

    Args:
        table: (grid, segments, lane_of): the grid is (first, entries, frame, columns, rows),
            segments by cell; segments [K, 7] float64 are x and y of both ends, heading, arc length
            at both ends; lane_of is [K] int32.
        allowed: [L] bool, lanes that count.
        found: [S] int64, filled: the lane, or -1 where none is allowed.
        values: [S, 2] float64, filled: arc length and offset to the left [m].
    """
    grid, segments, lane_of = table
    for n in range(len(places)):
        k, along, offset = nearest_segment(
            grid, segments, lane_of, allowed, (places[n, 0], places[n, 1], places[n, 2])
        )
        found[n] = lane_of[k] if k >= 0 else -1
        if k >= 0:
            values[n, 0] = segments[k, 5] + along * (segments[k, 6] - segments[k, 5])
            values[n, 1] = offset


@func
def in_quad(quads: Any, k: int, x: float, y: float) -> bool:
    """Whether a place lies in the quadrilateral ``k`` (rims included), however it is turned."""
    positive, negative = False, False
    for a in range(4):
        b = (a + 1) % 4
        ax, ay, bx, by = quads[k, a, 0], quads[k, a, 1], quads[k, b, 0], quads[k, b, 1]
        side = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        positive, negative = positive or side > 1e-9, negative or side < -1e-9
    return not (positive and negative)


@func
def in_polygon(points: Any, start: int, stop: int, x: float, y: float) -> bool:
    """Whether a place lies inside the closed outline ``points[start:stop]`` (even-odd rule)."""
    inside = False
    b = stop - 1
    for a in range(start, stop):
        ax, ay, bx, by = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
        if (ay > y) != (by > y) and x < (bx - ax) * (y - ay) / (by - ay) + ax:
            inside = not inside
        b = a
    return inside


@kernel
def inside_any(table: Any, allowed: Any, outlines: Any, places: Any, found: Any) -> None:
    """Which places [S, 2] lie on an allowed lane or inside one of the outlines.

    Args:
        table: (grid, quads, lane_of) with rims of each segment [K, 4, 2] float64 [m].
        allowed: [L] bool, lanes that count.
        outlines: (points [P, 2], first [A + 1], bounds [A, 4]) of areas.
        found: [S] bool, filled.
    """
    grid, quads, lane_of = table
    first, entries, frame, columns, rows = grid
    points, starts, bounds = outlines
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        u, v = cell_of(frame, columns, rows, x, y)
        hit = False
        cell = u * rows + v
        for e in range(first[cell], first[cell + 1]):
            k = entries[e]
            if allowed[lane_of[k]] and in_quad(quads, k, x, y):
                hit = True
                break
        for a in range(len(bounds)):
            if hit:
                break
            if bounds[a, 0] <= x <= bounds[a, 2] and bounds[a, 1] <= y <= bounds[a, 3]:
                hit = in_polygon(points, starts[a], starts[a + 1], x, y)
        found[n] = hit


@kernel
def count_cells(boxes: Any, frame: Any, columns: int, rows: int) -> Any:
    """How many of the boxes [K, 4] (low x, y, high x, y) touch each cell, as first places of a
    list by cell [columns * rows + 1]."""
    first = np.zeros(columns * rows + 1, np.int64)
    for k in range(len(boxes)):
        i0, j0 = cell_of(frame, columns, rows, boxes[k, 0], boxes[k, 1])
        i1, j1 = cell_of(frame, columns, rows, boxes[k, 2], boxes[k, 3])
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                first[i * rows + j + 1] += 1
    for cell in range(columns * rows):
        first[cell + 1] += first[cell]
    return first


@kernel
def fill_cells(boxes: Any, frame: Any, columns: int, rows: int, first: Any) -> Any:
    """The list that :func:`count_cells` has counted: boxes by cell, each cell's in order."""
    entries = np.empty(first[-1], np.int32)
    fill = first[:-1].copy()
    for k in range(len(boxes)):
        i0, j0 = cell_of(frame, columns, rows, boxes[k, 0], boxes[k, 1])
        i1, j1 = cell_of(frame, columns, rows, boxes[k, 2], boxes[k, 3])
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cell = i * rows + j
                entries[fill[cell]] = k
                fill[cell] += 1
    return entries
