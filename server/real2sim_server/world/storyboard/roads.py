"""Roads and lanes as a storyboard asks for them: places by road and lane, and ways to drive."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import RouteLanes

from ...scene.errors import SceneError
from ...scene.lane import LANE_KINDS
from ...scene.lane_graph import LaneGraph
from ...scene.road import Road
from ..common import WorldError
from ..path import Float, LoggedPath
from ..traffic.idm import STRAIGHT, lane_beside


class Place(NamedTuple):
    """Somewhere: x, y [m], heading [rad], height [m] or None: on the ground."""

    x: float
    y: float
    h: float
    z: float | None = None


class RoadPoint(NamedTuple):
    """Where something is on a road.

    Attributes:
        road, lane: ids; the lane that it is in.
        s, t: along the reference line, and left of it [m].
        h: heading of the reference line [rad].
    """

    road: str
    lane: int
    s: float
    t: float
    h: float


class Way(NamedTuple):
    """A lane to drive along.

    Attributes:
        road, lane: ids; lane 0 is none: straight on beside the road.
        along: in the direction of the reference line.
        path: its middle, in the direction of driving.
        length: where it ends along the path [m]; infinite where it does not.
        assigned: whether it is a route that was assigned, and no lane.
    """

    road: str
    lane: int
    along: bool
    path: LoggedPath
    length: float = math.inf
    assigned: bool = False


class RoadNetwork(Protocol):
    """Roads of one scene. Never changes."""

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:
        """Where a place with a heading is on the roads; None beside all lanes."""

    def place(self, road: str, s: float, t: float) -> Place:
        """The place beside a reference line, with its heading. Raises WorldError: no such road."""

    def middle(self, road: str, lane: int, s: float) -> float:
        """t of the middle of a lane. Raises WorldError: no such lane there."""

    def drives_along(self, road: str, lane: int) -> bool:
        """Whether traffic of a lane goes in the direction of the reference line."""

    def way(self, road: str, lane: int, s: float, *, along: bool) -> Way:
        """The lane as a way to drive from ``s`` on. Raises WorldError: no such lane there."""

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:
        """Id of the lane so many in the direction of +t. Raises WorldError: no such lane."""

    def route(self, places: list[Place]) -> LoggedPath:
        """The way along lanes through places. Raises WorldError: there is none."""


@dataclass(frozen=True, eq=False)
class RouteNetwork:
    """Lanes beside the ego's route, straight on before and behind it.

    Attributes:
        spec: widths and numbers of lanes.
        route: of the ego.
        reference: the reference line, in the direction of the route.
        ways: made so far, by lane and direction; each is the same whenever it is made.
    """

    spec: RouteLanes
    route_path: LoggedPath
    reference: LoggedPath
    ways: dict[tuple[int, bool], Way] = field(default_factory=dict)

    @classmethod
    def of(cls, spec: RouteLanes, route: LoggedPath) -> RouteNetwork:
        """Lanes along a route."""
        shift = (abs(spec.ego_lane) - 0.5) * spec.lane_width
        return cls(spec, route, lane_beside(route, shift))

    @property
    def _shift(self) -> float:
        """Of s along ``reference`` against s of the road [m]."""
        return STRAIGHT - self.spec.s

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:  # noqa: D102
        near = self.reference.nearest(x, y)
        width = self.spec.lane_width
        number = int(abs(near.offset) // width) + 1
        if number > (self.spec.left if near.offset > 0 else self.spec.right):
            return None
        lane = number if near.offset > 0 else -number
        return RoadPoint("route", lane, near.s - self._shift, near.offset, near.yaw)

    def place(self, road: str, s: float, t: float) -> Place:  # noqa: D102
        x, y, _, yaw = self.reference.at(s + self._shift)
        return Place(x - t * math.sin(yaw), y + t * math.cos(yaw), yaw)

    def middle(self, road: str, lane: int, s: float) -> float:  # noqa: D102
        if lane == 0 or not -self.spec.right <= lane <= self.spec.left:
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
            path = lane_beside(self.route_path, offset, oncoming=not along)
            known = self.ways[lane, along] = Way("route", lane, along, path)
        return known

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:  # noqa: D102
        found = skipping_zero(lane, lanes)
        self.middle(road, found, s)
        return found

    def route(self, places: list[Place]) -> LoggedPath:  # noqa: D102
        return path_through(places)


def skipping_zero(lane: int, lanes: int) -> int:
    """Id of the lane so many in the direction of +t; there is no lane 0."""
    found = lane + lanes
    crossed = (lane < 0) != (found < 0) or found == 0
    return found + (1 if lanes > 0 else -1) if crossed and lanes else found


def straight(x: float, y: float, h: float, *, z: float = 0.0) -> LoggedPath:
    """The straight way on from a place."""
    ahead = [x + math.cos(h), y + math.sin(h), z]
    ups = np.array([[0.0, 0.0, 1.0]] * 2)
    return LoggedPath.through(np.array([[x, y, z], ahead]), np.array([h, h]), ups)


def path_through(places: list[Place]) -> LoggedPath:
    """Straight from place to place, heading along; two places at least that differ."""
    points = np.array([(p.x, p.y, p.z or 0.0) for p in places])
    steps = np.diff(points[:, :2], axis=0)
    kept = np.concatenate([[True], np.hypot(steps[:, 0], steps[:, 1]) > 1e-6])
    points = points[kept]
    if len(points) < 2:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a route or trajectory leads nowhere: all its places are the same",
            hint="give two places at least",
        )
    steps = np.diff(points[:, :2], axis=0)
    yaws = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    ups = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return LoggedPath.through(points, np.append(yaws, yaws[-1]), ups)


REACH = 2000.0
"""Ways go on so far, as long as there are lanes [m]."""


@dataclass(frozen=True, eq=False)
class GraphNetwork:
    """Roads with numbered lanes, of a map in OpenDRIVE. Where a road forks, a way goes on along
    the lane that turns least.

    Attributes:
        graph: in the frame of the world.
        ways: made so far, by lane and direction; each is the same whenever it is made.
    """

    graph: LaneGraph
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

    def place(self, road: str, s: float, t: float) -> Place:  # noqa: D102
        found = self._road(road)
        x, y, z, h = found.at(s, t)
        beyond = min(s, 0.0) + max(s - found.length, 0.0)
        return Place(x + beyond * math.cos(h), y + beyond * math.sin(h), h, z)

    def middle(self, road: str, lane: int, s: float) -> float:  # noqa: D102
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

    def _between(self, names: tuple[str, ...], start: float, end: float) -> Float:
        """Points along lanes from ``start`` on the first to ``end`` on the last; a change of lanes
        goes straight to the neighbour's middle."""
        lanes = [self.graph.lane(name) for name in names]
        parts = list[Float]()
        for k, lane in enumerate(lanes):
            low = start if k == 0 else 0.0
            high = end if k == len(lanes) - 1 else lane.length
            inner = lane.centre[(lane.s > low) & (lane.s < high)]
            parts += [np.array([lane.at(low)[:3]]), inner, np.array([lane.at(high)[:3]])]
        return np.concatenate(parts)

    def _road(self, road: str) -> Road:
        try:
            return self.graph.road(road)
        except SceneError as error:
            raise _refused(error) from error

    def _part(self, road: str, lane: int, s: float) -> tuple[str, float]:
        """Id of a lane of the graph, and t of its middle."""
        found = self._road(road)
        held = min(max(s, 0.0), found.length)
        try:
            part = found.lane(lane, held)
        except SceneError as error:
            raise _refused(error) from error
        return part.lane_id, part.centre_t(held)

    def _path(self, lane_id: str, *, forwards: bool) -> tuple[LoggedPath, float]:
        lanes, length = [self.graph.lane(lane_id)], 0.0
        before = self.graph.predecessors
        while length < REACH:
            length += lanes[-1].length
            names = lanes[-1].successors if forwards else before[lanes[-1].lane_id]
            onward = [self.graph.lane(n) for n in names]
            onward = [lane for lane in onward if lane not in lanes]
            if not onward:
                break
            lanes.append(min(onward, key=lambda lane: (lane.turn, lane.lane_id)))
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
