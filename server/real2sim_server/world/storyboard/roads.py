"""Road networks and curves of storyboards: positions, routes and trajectories."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import RouteLanes
from real2sim_proto.storyboard_actions import (
    Clothoid,
    ClothoidSpline,
    Curve,
    Nurbs,
    Polyline,
    Timing,
    WorldPosition,
)

from ...scene.errors import SceneError
from ...scene.lane import LANE_KINDS, Lane, Road
from ...scene.lane_graph import LaneGraph
from ..common import Draws, WorldError
from ..path import Float, LoggedPath
from ..traffic.driver import STRAIGHT, parallel_lane


class Place(NamedTuple):
    """A place: x, y [m], heading [rad], height [m] (None for the ground)."""

    x: float
    y: float
    h: float
    z: float | None = None


class RoadPoint(NamedTuple):
    """A position on a road.

    Attributes:
        road, lane: ids of the road and lane.
        s, t: distance along the reference line, and offset to its left [m].
        h: heading of the reference line [rad].
    """

    road: str
    lane: int
    s: float
    t: float
    h: float


class Way(NamedTuple):
    """A path to drive along: a lane or a route.

    Attributes:
        road, lane: ids; lane 0 is a straight path off the road.
        along: whether it runs in the direction of the reference line.
        path: centre line, in driving direction.
        length: its end along the path [m]; infinite if it does not end.
    """

    road: str
    lane: int
    along: bool
    path: LoggedPath
    length: float = math.inf


class RoadNetwork(Protocol):
    """Road network of a scene; immutable."""

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:
        """The road position of a place with a heading; None outside all lanes."""

    def is_drivable(self, x: float, y: float) -> bool:
        """Whether a place is on the surface of the road."""

    def onward(self, road: str, lane: int, s: float, ds: float) -> tuple[str, int, float, float]:
        """Road, lane and s at ``ds`` further along the reference line of a lane's road.

        Beyond the road, on the roads that continue the lane, as far as they go. The last value is
        1, or -1 if that road runs the other way. Raises WorldError: no such road or lane.
        """

    def place(self, road: str, s: float, t: float) -> Place:
        """The place at (s, t) of a road, with its heading; ``s`` is limited to the road.

        Raises WorldError: no such road.
        """

    def middle(self, road: str, lane: int, s: float) -> float:
        """t of a lane centre at ``s``; of the centre line for lane 0.

        Raises WorldError: no such lane there.
        """

    def drives_along(self, road: str, lane: int) -> bool:
        """Whether traffic of a lane drives in the direction of the reference line."""

    def way(self, road: str, lane: int, s: float, *, along: bool) -> Way:
        """The path along a lane from ``s``. Raises WorldError: no such lane there."""

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:
        """Id of the lane ``lanes`` further in +t direction. Raises WorldError: no such lane."""

    def route(self, places: list[Place]) -> LoggedPath:
        """The path along lanes through places. Raises WorldError: no such path."""

    def random_way(self, place: Place, entity: str) -> Way | None:
        """The path along the lane at a place, random at each fork; None off all lanes."""


@dataclass(frozen=True, eq=False)
class RouteNetwork:
    """Lanes parallel to the ego's route, extended straight beyond its ends.

    Attributes:
        spec: widths and numbers of lanes.
        route: route of the ego.
        reference: reference line, in the direction of the route.
        ways: cache of paths by lane and direction.
    """

    spec: RouteLanes
    route_path: LoggedPath
    reference: LoggedPath
    ways: dict[tuple[int, bool], Way] = field(default_factory=dict)

    @classmethod
    def of(cls, spec: RouteLanes, route: LoggedPath) -> RouteNetwork:
        """Lanes along a route."""
        shift = (abs(spec.ego_lane) - 0.5) * spec.lane_width
        return cls(spec, route, parallel_lane(route, shift))

    @property
    def _shift(self) -> float:
        """Difference between s along ``reference`` and s of the road [m]."""
        return STRAIGHT - self.spec.s

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:  # noqa: D102
        near = self.reference.nearest(x, y)
        width = self.spec.lane_width
        number = int(abs(near.offset) // width) + 1
        if number > (self.spec.left if near.offset > 0 else self.spec.right):
            return None
        lane = number if near.offset > 0 else -number
        return RoadPoint("route", lane, near.s - self._shift, near.offset, near.yaw)

    def is_drivable(self, x: float, y: float) -> bool:  # noqa: D102
        return self.locate(x, y, 0.0) is not None

    def onward(  # noqa: D102
        self, road: str, lane: int, s: float, ds: float
    ) -> tuple[str, int, float, float]:
        return road, lane, s + ds, 1.0

    def place(self, road: str, s: float, t: float) -> Place:  # noqa: D102
        x, y, _, yaw = self.reference.at(s + self._shift)
        return Place(x - t * math.sin(yaw), y + t * math.cos(yaw), yaw)

    def middle(self, road: str, lane: int, s: float) -> float:  # noqa: D102
        if lane == 0:
            return 0.0
        if not -self.spec.right <= lane <= self.spec.left:
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"lane {lane} is none of those along the route",
                hint=f"lanes are -{self.spec.right} to -1 on the right of the reference line and "
                f"1 to {self.spec.left} on its left; `storyboard.roads` says how many",
            )
        return math.copysign((abs(lane) - 0.5) * self.spec.lane_width, lane)

    def drives_along(self, road: str, lane: int) -> bool:  # noqa: D102
        return lane < 0

    def way(self, road: str, lane: int, s: float, *, along: bool) -> Way:  # noqa: D102
        known = self.ways.get((lane, along))
        if known is None:
            shift = (abs(self.spec.ego_lane) - 0.5) * self.spec.lane_width
            offset = shift + self.middle(road, lane, s)
            path = parallel_lane(self.route_path, offset, oncoming=not along)
            known = self.ways[lane, along] = Way("route", lane, along, path)
        return known

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:  # noqa: D102
        found = skipping_zero(lane, lanes)
        self.middle(road, found, s)
        return found

    def route(self, places: list[Place]) -> LoggedPath:  # noqa: D102
        return path_through(places)

    def random_way(self, place: Place, entity: str) -> Way | None:  # noqa: D102
        return None


def skipping_zero(lane: int, lanes: int) -> int:
    """Id of the lane ``lanes`` further in +t direction; there is no lane 0."""
    found = lane + lanes
    crossed = (lane < 0) != (found < 0) or found == 0
    return found + (1 if lanes > 0 else -1) if crossed and lanes else found


def lanes_between(lane: int, other: int) -> int:
    """Number of lanes from one to another in +t direction; there is no lane 0."""
    return other - lane - (0 if (lane < 0) == (other < 0) else 1 if other > lane else -1)


def straight(x: float, y: float, h: float, *, z: float = 0.0) -> LoggedPath:
    """The straight path from a place."""
    ahead = [x + math.cos(h), y + math.sin(h), z]
    ups = np.array([[0.0, 0.0, 1.0]] * 2)
    return LoggedPath.through(np.array([[x, y, z], ahead]), np.array([h, h]), ups)


SAME_PLACE = 0.01
"""Places on a path that are closer than this count as one [m]."""


def path_through(places: list[Place]) -> LoggedPath:
    """The polyline through places, of which at least two must differ.

    Its heading turns within ``CORNER`` of the places.
    """
    kept = places[:1]
    for place in places[1:]:
        if math.hypot(place.x - kept[-1].x, place.y - kept[-1].y) > SAME_PLACE:
            kept.append(place)
    points = np.array([(p.x, p.y, p.z or 0.0) for p in kept])
    if len(points) < 2:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a route or trajectory leads nowhere: all its places are the same",
            hint="give two places at least",
        )
    steps = np.diff(points, axis=0)
    yaws = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turned = np.concatenate([yaws[:1], (yaws[:-1] + yaws[1:]) / 2, yaws[-1:]])
    rows = [(*points[0], turned[0])]
    for a, step, yaw, b, after in zip(points, steps, yaws, points[1:], turned[1:], strict=False):
        # Along a straight part the path has its direction; it turns near the places.
        near = CORNER / float(np.hypot(*step[:2]))
        if near < 0.5:
            rows += [(*(a + near * step), yaw), (*(b - near * step), yaw)]
        rows.append((*b, after))
    found = np.array(rows)
    ups = np.tile([0.0, 0.0, 1.0], (len(found), 1))
    return LoggedPath.through(found[:, :3], found[:, 3], ups)


REACH = 2000.0
"""Maximum length of paths along lanes [m]."""

LANE_CHANGE = 30.0
"""Length of a lane change on a route [m]."""

MAX_ROADS = 1000
"""Maximum number of roads along which a relative position continues."""


@dataclass(frozen=True, eq=False)
class GraphNetwork:
    """Roads of an OpenDRIVE map; at forks, paths follow the lane that turns least.

    Attributes:
        graph: lane graph, world frame.
        draws: random numbers of the episode for random routes; None: they turn least.
        ways: cache of paths by lane and direction.
    """

    graph: LaneGraph
    draws: Draws | None = None
    ways: dict[tuple[str, bool], Way] = field(default_factory=dict)

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:  # noqa: D102
        graph = self.graph
        near = graph.nearest(x, y, h, kinds=LANE_KINDS)
        if near is None or not near.inside:
            near = graph.nearest(x, y, kinds=LANE_KINDS)
        if near is None or not near.inside or near.lane_id not in graph.road_places:
            return None
        road, lane = graph.road_places[near.lane_id]
        s, t = graph.road(road).project(x, y)
        return RoadPoint(road, lane, s, t, graph.road(road).at(s)[3])

    def is_drivable(self, x: float, y: float) -> bool:  # noqa: D102
        return bool(self.graph.is_drivable([[x, y]])[0])

    def onward(  # noqa: D102
        self, road: str, lane: int, s: float, ds: float
    ) -> tuple[str, int, float, float]:
        sense, left = 1.0, ds
        for _ in range(MAX_ROADS):
            length = self._road(road).length
            if 0.0 <= s + sense * left <= length:
                return road, lane, s + sense * left, sense
            up = sense * left > 0.0
            edge = length if up else 0.0
            left = math.copysign(abs(left) - abs(edge - s), ds)
            forwards = up == self.drives_along(road, lane)
            onward = self._next(self._part(road, lane, edge)[0], forwards=forwards)
            if onward is None or onward.lane_id not in self.graph.road_places:
                return road, lane, edge, sense
            road, lane = self.graph.road_places[onward.lane_id]
            up = forwards == self.drives_along(road, lane)
            sense = 1.0 if up == (ds > 0.0) else -1.0
            s = 0.0 if up else self._road(road).length
        return road, lane, s, sense

    def place(self, road: str, s: float, t: float) -> Place:  # noqa: D102
        found = self._road(road)
        x, y, z, h = found.at(min(max(s, 0.0), found.length), t)
        return Place(x, y, h, z)

    def middle(self, road: str, lane: int, s: float) -> float:  # noqa: D102
        if lane == 0:
            found = self._road(road)
            held = min(max(s, 0.0), found.length)
            sides = [p for p in found.lanes if abs(p.number) == 1 and p.s[0] <= held <= p.s[-1]]
            return float(np.interp(held, sides[-1].s, sides[-1].inner)) if sides else 0.0
        return self._part(road, lane, s)[1]

    def drives_along(self, road: str, lane: int) -> bool:  # noqa: D102
        return self._road(road).runs_along(lane)

    def way(self, road: str, lane: int, s: float, *, along: bool) -> Way:  # noqa: D102
        lane_id = self._part(road, lane, s)[0]
        forwards = along == self.drives_along(road, lane)
        known = self.ways.get((lane_id, forwards))
        if known is None:
            path, length = self._path(lane_id, forwards=forwards)
            known = self.ways[lane_id, forwards] = Way(road, lane, along, path, length)
        return known

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:  # noqa: D102
        found = skipping_zero(lane, lanes)
        self._part(road, found, s)
        return found

    def route(self, places: list[Place]) -> LoggedPath:  # noqa: D102
        near = [self.graph.nearest(p.x, p.y, p.h, kinds=LANE_KINDS) for p in places]
        pieces = list[Float]()
        for a, b, place, there in zip(near, near[1:], places, places[1:], strict=False):
            ends = np.array([[place.x, place.y, 0.0], [there.x, there.y, 0.0]])
            if a is None or b is None:
                pieces.append(ends)
                continue
            names = self.graph.route(a.lane_id, b.lane_id)
            pieces.append(ends if names is None else self._between(names, a.s, b.s))
        return path_through([Place(x, y, 0.0) for x, y, _ in np.concatenate(pieces).tolist()])

    def random_way(self, place: Place, entity: str) -> Way | None:  # noqa: D102
        here = self.locate(place.x, place.y, place.h)
        if here is None:
            return None
        lane_id, _ = self._part(here.road, here.lane, here.s)
        along = math.cos(place.h - here.h) >= 0.0
        forwards = along == self.drives_along(here.road, here.lane)
        draws, what = self.draws, f"storyboard.route.{entity}"
        drawn = None if draws is None else lambda number: draws.uniform(what, number)[0]
        path, length = self._path(lane_id, forwards=forwards, drawn=drawn)
        return Way("route", 1, True, path, length)

    def _between(self, names: tuple[str, ...], start: float, end: float) -> Float:
        """Points along lanes from ``start`` on the first to ``end`` on the last.

        A lane change is a straight line to the centre of the neighbouring lane.
        """
        lanes = [self.graph.lane(name) for name in names]
        parts, low = list[Float](), start
        for lane, onward in zip(lanes, [*lanes[1:], None], strict=True):
            high = end if onward is None else lane.length
            low = min(low, high)
            parts.append(np.array([lane.at(low)[:3]]))
            if onward is not None and onward.lane_id not in lane.successors:
                low = low / lane.length * onward.length + LANE_CHANGE
                continue
            inner = lane.centre[(lane.s > low) & (lane.s < high)]
            parts += [inner, np.array([lane.at(high)[:3]])]
            low = 0.0
        return np.concatenate(parts)

    def _road(self, road: str) -> Road:
        try:
            return self.graph.road(road)
        except SceneError as error:
            raise _refused(error) from error

    def _part(self, road: str, lane: int, s: float) -> tuple[str, float]:
        """Id of a lane of the graph, and t of its centre."""
        found = self._road(road)
        held = min(max(s, 0.0), found.length)
        try:
            part = found.lane(lane, held)
        except SceneError as error:
            raise _refused(error) from error
        return part.lane_id, part.centre_t(held)

    def _next(
        self, lane_id: str, *, forwards: bool, besides: Sequence[Lane] = (), u: float = 0.0
    ) -> Lane | None:
        """The lane that continues a lane; None if it ends.

        At a fork, ``u`` from 0 to 1 picks one of the lanes, ordered by how far they turn.
        """
        lane, before = self.graph.lane(lane_id), self.graph.predecessors
        names = lane.successors if forwards else before[lane_id]
        onward = [found for n in names if (found := self.graph.lane(n)) not in besides]
        onward = self.graph.straightest_first(onward, forwards=forwards)
        return onward[int(u * len(onward))] if onward else None

    def _path(
        self, lane_id: str, *, forwards: bool, drawn: Callable[[int], float] | None = None
    ) -> tuple[LoggedPath, float]:
        """The path along a lane and those that continue it.

        ``drawn(k)`` is ``u`` of :meth:`_next` after k lanes; None for the lanes that turn least.
        """
        lanes, length = [self.graph.lane(lane_id)], 0.0
        while length < REACH:
            length += lanes[-1].length
            u = 0.0 if drawn is None else drawn(len(lanes))
            onward = self._next(lanes[-1].lane_id, forwards=forwards, besides=lanes, u=u)
            if onward is None:
                break
            lanes.append(onward)
        points = np.concatenate([lane.centre for lane in lanes[:: 1 if forwards else -1]])
        yaws = np.unwrap(
            np.concatenate([lane.headings for lane in lanes[:: 1 if forwards else -1]])
        )
        if not forwards:
            points, yaws = points[::-1], yaws[::-1] + math.pi
        path = LoggedPath.through(points, yaws, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
        return path, path.length


def _refused(error: SceneError) -> WorldError:
    return WorldError(
        ErrorCode.INVALID_REQUEST,
        f"a position of the storyboard is nowhere on the map: {error}",
        hint="take a road and lane of the map",
    )


# --- Trajectories --------------------------------------------------------------------------------

# Polylines, clothoids, NURBS.

SAMPLE = 0.1
"""Spacing of samples of clothoids and NURBS [m]; the chord error is 0.1 mm at a curvature of 0.1 /
m."""

MAX_SAMPLES = 100_000


@dataclass(frozen=True, eq=False)
class SampledCurve:
    """A sampled curve.

    Attributes:
        s: [N] distance from the start, not decreasing [m].
        x, y: [N] [m].
        h: [N] continuous heading of the entity [rad]; against the curve if it reverses along it.
        times: [N] target times [s], or None.
    """

    s: Float
    x: Float
    y: Float
    h: Float
    times: Float | None

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(self.s[-1])

    def at(self, s: float) -> Place:
        """The place at a distance from the start."""
        x, y, h = (float(np.interp(s, self.s, values)) for values in (self.x, self.y, self.h))
        return Place(x, y, h)

    def sense(self, s: float) -> float:
        """1 if the entity faces along the curve at a distance from its start, -1 if against it."""
        k = min(max(int(np.searchsorted(self.s, s, side="right")), 1), len(self.s) - 1)
        dx, dy = self.x[k] - self.x[k - 1], self.y[k] - self.y[k - 1]
        h = float(np.interp(s, self.s, self.h))
        return -1.0 if dx * math.cos(h) + dy * math.sin(h) < -1e-12 else 1.0

    def distance_at(self, time: float) -> float:
        """Distance from the start at a time; the curve must have times."""
        assert self.times is not None
        return float(np.interp(time, self.times, self.s))

    def time_at(self, s: float) -> float:
        """Time at a distance from the start; the curve must have times."""
        assert self.times is not None
        return float(np.interp(s, self.s, self.times))

    def nearest(self, x: float, y: float) -> float:
        """Distance from the start to the point of the curve nearest to (x, y)."""
        dx, dy = np.diff(self.x), np.diff(self.y)
        square = np.maximum(dx * dx + dy * dy, 1e-18)
        u = np.clip(((x - self.x[:-1]) * dx + (y - self.y[:-1]) * dy) / square, 0.0, 1.0)
        far = (self.x[:-1] + u * dx - x) ** 2 + (self.y[:-1] + u * dy - y) ** 2
        k = int(np.argmin(far))
        return float(self.s[k] + u[k] * (self.s[k + 1] - self.s[k]))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion of an entity along a curve; immutable.

    Attributes:
        token: token of the action.
        course: the curve.
        timing: interpretation of the curve's times; None for the entity's own speed.
        s: distance along the curve [m].
        elapsed: time since the start of the action, or of the simulation [s].
        sense: 1 if it began facing along the curve, -1 if against it.
    """

    token: int
    course: SampledCurve
    timing: Timing | None
    s: float
    elapsed: float
    sense: float

    def ahead(self, x: float, y: float) -> float:
        """Distance ahead of the entity to a place along the curve [m]."""
        return self.sense * (self.course.nearest(x, y) - self.s)

    def step(self, way: float, h: float) -> tuple[float, Trajectory | None]:
        """Distance covered in ``h`` seconds, by its times or as given, and the new state.

        The state is None at the end of the curve, or at its start if the entity moves back.
        """
        if self.timing is None:
            s = self.s + self.sense * way
            over = s >= self.course.length - 1e-9 or (s <= 0.0 and self.sense * way < 0.0)
            return way, None if over else replace(self, s=s)
        elapsed = self.elapsed + h
        time = elapsed * float(self.timing.scale) + float(self.timing.offset)
        s = self.course.distance_at(time)
        assert self.course.times is not None
        over = time >= self.course.times[-1] - 1e-9
        covered = self.course.sense(self.s) * (s - self.s)
        return covered, None if over else replace(self, s=s, elapsed=elapsed)

    def begun(self) -> bool:
        """Whether its first time has been reached."""
        if self.timing is None or self.course.times is None:
            return True
        time = self.elapsed * float(self.timing.scale) + float(self.timing.offset)
        return bool(time >= self.course.times[0] - 1e-9)

    def place(self) -> Place:
        """Current place of the entity."""
        return self.course.at(self.s)


def course_of(
    curve: Curve,
    resolve: Callable[[Any], Place],
    *,
    here: Place | None = None,
    backwards: bool = False,
) -> SampledCurve:
    """Sample a curve.

    Args:
        curve: the curve.
        resolve: turns its positions into places.
        here: place of the entity, where a spline without a position starts.
        backwards: whether the entity faces against the curve, except where vertices give headings.

    Raises:
        WorldError: INVALID_REQUEST for a curve without a start or length.
    """
    if isinstance(curve, Polyline):
        course = _polyline(curve, resolve, math.pi if backwards else 0.0)
    elif isinstance(curve, Clothoid):
        course = _clothoid(curve, resolve(curve.position))
    elif isinstance(curve, ClothoidSpline):
        course = _spline(curve, here, resolve)
    else:
        course = _nurbs(curve, [resolve(p.position) for p in curve.points])
    if backwards and not isinstance(curve, Polyline):
        course = replace(course, h=course.h + math.pi)
    if course.length <= 0.0 and course.times is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a trajectory has no length",
            hint="give places that differ",
        )
    return course


CORNER = 2.0
"""Distance before and after a vertex of a polyline within which the heading turns [m]."""


def _polyline(curve: Polyline, resolve: Callable[[Any], Place], turn: float) -> SampledCurve:
    places = [resolve(v.position) for v in curve.vertices]
    x, y = np.array([p.x for p in places]), np.array([p.y for p in places])
    times = np.array([float(v.time) for v in curve.vertices])
    if (np.diff(times) < 0).any():
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "times of a polyline decrease",
            hint="order its vertices by time",
        )
    steps = np.hypot(np.diff(x), np.diff(y))
    s = np.concatenate([[0.0], np.cumsum(steps)])
    drawn = np.flatnonzero(steps > 1e-9)
    if not len(drawn):
        return SampledCurve(s, x, y, np.full(len(x), places[0].h), times)
    along = np.arctan2(np.diff(y), np.diff(x)) + turn
    for k, vertex in enumerate(curve.vertices[:-1]):
        if vertex.oriented:
            along[k] = places[k].h
    last = places[-1].h if curve.vertices[-1].oriented else along[drawn[-1]]
    knots = [(0.0, along[drawn[0]])]
    for before, after in itertools.pairwise(drawn):
        # The heading turns within CORNER of the vertex between two segments.
        change = math.remainder(along[after] - along[before], math.tau)
        knots += [
            (s[after] - min(CORNER, steps[before] / 2), along[before]),
            (s[after], along[before] + change / 2),
            (s[after] + min(CORNER, steps[after] / 2), along[after]),
        ]
    knots += [(s[-1] - min(CORNER, steps[drawn[-1]] / 2), along[drawn[-1]]), (s[-1], last)]
    at, h = np.array(knots).T
    # Samples at knots within a segment; at vertices there are samples already.
    more = np.setdiff1d(at, s)
    where = np.searchsorted(s, more, side="right")
    share = (more - s[where - 1]) / steps[where - 1]

    def sampled(values: Float) -> Float:
        inner = values[where - 1] + share * (values[where] - values[where - 1])
        found: Float = np.insert(values, where, inner)
        return found

    s, x, y, times = (sampled(values) for values in (s, x, y, times))
    return SampledCurve(s, x, y, np.interp(s, at, np.unwrap(h)), times)


def _clothoid(curve: Clothoid, start: Place) -> SampledCurve:
    length = float(curve.length)
    count = min(max(math.ceil(length / SAMPLE), 1), MAX_SAMPLES)
    s = np.linspace(0.0, length, count + 1)
    curvature, rate = float(curve.curvature), float(curve.curvature_rate)

    def heading(way: Float) -> Float:
        found: Float = start.h + curvature * way + rate * way * way / 2
        return found

    # Gauss-Legendre with three nodes per piece: error far below a micrometre.
    nodes, weights = np.polynomial.legendre.leggauss(3)
    step = length / count
    at = s[:-1, None] + step * (nodes + 1) / 2
    psi = heading(at)
    x = start.x + np.concatenate([[0.0], np.cumsum(np.cos(psi) @ weights) * step / 2])
    y = start.y + np.concatenate([[0.0], np.cumsum(np.sin(psi) @ weights) * step / 2])
    times = None
    if curve.start_time is not None and curve.stop_time is not None:
        times = np.linspace(float(curve.start_time), float(curve.stop_time), count + 1)
    return SampledCurve(s, x, y, heading(s), times)


def _spline(
    curve: ClothoidSpline, start: Place | None, resolve: Callable[[Any], Place]
) -> SampledCurve:
    parts = list[SampledCurve]()
    times = [*(piece.time for piece in curve.pieces), curve.end_time]
    timed = None not in times
    for piece, begin, end in zip(curve.pieces, times, times[1:], strict=False):
        if piece.position is not None:
            start = resolve(piece.position)
        if start is None:
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                "a clothoid spline has no start, and no entity follows it",
                hint="give the `position` of its first piece",
            )
        start = start._replace(h=start.h + float(piece.turn))
        length = float(piece.length)
        made = Clothoid(
            position=WorldPosition(x=0.0, y=0.0),
            curvature=piece.start,
            curvature_rate=(float(piece.end) - float(piece.start)) / length,
            length=length,
            start_time=begin if timed else None,
            stop_time=end if timed else None,
        )
        parts.append(_clothoid(made, start))
        start = parts[-1].at(length)
    shifts = np.concatenate([[0.0], np.cumsum([part.length for part in parts])])
    first, rest = parts[0], parts[1:]

    def joined(name: str) -> Float:
        found: Float = np.concatenate([getattr(first, name), *(getattr(r, name)[1:] for r in rest)])
        return found

    s = np.concatenate(
        [first.s, *(r.s[1:] + shift for r, shift in zip(rest, shifts[1:], strict=False))]
    )
    at = joined("times") if timed else None
    return SampledCurve(s, joined("x"), joined("y"), joined("h"), at)


def _nurbs(curve: Nurbs, places: list[Place]) -> SampledCurve:
    degree = curve.order - 1
    knots = np.array([float(k) for k in curve.knots])
    if (np.diff(knots) < 0).any():
        raise WorldError(ErrorCode.INVALID_REQUEST, "knots of a NURBS decrease", hint="order them")
    weights = np.array([float(p.weight) for p in curve.points])
    points = np.array([(p.x, p.y) for p in places]) * weights[:, None]
    homogeneous = np.column_stack([points, weights])
    timed = all(p.time is not None for p in curve.points)
    if timed:
        clock = np.array([float(p.time or 0.0) for p in curve.points])
        homogeneous = np.column_stack([homogeneous, clock * weights])
    outline = float(np.hypot(*np.diff([(p.x, p.y) for p in places], axis=0).T).sum())
    count = min(max(math.ceil(2 * outline / SAMPLE), 50), MAX_SAMPLES)
    values = np.linspace(knots[degree], knots[-degree - 1], count + 1)
    found = np.array([_de_boor(knots, homogeneous, degree, float(u)) for u in values])
    x, y = found[:, 0] / found[:, 2], found[:, 1] / found[:, 2]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    h = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    times = np.maximum.accumulate(found[:, 3] / found[:, 2]) if timed else None
    return SampledCurve(s, x, y, h, times)


def _de_boor(knots: Float, points: Float, degree: int, u: float) -> Float:
    """A point of a B-spline (de Boor 1972)."""
    k = int(np.searchsorted(knots, u, side="right")) - 1
    k = min(max(k, degree), len(points) - 1)
    d = [points[j + k - degree] for j in range(degree + 1)]
    for r in range(1, degree + 1):
        for j in range(degree, r - 1, -1):
            low = knots[j + k - degree]
            span = knots[j + 1 + k - r] - low
            a = (u - low) / span if span > 0 else 0.0
            d[j] = (1.0 - a) * d[j - 1] + a * d[j]
    found: Float = d[degree]
    return found
