"""The lanes of a scene as one graph: what traffic follows, planners are sent and scores ask."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.lanes import AreaKind, LaneKind, SignalKind

from ..geometry.rotation import Float
from .errors import SceneError
from .lane_kernels import count_cells, fill_cells, inside_any, nearest_lanes
from .road import Road, turned

LANE_KINDS: tuple[str, ...] = get_args(LaneKind)
AREA_KINDS: tuple[str, ...] = get_args(AreaKind)
SIGNAL_KINDS: tuple[str, ...] = get_args(SignalKind)
TRAVELLED: frozenset[str] = frozenset({"driving", "bus"})
"""Lanes that cars drive along."""
DRIVABLE: frozenset[str] = TRAVELLED | {"bicycle", "shoulder", "parking"}
"""Lanes whose surface a car may touch."""
CELL_M, MAX_CELLS = 5.0, 4_000_000
LONGEST_SEGMENT_M = 20.0
MAX_LENGTH_M = 2e7
SAME_PLACE_M = 1e-6


class LanePlace(NamedTuple):
    """A place in a lane's own coordinates.

    Attributes:
        lane_id: the lane.
        s: arc length along its centre line, seen from above [m].
        offset: distance from it, positive to the left [m].
        heading: of the lane there [rad].
        inside: whether it lies between the lane's rims.
    """

    lane_id: str
    s: float
    offset: float
    heading: float
    inside: bool


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane, in the direction that its traffic drives.

    Attributes:
        lane_id: unique in the graph.
        kind: what it is for.
        centre: [N, 3] float64, centre line in the world [m], N >= 2, without repeated points.
        widths: [N] float64, across the centre line, half to each side [m], from 0.
        speed_limit: [m/s], None where the map states none.
        successors: lanes that go on where it ends.
        left, right: neighbours of the same direction, whose traffic shares its rim.
        opposite: the neighbour to the left that runs the other way.
        may_change_left, may_change_right: whether markings allow to change to those neighbours.
        junction: the junction that it crosses, or None.

    Raises:
        SceneError: naming the lane.
    """

    lane_id: str
    kind: LaneKind
    centre: Float
    widths: Float
    speed_limit: float | None = None
    successors: tuple[str, ...] = ()
    left: str | None = None
    right: str | None = None
    opposite: str | None = None
    may_change_left: bool = True
    may_change_right: bool = True
    junction: str | None = None

    def __post_init__(self) -> None:
        what = f"lane {self.lane_id!r}"
        centre = points_of(self.centre, what)
        widths = np.array(self.widths, dtype=np.float64)
        if self.kind not in LANE_KINDS:
            raise SceneError(f"{what}: kind {self.kind!r}; allowed: {', '.join(LANE_KINDS)}")
        if widths.shape != (len(centre),) or not (np.isfinite(widths) & (widths >= 0)).all():
            raise SceneError(f"{what}: widths must be {len(centre)} lengths from 0")
        if (np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1) < SAME_PLACE_M).any():
            raise SceneError(f"{what}: two points of its centre line share a place")
        limit = self.speed_limit
        if limit is not None and not (math.isfinite(limit) and limit > 0):
            raise SceneError(f"{what}: speed limit {limit!r} must be positive [m/s], or None")
        widths.flags.writeable = False
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "widths", widths)
        object.__setattr__(self, "successors", tuple(dict.fromkeys(self.successors)))

    @cached_property
    def s(self) -> Float:
        """[N] float64, arc length of each point of the centre line seen from above [m]."""
        steps = np.linalg.norm(np.diff(self.centre[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """Of the centre line seen from above [m]."""
        return float(self.s[-1])

    @cached_property
    def headings(self) -> Float:
        """[N] float64, direction of the centre line at its points [rad], without jumps of 2 pi."""
        d = np.diff(self.centre[:, :2], axis=0)
        along = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
        steps = np.linalg.norm(d, axis=1)
        if len(along) == 1:
            return np.array([along[0], along[0]])
        # At a point the neighbours' directions count by the nearness of their middles.
        between = (along[:-1] * steps[1:] + along[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
        ends = np.array([2 * along[0] - between[0], 2 * along[-1] - between[-1]])
        return np.concatenate([ends[:1], between, ends[1:]])

    @cached_property
    def rims(self) -> tuple[Float, Float]:
        """Left and right rim, [N, 3] float64 each, at the points of the centre line [m]."""
        aside = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)
        half = np.zeros_like(self.centre)
        half[:, :2] = aside * (self.widths / 2)[:, None]
        return self.centre + half, self.centre - half

    def at(self, s: float, offset: float = 0.0) -> tuple[float, float, float, float]:
        """x, y, z [m] and heading [rad] at ``s``, ``offset`` to the left of the centre line.

        Before its start and past its end the lane goes on straight.
        """
        x, y, z = (float(np.interp(s, self.s, self.centre[:, i])) for i in range(3))
        heading = float(np.interp(s, self.s, self.headings))
        beyond = min(s, 0.0) + max(s - self.length, 0.0)
        cos, sin = math.cos(heading), math.sin(heading)
        return x + beyond * cos - offset * sin, y + beyond * sin + offset * cos, z, heading

    def width(self, s: float) -> float:
        """Width at ``s`` [m]."""
        return float(np.interp(s, self.s, self.widths))

    def moved(self, yaw: float, shift: Float) -> Lane:
        """The lane turned about the z axis of the world by ``yaw`` [rad], then moved [m]."""
        return replace(self, centre=turned(self.centre, yaw) + shift)


@dataclass(frozen=True, eq=False)
class Area:
    """A marked part of the ground.

    Attributes:
        area_id: unique among the areas.
        kind: what it is for.
        outline: [N, 3] float64, corners of a simple polygon in the world [m], N >= 3.
    """

    area_id: str
    kind: AreaKind
    outline: Float

    def __post_init__(self) -> None:
        if self.kind not in AREA_KINDS:
            raise SceneError(
                f"area {self.area_id!r}: kind {self.kind!r}; allowed: {', '.join(AREA_KINDS)}"
            )
        outline = points_of(self.outline, f"area {self.area_id!r}", least=3)
        object.__setattr__(self, "outline", outline)


@dataclass(frozen=True, eq=False)
class StopLine:
    """Where vehicles wait.

    Attributes:
        stop_line_id: unique among the stop lines.
        points: [N, 3] float64, across the lanes [m], N >= 2.
        lanes: those whose traffic waits there.
    """

    stop_line_id: str
    points: Float
    lanes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        points = points_of(self.points, f"stop line {self.stop_line_id!r}")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "lanes", tuple(dict.fromkeys(self.lanes)))


@dataclass(frozen=True, eq=False)
class Signal:
    """A traffic light or sign.

    Attributes:
        signal_id: unique among the signals.
        kind: what it orders.
        position: x, y, z in the world [m].
        heading: where its face looks [rad].
        lanes: those that it rules.
        stop_line: where their traffic waits; None: at the lanes' ends.
        value: of a speed limit [m/s], else None.
    """

    signal_id: str
    kind: SignalKind
    position: tuple[float, float, float]
    heading: float = 0.0
    lanes: tuple[str, ...] = ()
    stop_line: str | None = None
    value: float | None = None

    def __post_init__(self) -> None:
        what = f"signal {self.signal_id!r}"
        if self.kind not in SIGNAL_KINDS:
            raise SceneError(f"{what}: kind {self.kind!r}; allowed: {', '.join(SIGNAL_KINDS)}")
        numbers = (*self.position, self.heading, 0.0 if self.value is None else self.value)
        if len(self.position) != 3 or not all(math.isfinite(v) for v in numbers):
            raise SceneError(f"{what}: holds a number that is not finite")
        object.__setattr__(self, "position", tuple(float(v) for v in self.position))
        object.__setattr__(self, "lanes", tuple(dict.fromkeys(self.lanes)))


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """Lanes and what rules them, in the world frame of a scene [m]. Immutable and shared.

    Attributes:
        lanes: by id, in a stable order.
        areas, stop_lines, signals, roads: by id.
        source: where it comes from: a format and file, or the log.
        accuracy: how far centre lines may be from those of the street: an estimate of the median
            error [m]; None where nothing is known of it (maps as their makers give them).
        geo_reference: projection of the map that it was read from (PROJ text), or empty.

    Raises:
        SceneError: an id that is stored under another or that nothing has.
    """

    lanes: Mapping[str, Lane]
    areas: Mapping[str, Area] = field(default_factory=dict)
    stop_lines: Mapping[str, StopLine] = field(default_factory=dict)
    signals: Mapping[str, Signal] = field(default_factory=dict)
    roads: Mapping[str, Road] = field(default_factory=dict)
    source: str = ""
    accuracy: float | None = None
    geo_reference: str = ""

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
            lanes: of the graph.
            **parts: iterables ``areas``, ``stop_lines``, ``signals``, ``roads``; and ``source``,
                ``accuracy``, ``geo_reference``.

        Raises:
            SceneError: an id is given twice, or as the constructor.
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
        """The lane of that id.

        Raises:
            SceneError: there is none.
        """
        try:
            return self.lanes[lane_id]
        except KeyError:
            raise SceneError(f"no lane {lane_id!r} {_known(self.lanes)}") from None

    def road(self, road_id: str) -> Road:
        """The road of that id.

        Raises:
            SceneError: there is none; only maps in OpenDRIVE have roads.
        """
        try:
            return self.roads[road_id]
        except KeyError:
            raise SceneError(f"no road {road_id!r} {_known(self.roads)}") from None

    @cached_property
    def predecessors(self) -> Mapping[str, tuple[str, ...]]:
        """Lanes that each lane follows on, by its id."""
        found: dict[str, list[str]] = {name: [] for name in self.lanes}
        for lane in self.lanes.values():
            for name in lane.successors:
                found[name].append(lane.lane_id)
        return {name: tuple(before) for name, before in found.items()}

    @cached_property
    def road_places(self) -> Mapping[str, tuple[str, int]]:
        """(road id, lane number) by id of the lane, of those that lie on roads."""
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
        """The lane nearest to a pose, None where none of these kinds is ``within`` [m].

        Args:
            x, y: the place in the world [m].
            heading: lanes of about that direction [rad] come before others; None: any direction.
            kinds: of lanes that count.
            within: farthest distance from a centre line [m].
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
        """The nearest lanes of poses [S, 3] (x, y [m], heading [rad] or NaN), some microseconds
        each.

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
        """Which places [S, 2] [m] lie on the surface of the road, [S] bool: on a lane of a
        :data:`DRIVABLE` kind, in a drivable area, a junction or a crosswalk."""
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
        """Ways on along successors from ``s`` on a lane, each as the lanes it takes.

        Args:
            lane_id: where it begins.
            length: how far each goes, unless it ends before [m].
            s: begin on that lane [m].
            limit: how many at most; those that are found first.

        Raises:
            SceneError: there is no such lane.
        """
        found: list[tuple[str, ...]] = []
        open_ways: list[tuple[tuple[str, ...], float]] = [
            ((lane_id,), self.lane(lane_id).length - s)
        ]
        while open_ways and len(found) < limit:
            way, reached = open_ways.pop()
            onward = [n for n in self.lanes[way[-1]].successors if n not in way]
            if reached >= length or not onward:
                found.append(way)
                continue
            for name in reversed(onward):
                open_ways.append(((*way, name), reached + self.lanes[name].length))
        return found

    def route(self, start: str, goal: str, *, change_cost: float = 20.0) -> tuple[str, ...] | None:
        """The shortest way from one lane to another, or None.

        Args:
            start, goal: lanes.
            change_cost: what a change to a neighbour of the same direction counts as [m].

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

    def centre_line(self, way: Sequence[str]) -> Float:
        """Points [N, 3] float64 along lanes that follow each other, none twice [m]."""
        points: Float = np.concatenate([self.lane(name).centre for name in way])
        steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
        kept: Float = points[np.concatenate([[True], steps > 1e-3])]
        return kept

    @cached_property
    def gaps(self) -> Mapping[tuple[str, str], float]:
        """Distance between the end of a lane and the start of each that goes on from it [m]."""
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
        """The graph turned about the z axis by ``yaw`` [rad], then moved by ``shift`` [3] [m]."""
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
    def _table(self) -> _Table:
        return _Table(tuple(self.lanes.values()))

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


class _Table:
    """Segments of all lanes in arrays, and a grid over them, as kernels take them."""

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
        """Which lanes are of these kinds, [L] bool."""
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
        """Segments by cell: of every cell that the rectangle around their rims touches."""
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
    """Segments [K, 7] (both ends, heading, arc length at both) and rims [K, 4, 2] of a lane, none
    longer than a few cells."""
    left, right = lane.rims
    s = lane.s
    longest = np.diff(s).max()
    if longest > LONGEST_SEGMENT_M:
        counts = np.ceil(np.diff(s) / LONGEST_SEGMENT_M).astype(int)
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


def points_of(values: ArrayLike, what: str, *, least: int = 2) -> Float:
    """Finite points [N, 3] that nobody writes to, N >= ``least``.

    Raises:
        SceneError: naming ``what``.
    """
    points = np.array(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < least:
        raise SceneError(f"{what}: points must be [N, 3] with N >= {least}, not {points.shape}")
    if not (np.abs(points) < 1e7).all():
        raise SceneError(f"{what}: holds points that are not finite or beyond 10,000 km")
    points.flags.writeable = False
    return points


def _known(parts: Mapping[str, Any]) -> str:
    names = ", ".join(list(parts)[:20]) or "none"
    return f"is there; {len(parts)} are: {names}{' ...' if len(parts) > 20 else ''}"
