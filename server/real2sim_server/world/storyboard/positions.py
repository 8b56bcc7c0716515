"""Positions of a storyboard as places in the world."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard_actions import (
    LanePosition,
    Orientation,
    Position,
    RelativeLanePosition,
    RelativeObjectPosition,
    RelativeRoadPosition,
    RelativeWorldPosition,
    RoadPosition,
    RoutePosition,
    TrajectoryPosition,
    WorldPosition,
)

from ..errors import WorldError
from .entity_state import EntityState
from .roads import Place, RoadNetwork, RoadPoint
from .trajectory import course_of


class Places:
    """Turns positions into places at one instant.

    Attributes:
        entities: entities by name, as they are now.
        network: roads.
        origin: x, y [m] and heading [rad] of the map's frame in the world.
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
            WorldError: INVALID_REQUEST for a road or lane that there is not, or an entity beside
                all lanes that a position is relative to.
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
        return place._replace(h=self._heading(p.orientation, place.h, place.h))

    def _lane(self, p: LanePosition) -> Place:
        return self._in_lane(p.road, int(p.lane), float(p.s), float(p.offset), p.orientation)

    def _relative_road(self, p: RelativeRoadPosition) -> Place:
        here, sense = self._where(p.entity)
        place = self.network.place(
            here.road, here.s + sense * float(p.ds), here.t + sense * float(p.dt)
        )
        driving = place.h if sense > 0 else place.h + math.pi
        return place._replace(h=self._heading(p.orientation, place.h, driving))

    def _relative_lane(self, p: RelativeLanePosition) -> Place:
        here, sense = self._where(p.entity)
        lanes = int(p.lanes) * int(sense)
        lane = self.network.neighbour(here.road, here.lane, here.s, lanes)
        s = here.s + sense * float(p.ds)
        return self._in_lane(here.road, lane, s, float(p.offset), p.orientation)

    def _route(self, p: RoutePosition) -> Place:
        path = self.network.route([self.of(w) for w in p.route.waypoints])
        x, y, _, h = path.at(float(p.s))
        t = float(p.t)
        here = self.network.locate(x, y, h) if p.lane is not None else None
        if here is not None and p.lane is not None:
            return self._in_lane(here.road, int(p.lane), here.s, t, p.orientation)
        place = Place(x - t * math.sin(h), y + t * math.cos(h), h)
        return place._replace(h=self._heading(p.orientation, h, h))

    def _trajectory(self, p: TrajectoryPosition) -> Place:
        x, y, h, _ = course_of(p.curve, self.of).at(float(p.s))
        t = float(p.t)
        place = Place(x - t * math.sin(h), y + t * math.cos(h), h)
        return place._replace(h=self._heading(p.orientation, h, h))

    def _in_lane(
        self, road: str, lane: int, s: float, offset: float, orientation: Orientation | None
    ) -> Place:
        t = self.network.middle(road, lane, s) + offset
        place = self.network.place(road, s, t)
        driving = place.h if self.network.drives_along(road, lane) else place.h + math.pi
        return place._replace(h=self._heading(orientation, place.h, driving))

    def _where(self, entity: str) -> tuple[RoadPoint, float]:
        """Where an entity is on the road; 1 where it drives in its direction, else -1."""
        actor = self.entities[entity]
        here = self.network.locate(actor.x, actor.y, actor.h)
        if here is None:
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"a position is relative to the lane of {entity!r}, which is beside all lanes",
                hint="put it onto a lane, or give the position in the world",
            )
        return here, 1.0 if math.cos(actor.h - here.h) >= 0.0 else -1.0

    def _heading(self, orientation: Orientation | None, road: float, driving: float) -> float:
        return driving if orientation is None else self._turned(orientation, road)

    def _turned(self, orientation: Orientation, base: float) -> float:
        h = float(orientation.h)
        return base + h if orientation.relative else self.origin[2] + h


def _beside(entity: EntityState, axes: float, dx: float, dy: float, h: float) -> Place:
    cos, sin = math.cos(axes), math.sin(axes)
    return Place(entity.x + dx * cos - dy * sin, entity.y + dx * sin + dy * cos, h)


_RESOLVE: Mapping[type[Any], Any] = {
    WorldPosition: Places._world,
    RelativeWorldPosition: Places._relative_world,
    RelativeObjectPosition: Places._relative_object,
    RoadPosition: Places._road,
    LanePosition: Places._lane,
    RelativeRoadPosition: Places._relative_road,
    RelativeLanePosition: Places._relative_lane,
    RoutePosition: Places._route,
    TrajectoryPosition: Places._trajectory,
}
