"""The lanes of a scene as one graph with a spatial index, for traffic, planners and scores."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._numba import func, kernel
from ..geometry import Float
from .errors import SceneError
from .lane import (
    DRIVABLE,
    TRAVELLED,
    Area,
    Lane,
    LanePlace,
    Road,
    Signal,
    StopLine,
    StopLineAt,
    turned,
)

# Kernels: lanes near a position.

HEADING_COST = 2.5
"""Cost of a heading across a lane, added to the distance [m]; twice that for the opposite heading.
It separates lanes of both directions at one position, without favouring adjacent lanes.
"""


@func
def cell_of(frame: Any, columns: int, rows: int, x: float, y: float) -> Any:
    """Cell of a position, clamped to the grid of ``frame`` (x0, y0, edge)."""
    i = min(max(math.floor((x - frame[0]) / frame[2]), 0), columns - 1)
    j = min(max(math.floor((y - frame[1]) / frame[2]), 0), rows - 1)
    return i, j


@func
def on_segment(segments: Any, k: int, x: float, y: float) -> Any:
    """Fraction along segment ``k`` of its point nearest to (x, y), and the signed distance:
    positive to its left [m].
    """
    ax, ay, bx, by = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
    dx, dy = bx - ax, by - ay
    along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)
    along = min(max(along, 0.0), 1.0)
    ex, ey = x - (ax + along * dx), y - (ay + along * dy)
    distance = math.hypot(ex, ey)
    return along, math.copysign(distance, dx * ey - dy * ex)


@func
def nearest_segment(grid: Any, segments: Any, lane_of: Any, allowed: Any, place: Any) -> Any:
    """Segment of an allowed lane with the lowest cost, or -1; fraction along it, signed distance.

    If the heading of ``place`` (x, y, heading) is NaN, only the distance counts. Cells are visited
    in rings, until no farther cell can contain a nearer segment.
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
    """For each pose [S, 3] (x, y, heading or NaN) the lane, its arc length and the offset.

    Args:
        table: (grid, segments, lane_of): the grid is (first, entries, frame, columns, rows),
            segments by cell; segments [K, 7] float64 are x and y of both ends, heading, arc length
            at both ends; lane_of is [K] int32.
        allowed: [L] bool, lanes to consider.
        found: [S] int64, filled: the lane, or -1 if none is allowed.
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
    """Whether a position is inside the quadrilateral ``k`` of any orientation, borders included."""
    positive, negative = False, False
    for a in range(4):
        b = (a + 1) % 4
        ax, ay, bx, by = quads[k, a, 0], quads[k, a, 1], quads[k, b, 0], quads[k, b, 1]
        side = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        positive, negative = positive or side > 1e-9, negative or side < -1e-9
    return not (positive and negative)


@func
def in_polygon(points: Any, start: int, stop: int, x: float, y: float) -> bool:
    """Whether a position is inside the closed outline ``points[start:stop]`` (even-odd rule)."""
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
    """Mask of the positions [S, 2] on an allowed lane or inside one of the outlines.

    Args:
        table: (grid, quads, lane_of) with borders of each segment [K, 4, 2] float64 [m].
        allowed: [L] bool, lanes to consider.
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
    """Offsets [columns * rows + 1] of each cell in a list of the boxes [K, 4] (low x, y, high x, y)
    that touch it."""
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
    """The list of boxes by cell at the offsets of :func:`count_cells`, in order within a cell."""
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


# Spatial index of the lanes, as arrays and a grid for the kernels.

CELL_M, MAX_CELLS = 5.0, 4_000_000
MAX_SEGMENT_M = 20.0


class LaneIndex:
    """Segments of all lanes in arrays, and a grid over them, as inputs of the kernels."""

    def __init__(self, lanes: tuple[Lane, ...]) -> None:
        self.lanes = lanes
        parts = [_segments(lane) for lane in lanes]
        counts = [len(quads) for _, quads in parts]
        self.segments = np.concatenate([p for p, _ in parts]) if parts else np.zeros((0, 7))
        self.quads = np.concatenate([q for _, q in parts]) if parts else np.zeros((0, 4, 2))
        self.lane_of = np.repeat(np.arange(len(lanes), dtype=np.int32), counts)
        self.kinds = np.array([lane.kind for lane in lanes], dtype=object)
        self.grid = self._grid()

    def of_kinds(self, kinds: Iterable[str]) -> NDArray[np.bool_]:
        """Mask of the lanes of these kinds, [L] bool."""
        wanted = frozenset(kinds)
        known = self._of_kinds.get(wanted)
        if known is None:
            known = np.array([kind in wanted for kind in self.kinds], dtype=np.bool_)
            self._of_kinds[wanted] = known
        return known

    @cached_property
    def _of_kinds(self) -> dict[frozenset[str], NDArray[np.bool_]]:
        return {}

    def _grid(self) -> tuple[NDArray[np.int64], NDArray[np.int32], Float, int, int]:
        """Segments by cell: all whose bounding rectangles touch the cell."""
        ends = self.segments[:, :4].reshape(-1, 2, 2)
        corners = np.concatenate([self.quads, ends], axis=1)
        boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
        if not len(boxes):
            boxes = np.zeros((0, 4))
        low = boxes[:, :2].min(axis=0) if len(boxes) else np.zeros(2)
        high = boxes[:, 2:].max(axis=0) if len(boxes) else np.ones(2)
        size = np.maximum(high - low, 1.0)
        cell = max(CELL_M, float(np.sqrt(size.prod() / MAX_CELLS)), float(size.max()) / MAX_CELLS)
        columns, rows = (int(n) for n in np.floor(size / cell) + 1)
        frame = np.array([*low, cell])
        boxes = np.ascontiguousarray(boxes)
        first = count_cells(boxes, frame, columns, rows)
        return first, fill_cells(boxes, frame, columns, rows, first), frame, columns, rows


def _segments(lane: Lane) -> tuple[Float, Float]:
    """Segments [K, 7] (both ends, heading, arc length at both) and borders [K, 4, 2] of a lane,
    each at most a few cells long."""
    left, right = lane.rims
    s = lane.s
    longest = np.diff(s).max()
    if longest > MAX_SEGMENT_M:
        counts = np.ceil(np.diff(s) / MAX_SEGMENT_M).astype(int)
        inner = [
            np.linspace(a, b, n, endpoint=False)
            for a, b, n in zip(s[:-1], s[1:], counts, strict=True)
        ]
        s = np.concatenate([*inner, s[-1:]])
    lines = [
        np.stack([np.interp(s, lane.s, line[:, i]) for i in (0, 1)], axis=1)
        for line in (lane.centre, left, right)
    ]
    centre, left, right = lines
    a, b = centre[:-1], centre[1:]
    heading = np.arctan2(*(b - a).T[::-1])
    segments = np.column_stack([a, b, heading, s[:-1], s[1:]])
    return segments, np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)


MAX_LENGTH_M = 2e7


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """Lanes and their traffic rules, in the world frame of a scene [m]. Immutable and shared.

    Attributes:
        lanes: by id, in a stable order.
        areas, stop_lines, signals, roads: by id.
        source: origin: a format and file, or the log.
        accuracy: estimated median error of the centre lines [m]; None if unknown (maps of other
            providers).
        geo_reference: projection of the source map (PROJ text), or empty.
        notes: parts that the reader of a map skipped, one sentence each; not stored with a scene.

    Raises:
        SceneError: an id stored under another one, or a reference to a missing one.
    """

    lanes: Mapping[str, Lane]
    areas: Mapping[str, Area] = field(default_factory=dict)
    stop_lines: Mapping[str, StopLine] = field(default_factory=dict)
    signals: Mapping[str, Signal] = field(default_factory=dict)
    roads: Mapping[str, Road] = field(default_factory=dict)
    source: str = ""
    accuracy: float | None = None
    geo_reference: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("lanes", "areas", "stop_lines", "signals", "roads"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        for name, key in _IDS.items():
            for known, part in getattr(self, name).items():
                if getattr(part, key) != known:
                    raise SceneError(f"{name}: {getattr(part, key)!r} is stored under {known!r}")
        if sum(lane.length for lane in self.lanes.values()) > MAX_LENGTH_M:
            raise SceneError(f"lanes are longer than {MAX_LENGTH_M:.0f} m together")
        self._check_references()

    @classmethod
    def of(cls, lanes: Iterable[Lane], **parts: Any) -> LaneGraph:
        """A graph of parts, stored by their ids.

        Args:
            lanes: lanes of the graph.
            **parts: iterables ``areas``, ``stop_lines``, ``signals``, ``roads``; and ``source``,
                ``accuracy``, ``geo_reference``.

        Raises:
            SceneError: a duplicate id, or as the constructor.
        """
        stored: dict[str, Any] = {"lanes": tuple(lanes), **parts}
        for name, key in _IDS.items():
            given = tuple(stored.get(name, ()))
            stored[name] = {getattr(part, key): part for part in given}
            if len(stored[name]) < len(given):
                raise SceneError(f"{name}: an id is given twice")
        return cls(**stored)

    def _check_references(self) -> None:
        for lane in self.lanes.values():
            beside = (lane.left, lane.right, lane.opposite)
            named = (*lane.successors, *(n for n in beside if n is not None))
            self._check_lanes(named, f"lane {lane.lane_id!r}")
        for line in self.stop_lines.values():
            self._check_lanes(line.lanes, f"stop line {line.stop_line_id!r}")
        for signal in self.signals.values():
            self._check_lanes(signal.lanes, f"signal {signal.signal_id!r}")
            if signal.stop_line is not None and signal.stop_line not in self.stop_lines:
                raise SceneError(
                    f"signal {signal.signal_id!r}: no stop line {signal.stop_line!r} is there"
                )
        for road in self.roads.values():
            self._check_lanes((p.lane_id for p in road.lanes), f"road {road.road_id!r}")

    def _check_lanes(self, names: Iterable[str], what: str) -> None:
        for name in names:
            if name not in self.lanes:
                raise SceneError(f"{what} names lane {name!r}, which the graph does not have")

    def lane(self, lane_id: str) -> Lane:
        """The lane with that id.

        Raises:
            SceneError: the lane does not exist.
        """
        try:
            return self.lanes[lane_id]
        except KeyError:
            raise SceneError(f"no lane {lane_id!r} {_known(self.lanes)}") from None

    def road(self, road_id: str) -> Road:
        """The road with that id.

        Raises:
            SceneError: the road does not exist; only OpenDRIVE maps have roads.
        """
        try:
            return self.roads[road_id]
        except KeyError:
            raise SceneError(f"no road {road_id!r} {_known(self.roads)}") from None

    @cached_property
    def predecessors(self) -> Mapping[str, tuple[str, ...]]:
        """Predecessors of each lane, by its id."""
        found: dict[str, list[str]] = {name: [] for name in self.lanes}
        for lane in self.lanes.values():
            for name in lane.successors:
                found[name].append(lane.lane_id)
        return {name: tuple(before) for name, before in found.items()}

    def straightest_first(self, lanes: Iterable[Lane], *, forwards: bool = True) -> list[Lane]:
        """Lanes by how far they turn; of equal ones, that to the side on which traffic drives."""

        def order(lane: Lane) -> tuple[float, float, str]:
            left = lane.turn if forwards else -lane.turn
            place = self.road_places.get(lane.lane_id)
            right = place is None or self.road(place[0]).drives_right
            return round(abs(left), 6), left if right else -left, lane.lane_id

        return sorted(lanes, key=order)

    @cached_property
    def stops(self) -> Mapping[str, tuple[StopLineAt, ...]]:
        """Where the traffic of each signal stops, by the signal's id.

        Without a stop line, at the ends of its lanes, or at the starts of those in a junction.
        """
        return {name: tuple(self._stops_of(signal)) for name, signal in self.signals.items()}

    def _stops_of(self, signal: Signal) -> Iterator[StopLineAt]:
        lanes = [self.lanes[name] for name in signal.lanes]
        if signal.stop_line is None:
            for lane in lanes:
                s = lane.length if lane.junction is None else 0.0
                x, y, _, heading = lane.at(s)
                yield StopLineAt(x, y, heading, lane.width(s) / 2)
            return
        line = self.stop_lines[signal.stop_line]
        first, last = line.points[0, :2], line.points[-1, :2]
        across = math.atan2(last[1] - first[1], last[0] - first[0])
        x, y = ((first + last) / 2).tolist()
        ruled = lanes or [self.lanes[name] for name in line.lanes]
        # Without lanes, traffic approaches the front of the signal.
        way = signal.heading + math.pi
        if ruled:
            way = float(ruled[0].headings[-1 if ruled[0].junction is None else 0])
        turned = across + math.pi / 2
        heading = turned if math.cos(turned - way) > 0 else turned + math.pi
        yield StopLineAt(x, y, heading, math.hypot(*(last - first)) / 2)

    @cached_property
    def road_places(self) -> Mapping[str, tuple[str, int]]:
        """(road id, lane number) by lane id, for lanes on roads."""
        roads = self.roads.values()
        return {p.lane_id: (road.road_id, p.number) for road in roads for p in road.lanes}

    def nearest(
        self,
        x: float,
        y: float,
        heading: float | None = None,
        *,
        kinds: Iterable[str] = TRAVELLED,
        within: float = math.inf,
    ) -> LanePlace | None:
        """The lane nearest to a pose, or None if no lane of these kinds is ``within`` [m].

        Args:
            x, y: world position [m].
            heading: preferred direction of the lane [rad]; None: any direction.
            kinds: kinds of lanes to consider.
            within: maximum distance from a centre line [m].
        """
        place = np.array([[x, y, math.nan if heading is None else heading]])
        index, values = self.nearest_many(place, kinds=kinds)
        s, offset = values[0].tolist()
        if index[0] < 0 or abs(offset) > within:
            return None
        lane = self._table.lanes[index[0]]
        inside = abs(offset) <= lane.width(s) / 2
        return LanePlace(lane.lane_id, s, offset, lane.at(s)[3], inside)

    def nearest_many(
        self, poses: ArrayLike, *, kinds: Iterable[str] = TRAVELLED
    ) -> tuple[NDArray[np.int64], Float]:
        """The nearest lanes of poses [S, 3] (x, y [m], heading [rad] or NaN), in microseconds each.

        Returns:
            Positions [S] in :attr:`lane_ids`, -1 without any lane of these kinds; and [S, 2]
            float64, arc length and offset to the left [m].
        """
        places = np.ascontiguousarray(poses, dtype=np.float64).reshape(-1, 3)
        found, values = np.full(len(places), -1), np.zeros((len(places), 2))
        table = self._table
        if len(table.lane_of):
            allowed = table.of_kinds(kinds)
            nearest_lanes(
                (table.grid, table.segments, table.lane_of), allowed, places, found, values
            )
        return found, values

    def is_drivable(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether positions [S, 2] [m] are on the road surface, [S] bool: on a lane of a
        :data:`DRIVABLE` kind, in a drivable area, a junction or a crosswalk.
        """
        places = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        found = np.zeros(len(places), dtype=np.bool_)
        table = self._table
        allowed = table.of_kinds(DRIVABLE)
        inside_any((table.grid, table.quads, table.lane_of), allowed, self._outlines, places, found)
        return found

    @cached_property
    def lane_ids(self) -> tuple[str, ...]:
        """Ids in order."""
        return tuple(self.lanes)

    def routes(
        self, lane_id: str, length: float, *, s: float = 0.0, limit: int = 64
    ) -> list[tuple[str, ...]]:
        """Routes along successors from ``s`` on a lane, each as a tuple of lane ids.

        Args:
            lane_id: first lane.
            length: length of each route, unless its lanes end before [m].
            s: start on the first lane [m].
            limit: maximum number of routes, in order of discovery.

        Raises:
            SceneError: there is no such lane.
        """
        found: list[tuple[str, ...]] = []
        open_paths: list[tuple[tuple[str, ...], float]] = [
            ((lane_id,), self.lane(lane_id).length - s)
        ]
        while open_paths and len(found) < limit:
            way, reached = open_paths.pop()
            onward = [n for n in self.lanes[way[-1]].successors if n not in way]
            if reached >= length or not onward:
                found.append(way)
                continue
            for name in reversed(onward):
                open_paths.append(((*way, name), reached + self.lanes[name].length))
        return found

    def route(self, start: str, goal: str, *, change_cost: float = 20.0) -> tuple[str, ...] | None:
        """The shortest route from one lane to another; None if there is no route.

        Args:
            start, goal: lanes.
            change_cost: cost of a lane change to a neighbour of the same direction [m].

        Raises:
            SceneError: there is no such lane.
        """
        self.lane(goal)
        best = {self.lane(start).lane_id: 0.0}
        before: dict[str, str] = {}
        queue = [(0.0, start)]
        while queue:
            cost, name = heapq.heappop(queue)
            if name == goal:
                way = [name]
                while way[-1] in before:
                    way.append(before[way[-1]])
                return tuple(reversed(way))
            if cost > best[name]:
                continue
            lane = self.lanes[name]
            steps = [(n, lane.length) for n in lane.successors]
            if lane.left is not None and lane.may_change_left:
                steps.append((lane.left, change_cost))
            if lane.right is not None and lane.may_change_right:
                steps.append((lane.right, change_cost))
            for onward, step in steps:
                if cost + step < best.get(onward, math.inf):
                    best[onward], before[onward] = cost + step, name
                    heapq.heappush(queue, (cost + step, onward))
        return None

    @cached_property
    def gaps(self) -> Mapping[tuple[str, str], float]:
        """Distance between the end of a lane and the start of each successor [m]."""
        return {
            (lane.lane_id, name): float(
                np.linalg.norm(lane.centre[-1] - self.lanes[name].centre[0])
            )
            for lane in self.lanes.values()
            for name in lane.successors
        }

    @property
    def bounds(self) -> tuple[Float, Float] | None:
        """Lowest and highest x, y [2] of all centre lines [m]; None without lanes."""
        if not self.lanes:
            return None
        points = np.concatenate([lane.centre[:, :2] for lane in self.lanes.values()])
        return points.min(axis=0), points.max(axis=0)

    @property
    def nbytes(self) -> int:
        """Memory of centre lines, widths, outlines and roads [bytes]."""
        lanes = sum(lane.centre.nbytes + lane.widths.nbytes for lane in self.lanes.values())
        areas = sum(area.outline.nbytes for area in self.areas.values())
        roads = sum(
            6 * r.s.nbytes + 3 * sum(p.s.nbytes for p in r.lanes) for r in self.roads.values()
        )
        return lanes + areas + roads

    def moved(self, yaw: float, shift: ArrayLike) -> LaneGraph:
        """The graph rotated about the z axis by ``yaw`` [rad], then moved by ``shift`` [3] [m]."""
        by = np.array(shift, dtype=np.float64)
        lines = {
            k: replace(v, points=turned(v.points, yaw) + by) for k, v in self.stop_lines.items()
        }
        signals = {
            k: replace(
                v,
                position=tuple((turned(np.array([v.position]), yaw)[0] + by).tolist()),
                heading=v.heading + yaw,
            )
            for k, v in self.signals.items()
        }
        areas = {k: replace(v, outline=turned(v.outline, yaw) + by) for k, v in self.areas.items()}
        return replace(
            self,
            lanes={k: v.moved(yaw, by) for k, v in self.lanes.items()},
            areas=areas,
            stop_lines=lines,
            signals=signals,
            roads={k: v.moved(yaw, by) for k, v in self.roads.items()},
        )

    @cached_property
    def _table(self) -> LaneIndex:
        return LaneIndex(tuple(self.lanes.values()))

    @cached_property
    def _outlines(self) -> tuple[Float, NDArray[np.int64], Float]:
        kinds = ("drivable", "junction", "crosswalk", "parking")
        shapes = [a.outline[:, :2] for a in self.areas.values() if a.kind in kinds]
        first = np.cumsum([0, *(len(shape) for shape in shapes)])
        bounds = [np.concatenate([shape.min(axis=0), shape.max(axis=0)]) for shape in shapes]
        points = np.concatenate(shapes) if shapes else np.zeros((0, 2))
        return points, first.astype(np.int64), np.array(bounds).reshape(-1, 4)


_IDS = {
    "lanes": "lane_id",
    "areas": "area_id",
    "stop_lines": "stop_line_id",
    "signals": "signal_id",
    "roads": "road_id",
}


def _known(parts: Mapping[str, Any]) -> str:
    names = ", ".join(list(parts)[:20]) or "none"
    return f"is there; {len(parts)} are: {names}{' ...' if len(parts) > 20 else ''}"
