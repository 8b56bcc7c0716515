"""One entity of a storyboard: where it is, and what moves it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from ...edit import ObjectState
from ...scene import Ground
from ..ego.box import REAR_OVERHANG
from ..evolve import evolved
from ..traffic.driver import AgentPose, ObservedEgo, level_quaternion
from .roads import Place, RoadNetwork, Way, straight
from .trajectory import Trajectory

ACROSS = math.radians(45.0)
"""Who heads further away than this from either direction of its lane goes straight on instead."""

SLOW = 0.5
"""Below this speed a drift sideways does not turn it [m/s]."""


class Moved(NamedTuple):
    """Way made [m], speed at the end [m/s], and what goes on changing it; None: done."""

    way: float
    speed: float
    then: Longitudinal | None


class Longitudinal(Protocol):
    """Changes a speed. Immutable; ``token`` is of the action that it belongs to."""

    @property
    def token(self) -> int: ...  # noqa: D102

    def step(self, actor: EntityState, view: Any, h: float) -> Moved:
        """``h`` seconds on."""


class Shifted(NamedTuple):
    """Offset from the way [m], and what goes on changing it; None: done."""

    offset: float
    then: Lateral | None


class Lateral(Protocol):
    """Changes an offset. Immutable; ``token`` is of the action that it belongs to."""

    @property
    def token(self) -> int: ...  # noqa: D102

    def step(self, actor: EntityState, view: Any, way: float, h: float) -> Shifted:
        """``h`` seconds and ``way`` metres on."""


@dataclass(frozen=True, eq=False)
class EntityState:
    """An entity at one instant. Immutable.

    Attributes:
        name: of the entity.
        category: of the entity.
        subject: the object that it is; None for the ego.
        size: of its box [m].
        centre: of its box from the reference point [m].
        x, y, h: reference point [m], heading [rad].
        z: of the reference point [m]; None: on the ground.
        speed: along its way [m/s].
        drift: sideways, positive to the left [m/s].
        acceleration: along its way [m/s^2].
        way: lane that it follows; None: of an ego that the planner drives.
        s, offset: along and beside the way [m].
        travelled: way since the episode began [m].
        visible: whether it is in the world.
        scripted: whether the storyboard moves it.
        longitudinal, lateral: what changes its speed and offset now; None: nothing.
        trajectory: what it follows instead of its way.
        finished: tokens of actions that have come to their end.
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
    s: float = 0.0
    offset: float = 0.0
    travelled: float = 0.0
    visible: bool = True
    scripted: bool = True
    longitudinal: Longitudinal | None = None
    lateral: Lateral | None = None
    trajectory: Trajectory | None = None
    finished: frozenset[int] = frozenset()

    @property
    def middle(self) -> tuple[float, float]:
        """Of its box seen from above [m]."""
        cos, sin = math.cos(self.h), math.sin(self.h)
        cx, cy, _ = self.centre
        return self.x + cx * cos - cy * sin, self.y + cx * sin + cy * cos

    @property
    def axle(self) -> tuple[float, float]:
        """Of the ego: the middle of its rear axle [m], which need not be its reference point."""
        ahead, left = self._axle
        cos, sin = math.cos(self.h), math.sin(self.h)
        return self.x + ahead * cos - left * sin, self.y + ahead * sin + left * cos

    @property
    def _axle(self) -> tuple[float, float]:
        """Of the ego: its rear axle from the reference point, ahead and to the left [m]."""
        return self.centre[0] - (self.size[0] / 2 - REAR_OVERHANG), self.centre[1]

    @property
    def velocity(self) -> tuple[float, float]:
        """Of its reference point, world [m/s]."""
        yaw = self.h
        if self.way is not None and self.trajectory is None:
            yaw = self.way.path.at(self.s)[3]
        cos, sin = math.cos(yaw), math.sin(yaw)
        return self.speed * cos - self.drift * sin, self.speed * sin + self.drift * cos

    def tokens(self) -> set[int]:
        """Of the actions that move it now."""
        moving = (self.longitudinal, self.lateral, self.trajectory)
        return {m.token for m in moving if m is not None}

    def put(self, place: Place, network: RoadNetwork) -> EntityState:
        """At a place, on the lane that is there or going straight on; its speed is left as it
        is."""
        put = evolved(self, x=place.x, y=place.y, h=place.h, z=place.z, drift=0.0, trajectory=None)
        return put.on_lane(network)

    def on_lane(self, network: RoadNetwork) -> EntityState:
        """On the lane that is where it is, if it heads along it; else straight on."""
        found = network.locate(self.x, self.y, self.h)
        turn = math.remainder(self.h - found.h, math.tau) if found is not None else 0.0
        if found is None or min(abs(turn), math.pi - abs(turn)) > ACROSS:
            way = Way("", 0, True, straight(self.x, self.y, self.h))
        else:
            along = abs(turn) <= math.pi / 2
            way = network.way(found.road, found.lane, found.s, along=along)
        return self.on_way(way)

    def on_way(self, way: Way) -> EntityState:
        """On another way, as far beside it as it is."""
        near = way.path.nearest(self.x, self.y)
        s, offset = near.s, near.offset
        if near.s <= 0.0 or near.s >= way.path.length:
            # Beyond the ends the nearest point is the end, and the way goes straight on.
            dx, dy = self.x - near.position[0], self.y - near.position[1]
            s += dx * math.cos(near.yaw) + dy * math.sin(near.yaw)
        return evolved(self, way=way, s=s, offset=offset)

    def placed(self) -> EntityState:
        """Where its way, s and offset say, turned by its drift."""
        assert self.way is not None
        x, y, _, yaw = self.way.path.at(self.s)
        turn = math.atan2(self.drift, self.speed) if abs(self.speed) > SLOW and self.drift else 0.0
        return evolved(
            self,
            x=x - self.offset * math.sin(yaw),
            y=y + self.offset * math.cos(yaw),
            h=yaw + turn,
        )

    def pose(self, ground: Ground) -> AgentPose:
        """Of its box, standing level."""
        x, y = self.middle
        z = ground.height(x, y) + self.size[2] / 2 if self.z is None else self.z + self.centre[2]
        return AgentPose(
            (x, y, z), level_quaternion(self.h), math.remainder(self.h, math.tau),
            (*self.velocity, 0.0),
        )  # fmt: skip


def observed(actor: EntityState, ego: ObservedEgo, dt: float) -> EntityState:
    """The ego as the planner has moved it in the step of ``dt`` seconds that led here; ``actor``
    is as it was taken to be."""
    axle_ahead, left = actor._axle
    ahead = ego.front - ego.length / 2 + axle_ahead
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    x, y = ego.x - ahead * cos + left * sin, ego.y - ahead * sin - left * cos
    rate = (ego.speed - actor.speed) / dt if dt > 0.0 else 0.0
    return evolved(actor, x=x, y=y, h=ego.yaw, speed=ego.speed, acceleration=rate, way=None)


def coasting(actor: EntityState, h: float) -> EntityState:
    """The ego ``h`` seconds on, as it goes now."""
    way = actor.speed * h
    return evolved(
        actor,
        x=actor.x + way * math.cos(actor.h),
        y=actor.y + way * math.sin(actor.h),
        travelled=actor.travelled + abs(way),
    )
