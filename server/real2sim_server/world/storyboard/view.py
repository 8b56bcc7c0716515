"""Entities of a storyboard at an instant: controllers, queries and positions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard_actions import (
    LanePosition,
    LightStateAction,
    Orientation,
    Position,
    RelativeLanePosition,
    RelativeObjectPosition,
    RelativeRoadPosition,
    RelativeWorldPosition,
    RoadPosition,
    RoutePosition,
    SpeedLimits,
    TrajectoryPosition,
    WorldPosition,
)
from real2sim_proto.storyboard_conditions import Frame, Measure

from ...edit import ObjectState
from ...scene import Ground
from ..boxes import REAR_OVERHANG
from ..common import WorldError, copy_with
from ..path import LoggedPath
from ..traffic.driver import AgentPose, ObservedEgo, Surroundings, level_quaternion
from .roads import Place, RoadNetwork, RoadPoint, Trajectory, Way, course_of, straight

ACROSS = math.radians(45.0)
"""Maximum heading difference to a lane; entities beyond it continue straight instead [rad]."""

MAX_ROUTE_OFFSET = 10.0
"""Maximum distance from its assigned route at which an entity that is placed follows it [m]."""

SLOW = 0.5
"""Minimum speed at which lateral motion changes the heading [m/s]."""


class Moved(NamedTuple):
    """Distance covered [m], final speed [m/s], and the continuing controller (None if done)."""

    way: float
    speed: float
    then: Longitudinal | None


class Longitudinal(Protocol):
    """Longitudinal controller. Immutable; ``token`` identifies its action."""

    @property
    def token(self) -> int: ...  # noqa: D102

    def step(self, actor: EntityState, view: Any, h: float) -> Moved:
        """The motion after ``h`` seconds."""


class Shifted(NamedTuple):
    """Lateral offset [m], and the continuing controller (None if done)."""

    offset: float
    then: Lateral | None


class Lateral(Protocol):
    """Lateral controller. Immutable; ``token`` identifies its action."""

    @property
    def token(self) -> int: ...  # noqa: D102

    def step(self, actor: EntityState, view: Any, way: float, h: float) -> Shifted:
        """The change after ``h`` seconds and ``way`` metres."""


@dataclass(frozen=True, eq=False)
class EntityState:
    """An entity at one instant. Immutable.

    Attributes:
        name, category: name and category of the entity.
        subject: its object; None for the ego.
        size: size of its box [m].
        centre: box centre relative to the reference point [m].
        x, y, h: reference point [m], heading [rad].
        z: height of the reference point [m]; None for the ground.
        speed: speed [m/s]; negative in reverse.
        drift: part of it across the path, positive left [m/s].
        acceleration: along its path [m/s^2].
        way: path that it follows; None for an ego driven by a planner.
        route: assigned route, which it follows once it is near and heads along it, or None.
        s, offset: distance along the path, and offset from it [m].
        turn: heading relative to the path, besides that of its drift [rad].
        travelled: distance travelled since the start of the episode [m].
        present: whether it has been added and not deleted; others do not move.
        visible: whether it is seen.
        scripted: whether the storyboard moves it.
        longitudinal, lateral: active controllers, or None.
        trajectory: trajectory that it follows instead of its path, or None.
        finished: tokens of finished actions.
        performance: limits of its speed and acceleration.
        lights: the last action on each lamp, and when it started [s].
    """

    name: str
    category: str
    subject: ObjectState | None
    size: tuple[float, float, float]
    centre: tuple[float, float, float]
    x: float
    y: float
    h: float
    z: float | None = None
    speed: float = 0.0
    drift: float = 0.0
    acceleration: float = 0.0
    way: Way | None = None
    route: Way | None = None
    s: float = 0.0
    offset: float = 0.0
    turn: float = 0.0
    travelled: float = 0.0
    present: bool = True
    visible: bool = True
    scripted: bool = True
    longitudinal: Longitudinal | None = None
    lateral: Lateral | None = None
    trajectory: Trajectory | None = None
    finished: frozenset[int] = frozenset()
    performance: SpeedLimits = field(default_factory=SpeedLimits)
    lights: Mapping[str, tuple[LightStateAction, float]] = field(default_factory=dict)

    @property
    def middle(self) -> tuple[float, float]:
        """Box centre in the plane [m]."""
        cos, sin = math.cos(self.h), math.sin(self.h)
        cx, cy, _ = self.centre
        return self.x + cx * cos - cy * sin, self.y + cx * sin + cy * cos

    @property
    def axle(self) -> tuple[float, float]:
        """Rear axle centre of the ego [m]; may differ from the reference point."""
        ahead, left = self._axle
        cos, sin = math.cos(self.h), math.sin(self.h)
        return self.x + ahead * cos - left * sin, self.y + ahead * sin + left * cos

    @property
    def _axle(self) -> tuple[float, float]:
        """Rear axle of the ego relative to the reference point, ahead and to the left [m]."""
        return self.centre[0] - (self.size[0] / 2 - REAR_OVERHANG), self.centre[1]

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity of its reference point, world frame [m/s]."""
        yaw = self.h
        if self.way is not None and self.trajectory is None:
            yaw = self.way.path.at(self.s)[3]
        cos, sin = math.cos(yaw), math.sin(yaw)
        ahead = math.copysign(math.sqrt(max(self.speed**2 - self.drift**2, 0.0)), self.speed)
        return ahead * cos - self.drift * sin, ahead * sin + self.drift * cos

    def tokens(self) -> set[int]:
        """Tokens of the actions that currently move it."""
        moving = (self.longitudinal, self.lateral, self.trajectory)
        return {m.token for m in moving if m is not None}

    def put(self, place: Place, network: RoadNetwork) -> EntityState:
        """The entity at a place, on its route, the lane there or a straight path.

        It keeps its speed, and its heading relative to the route or lane.
        """
        put = copy_with(
            self, x=place.x, y=place.y, h=place.h, z=place.z, drift=0.0, trajectory=None
        )
        route = self.route
        near = route is not None and put.heads_along(route.path, MAX_ROUTE_OFFSET)
        put = put.on_route(route) if near and route is not None else put.on_lane(network)
        assert put.way is not None
        turn = 0.0 if put.way.lane == 0 else place.h - put.way.path.at(put.s)[3]
        return copy_with(put, turn=math.remainder(turn, math.tau))

    def on_lane(self, network: RoadNetwork) -> EntityState:
        """The entity on the lane at its position if it heads along it, else on a straight path."""
        found = network.locate(self.x, self.y, self.h)
        turn = math.remainder(self.h - found.h, math.tau) if found is not None else 0.0
        if found is None or min(abs(turn), math.pi - abs(turn)) > ACROSS:
            way = Way("", 0, True, straight(self.x, self.y, self.h))
        else:
            along = abs(turn) <= math.pi / 2
            way = network.way(found.road, found.lane, found.s, along=along)
        return self.on_way(way)

    def heads_along(self, path: LoggedPath, within: float = math.inf) -> bool:
        """Whether it is at most ``within`` [m] from a path and roughly heads along it."""
        near = path.nearest(self.x, self.y)
        away = math.dist((self.x, self.y), near.position[:2])
        return away <= within and abs(math.remainder(near.yaw - self.h, math.tau)) <= ACROSS

    @property
    def follows_route(self) -> bool:
        """Whether its path is its route."""
        return self.route is not None and self.way is self.route

    def on_route(self, route: Way) -> EntityState:
        """The entity on a route, which becomes its own."""
        return copy_with(self, route=route, trajectory=None, lateral=None).on_way(route)

    def on_way(self, way: Way) -> EntityState:
        """The entity on another path, at its current offset from it."""
        near = way.path.nearest(self.x, self.y)
        s, offset = near.s, near.offset
        if near.s <= 0.0 or near.s >= way.path.length:
            # Paths continue straight beyond their ends, but the nearest point is the end itself.
            dx, dy = self.x - near.position[0], self.y - near.position[1]
            s += dx * math.cos(near.yaw) + dy * math.sin(near.yaw)
        return copy_with(self, way=way, s=s, offset=offset)

    def placed(self) -> EntityState:
        """The entity at its path, s and offset, rotated by its drift."""
        assert self.way is not None
        x, y, _, yaw = self.way.path.at(self.s)
        drifting = 0.0
        if abs(self.speed) > SLOW and self.drift:
            drifting = math.asin(min(max(self.drift / self.speed, -1.0), 1.0))
        return copy_with(
            self,
            x=x - self.offset * math.sin(yaw),
            y=y + self.offset * math.cos(yaw),
            h=yaw + self.turn + drifting,
        )

    def pose(self, ground: Ground) -> AgentPose:
        """Pose of its box, level."""
        x, y = self.middle
        z = ground.height(x, y) + self.size[2] / 2 if self.z is None else self.z + self.centre[2]
        return AgentPose(
            (x, y, z), level_quaternion(self.h), math.remainder(self.h, math.tau),
            (*self.velocity, 0.0),
        )  # fmt: skip


def observed(actor: EntityState, ego: ObservedEgo, dt: float) -> EntityState:
    """The ego after a planner's step of ``dt`` seconds; ``actor`` is its extrapolated state."""
    axle_ahead, left = actor._axle
    ahead = ego.front - ego.length / 2 + axle_ahead
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    x, y = ego.x - ahead * cos + left * sin, ego.y - ahead * sin - left * cos
    rate = (ego.speed - actor.speed) / dt if dt > 0.0 else 0.0
    return copy_with(actor, x=x, y=y, h=ego.yaw, speed=ego.speed, acceleration=rate, way=None)


def coasting(actor: EntityState, h: float) -> EntityState:
    """The ego extrapolated by ``h`` seconds."""
    way = actor.speed * h
    return copy_with(
        actor,
        x=actor.x + way * math.cos(actor.h),
        y=actor.y + way * math.sin(actor.h),
        travelled=actor.travelled + abs(way),
    )


MAX_LANE_OFFSET = 8.0
"""Maximum distance of places from a path for distances along it [m]."""

CLOSED = 1e-9


@dataclass(frozen=True, eq=False)
class View:
    """One instant.

    Attributes:
        elapsed: time since the start of the episode [s].
        first: whether it is the first instant of its step, for which surroundings are exact.
        entities: entities by name.
        network: road network.
        surroundings: surroundings of the step.
    """

    elapsed: float
    first: bool
    entities: Mapping[str, EntityState]
    network: RoadNetwork
    surroundings: Surroundings


def distance_ahead(actor: EntityState, x: float, y: float, network: RoadNetwork) -> float:
    """Distance ahead to a place along an entity's path [m]; along its heading if off the path."""
    way = actor.way if actor.trajectory is None else None
    if way is None:
        way = actor.on_lane(network).way
    assert way is not None
    here = way.path.nearest(actor.x, actor.y).s if actor.way is not way else actor.s
    near = way.path.nearest(x, y)
    if abs(near.offset) > MAX_LANE_OFFSET or way.lane == 0:
        return along(actor.h, x - actor.x, y - actor.y)
    beyond = 0.0
    if near.s <= 0.0 or near.s >= way.path.length:
        beyond = along(near.yaw, x - near.position[0], y - near.position[1])
    return near.s + beyond - here


def along(h: float, dx: float, dy: float) -> float:
    """Component of a vector along a heading."""
    return dx * math.cos(h) + dy * math.sin(h)


def across(h: float, dx: float, dy: float) -> float:
    """Component of a vector to the left of a heading."""
    return dy * math.cos(h) - dx * math.sin(h)


def offsets(
    actor: EntityState, place: Place, frame: Frame, network: RoadNetwork
) -> tuple[float, float]:
    """A place relative to an entity: ahead and to the left [m], entity or lane coordinates."""
    dx, dy = place.x - actor.x, place.y - actor.y
    if frame == "entity":
        return along(actor.h, dx, dy), across(actor.h, dx, dy)
    here = network.locate(actor.x, actor.y, actor.h)
    there = network.locate(place.x, place.y, place.h)
    if here is None or there is None or here.road != there.road:
        return along(actor.h, dx, dy), across(actor.h, dx, dy)
    sense = 1.0 if math.cos(actor.h - here.h) >= 0.0 else -1.0
    return sense * (there.s - here.s), sense * (there.t - here.t)


def distance_to(
    actor: EntityState, other: EntityState | Place, measure: Measure, frame: Frame, *,
    freespace: bool, network: RoadNetwork,
) -> float:  # fmt: skip
    """Distance of an entity to another one or to a place [m], at least 0."""
    if measure == "euclidean":
        if not freespace:
            return math.hypot(other.x - actor.x, other.y - actor.y)
        return box_distance(corners(actor), _outline(other))
    place = Place(other.x, other.y, other.h)
    number = 0 if measure == "longitudinal" else 1
    if not freespace:
        return abs(offsets(actor, place, frame, network)[number])
    h = actor.h
    if frame != "entity" and (here := network.locate(actor.x, actor.y, actor.h)) is not None:
        h = here.h
    own, others = _extent(corners(actor), h, number), _extent(_outline(other), h, number)
    if frame != "entity":
        # Along a curve, the distance follows the path; boxes keep their extents.
        between = offsets(actor, place, frame, network)[number]
        sense = 1.0 if math.cos(actor.h - h) >= 0.0 else -1.0
        pick = along if number == 0 else across
        straight_on = pick(h, place.x - actor.x, place.y - actor.y)
        shift = sense * between - straight_on
        others = (others[0] + shift, others[1] + shift)
    return max(own[0] - others[1], others[0] - own[1], 0.0)


def closing_speed(actor: EntityState, other: EntityState | Place, measure: Measure) -> float:
    """Rate at which the distance decreases [m/s]."""
    vx, vy = actor.velocity
    ox, oy = other.velocity if isinstance(other, EntityState) else (0.0, 0.0)
    dx, dy = other.x - actor.x, other.y - actor.y
    if measure == "euclidean":
        distance = math.hypot(dx, dy)
        return ((vx - ox) * dx + (vy - oy) * dy) / distance if distance > CLOSED else 0.0
    pick = along if measure == "longitudinal" else across
    return pick(actor.h, vx - ox, vy - oy) * math.copysign(1.0, pick(actor.h, dx, dy))


def corners(actor: EntityState) -> list[tuple[float, float]]:
    """Corners of its box in the plane, in order [m]."""
    x, y = actor.middle
    return box_corners_of(x, y, actor.h, actor.size[0], actor.size[1])


def box_corners_of(
    x: float, y: float, h: float, length: float, width: float
) -> list[tuple[float, float]]:
    """Corners of a rectangle, in order [m]."""
    cos, sin = math.cos(h), math.sin(h)
    half, side = length / 2, width / 2
    return [
        (x + a * cos - b * sin, y + a * sin + b * cos)
        for a, b in ((half, side), (-half, side), (-half, -side), (half, -side))
    ]


def box_distance(a: list[tuple[float, float]], b: list[tuple[float, float]]) -> float:
    """Distance between two convex outlines [m]; 0 if they touch or overlap."""
    if overlapping(a, b):
        return 0.0
    pairs = [(p, edge) for p in a for edge in _edges(b)]
    pairs += [(p, edge) for p in b for edge in _edges(a)]
    return min(_to_segment(p, *edge) for p, edge in pairs)


def overlapping(a: list[tuple[float, float]], b: list[tuple[float, float]]) -> bool:
    """Whether two convex outlines overlap (separating axes)."""
    for outline in (a, b):
        for (x0, y0), (x1, y1) in _edges(outline):
            nx, ny = y1 - y0, x0 - x1
            of_a = [nx * x + ny * y for x, y in a]
            of_b = [nx * x + ny * y for x, y in b]
            if max(of_a) < min(of_b) or max(of_b) < min(of_a):
                return False
    return True


def _outline(other: EntityState | Place) -> list[tuple[float, float]]:
    return corners(other) if isinstance(other, EntityState) else [(other.x, other.y)]


def _extent(outline: list[tuple[float, float]], h: float, number: int) -> tuple[float, float]:
    pick = along if number == 0 else across
    values = [pick(h, x, y) for x, y in outline]
    return min(values), max(values)


def _edges(
    outline: list[tuple[float, float]],
) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    if len(outline) == 1:
        return [(outline[0], outline[0])]
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _to_segment(p: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    u = 0.0 if square == 0.0 else ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square
    u = min(max(u, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - u * dx, p[1] - a[1] - u * dy)


class PositionResolver:
    """Resolves positions to places at one instant.

    Attributes:
        entities: current entities by name.
        network: road network.
        origin: x, y [m] and heading [rad] of the map frame in the world.
    """

    def __init__(
        self,
        entities: Mapping[str, EntityState],
        network: RoadNetwork,
        origin: tuple[float, float, float],
    ) -> None:
        self.entities, self.network, self.origin = entities, network, origin

    def of(self, position: Position) -> Place:
        """The place of a position.

        Raises:
            WorldError: INVALID_REQUEST for a road or lane that does not exist, or a position
                relative to an entity outside all lanes.
        """
        found: Place = _RESOLVE[type(position)](self, position)
        return found

    def _world(self, p: WorldPosition) -> Place:
        x0, y0, h0 = self.origin
        x, y = float(p.x), float(p.y)
        cos, sin = math.cos(h0), math.sin(h0)
        z = None if p.z is None else float(p.z)
        return Place(x0 + x * cos - y * sin, y0 + x * sin + y * cos, h0 + float(p.h), z)

    def _relative_world(self, p: RelativeWorldPosition) -> Place:
        entity, h0 = self.entities[p.entity], self.origin[2]
        return _beside(entity, h0, float(p.dx), float(p.dy), self._turned(p.orientation, entity.h))

    def _relative_object(self, p: RelativeObjectPosition) -> Place:
        entity = self.entities[p.entity]
        h = self._turned(p.orientation, entity.h)
        return _beside(entity, entity.h, float(p.dx), float(p.dy), h)

    def _road(self, p: RoadPosition) -> Place:
        place = self.network.place(p.road, float(p.s), float(p.t))
        return place._replace(h=self._heading(p.orientation, place.h))

    def _lane(self, p: LanePosition) -> Place:
        return self._in_lane(p.road, int(p.lane), float(p.s), float(p.offset), p.orientation)

    def _relative_road(self, p: RelativeRoadPosition) -> Place:
        here, along = self._where(p.entity)
        road, _, s, sense = self._onward(p.entity, here, along, float(p.ds))
        place = self.network.place(road, s, sense * (here.t + float(p.dt)))
        return place._replace(h=self._heading(p.orientation, place.h))

    def _relative_lane(self, p: RelativeLanePosition) -> Place:
        here, driving = self._where(p.entity)
        along = driving if p.along == "lane" else 1.0
        road, lane, s, sense = self._onward(p.entity, here, driving, along * float(p.ds))
        left = sense * along
        lane = self.network.neighbour(road, lane, s, int(p.lanes) * int(left))
        if p.along == "lane":
            return self._in_lane(road, lane, s, left * float(p.offset), p.orientation)
        t = self.network.middle(road, lane, s) + left * float(p.offset)
        place = self.network.place(road, s, t)
        return place._replace(h=self._heading(p.orientation, place.h))

    def _onward(
        self, entity: str, here: RoadPoint, driving: float, ds: float
    ) -> tuple[str, int, float, float]:
        """As ``RoadNetwork.onward``, but along the route of an entity that follows one."""
        actor = self.entities[entity]
        if actor.way is not None and actor.follows_route:
            s = actor.s + driving * ds
            x, y, _, h = actor.way.path.at(s)
            x, y = x - actor.offset * math.sin(h), y + actor.offset * math.cos(h)
            there = self.network.locate(x, y, h) if 0.0 <= s <= actor.way.path.length else None
            if there is not None:
                sense = driving * math.copysign(1.0, math.cos(h - there.h))
                return there.road, there.lane, there.s, sense
        return self.network.onward(here.road, here.lane, here.s, ds)

    def _route(self, p: RoutePosition) -> Place:
        path = self.network.route([self.of(w) for w in p.route.waypoints])
        x, y, _, h = path.at(float(p.s))
        t = float(p.t)
        here = self.network.locate(x, y, h) if p.lane is not None else None
        if here is not None and p.lane is not None:
            return self._in_lane(here.road, int(p.lane), here.s, t, p.orientation)
        place = Place(x - t * math.sin(h), y + t * math.cos(h), h)
        return place._replace(h=self._heading(p.orientation, h))

    def _trajectory(self, p: TrajectoryPosition) -> Place:
        x, y, h, _ = course_of(p.curve, self.of).at(float(p.s))
        t = float(p.t)
        place = Place(x - t * math.sin(h), y + t * math.cos(h), h)
        return place._replace(h=self._heading(p.orientation, h))

    def _in_lane(
        self, road: str, lane: int, s: float, offset: float, orientation: Orientation | None
    ) -> Place:
        place = self.network.place(road, s, self.network.middle(road, lane, s) + offset)
        if lane == 0:
            return place._replace(h=self._heading(orientation, place.h))
        way = self.network.way(road, lane, s, along=self.network.drives_along(road, lane))
        driving = way.path.nearest(place.x, place.y).yaw
        return place._replace(h=self._heading(orientation, driving))

    def _where(self, entity: str) -> tuple[RoadPoint, float]:
        """Road position of an entity; and 1 if it drives along the reference line, else -1."""
        actor = self.entities[entity]
        here = self.network.locate(actor.x, actor.y, actor.h)
        if here is None:
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"a position is relative to the lane of {entity!r}, which is on no lane",
                hint="place it on a lane, or give a world position",
            )
        return here, 1.0 if math.cos(actor.h - here.h) >= 0.0 else -1.0

    def _heading(self, orientation: Orientation | None, base: float) -> float:
        return base if orientation is None else self._turned(orientation, base)

    def _turned(self, orientation: Orientation, base: float) -> float:
        h = float(orientation.h)
        return base + h if orientation.relative else self.origin[2] + h


def _beside(entity: EntityState, axes: float, dx: float, dy: float, h: float) -> Place:
    cos, sin = math.cos(axes), math.sin(axes)
    return Place(entity.x + dx * cos - dy * sin, entity.y + dx * sin + dy * cos, h)


_RESOLVE: Mapping[type[Any], Any] = {
    WorldPosition: PositionResolver._world,
    RelativeWorldPosition: PositionResolver._relative_world,
    RelativeObjectPosition: PositionResolver._relative_object,
    RoadPosition: PositionResolver._road,
    LanePosition: PositionResolver._lane,
    RelativeRoadPosition: PositionResolver._relative_road,
    RelativeLanePosition: PositionResolver._relative_lane,
    RoutePosition: PositionResolver._route,
    TrajectoryPosition: PositionResolver._trajectory,
}
