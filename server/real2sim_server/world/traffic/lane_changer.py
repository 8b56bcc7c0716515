"""Along the lanes of a map by the intelligent driver model, changing lanes by MOBIL."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Self
from weakref import WeakKeyDictionary
from zlib import crc32

import numpy as np

from real2sim_proto.episode import IdmDriver, LaneDriver

from ...edit import ObjectState
from ...scene.lane import TRAVELLED, Lane
from ...scene.lane_graph import LaneGraph
from ..path import LoggedPath
from .driver import AgentDriver, AgentPose, Surroundings, pose_on_path, recorded_pose
from .idm import (
    BACK_TO_LANE,
    Idm,
    Leader,
    Neighbours,
    acceleration,
    advance_along,
    desired_speed,
    incentive,
    leading_agent,
    neighbours,
)

AHEAD, BEHIND = 600.0, 100.0
"""A way goes on so far from the end of its lane, and begins so far before it, where there are lanes
[m]."""


@dataclass(frozen=True, eq=False)
class LaneWay:
    """Lanes one after the other, where they fork those that turn least.

    Attributes:
        path: along their centre lines.
        lanes: in their order.
        starts: where each begins along the path [m].
        goes_on: whether there are more lanes behind its end.
    """

    path: LoggedPath
    lanes: tuple[Lane, ...]
    starts: tuple[float, ...]
    goes_on: bool

    def lane_at(self, s: float) -> Lane:
        """The lane at a place along the path [m]."""
        return self.lanes[max(bisect_right(self.starts, s) - 1, 0)]


_WAYS: WeakKeyDictionary[LaneGraph, dict[str, LaneWay]] = WeakKeyDictionary()


def way_through(graph: LaneGraph, lane_id: str) -> LaneWay:
    """The way through a lane; each is made once for a graph. Raises SceneError."""
    known = _WAYS.setdefault(graph, {})
    if lane_id not in known:
        known[lane_id] = _made(graph, lane_id)
    return known[lane_id]


def _made(graph: LaneGraph, lane_id: str) -> LaneWay:
    lane = graph.lane(lane_id)
    before = _chain(graph, lane, BEHIND, lambda at: graph.predecessors[at.lane_id])
    after = _chain(graph, lane, AHEAD, lambda at: at.successors)
    lanes = (*reversed(before), lane, *after)
    points = np.concatenate([one.centre for one in lanes])
    yaws = np.unwrap(np.concatenate([one.headings for one in lanes]))
    path = LoggedPath.through(points, yaws, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    starts, reached = [], 0.0
    for k, one in enumerate(lanes):
        if k:
            reached += float(np.linalg.norm(one.centre[0, :2] - lanes[k - 1].centre[-1, :2]))
        starts.append(reached)
        reached += one.length
    onward = _travelled(graph, lanes[-1].successors)
    return LaneWay(path, lanes, tuple(starts), any(one not in lanes for one in onward))


def _chain(
    graph: LaneGraph, lane: Lane, reach: float, names: Callable[[Lane], Iterable[str]]
) -> list[Lane]:
    """Lanes one after the other from one on, without it, none twice."""
    found, length, at = list[Lane](), 0.0, lane
    while length < reach:
        onward = [n for n in _travelled(graph, names(at)) if n is not lane and n not in found]
        if not onward:
            break
        at = min(onward, key=lambda one: (one.turn, one.lane_id))
        found.append(at)
        length += at.length
    return found


def _travelled(graph: LaneGraph, names: Iterable[str]) -> list[Lane]:
    return [lane for lane in map(graph.lane, names) if lane.kind in TRAVELLED]


FARTHEST = 3.0
"""From the middle of a lane, where a driver begins in it [m]."""
HEADED = 0.7
"""Cosine of the angle to the lane from which on a vehicle drives along it."""
SETTLES = 2.0
"""Time between two changes of lanes [s]."""
SLOWEST = 3.0
"""At which it changes lanes: vehicles that hardly move do not move aside [m/s]."""
DECIDES_EVERY = 1.0
"""Time in which it thinks of a change once, at an instant of its own: two that always did so at
once would make way for each other for ever [s]."""
RENEWED = 200.0
"""Way that is left from which on a longer one is taken [m]."""


@dataclass(frozen=True, eq=False)
class LaneChanger:
    """Keeps to lanes of the map, at the lane's speed or behind its leader; changes to a neighbour
    where that gains more than others lose.

    Where lanes fork it takes the one that turns least; a lane that ends beside one that goes on is
    left for that. It leaves the world at the end of the map. Signals and rights of way are not
    known to it.

    Attributes:
        subject: the object.
        spec: parameters.
        way: along lanes.
        s, offset, speed: along and beside it [m], [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
        changing: offset at which a change of lanes began, and for how long it has gone on [s].
        settled: time since the last one [s].
    """

    subject: ObjectState
    spec: LaneDriver
    way: LaneWay
    s: float
    offset: float
    speed: float
    pose: AgentPose
    present: bool = True
    changing: tuple[float, float] | None = None
    settled: float = SETTLES

    @classmethod
    def begin(
        cls, subject: ObjectState, spec: LaneDriver, surroundings: Surroundings
    ) -> AgentDriver:
        """From where and how the object moves now; one that is in no lane keeps to its recorded
        path by the same parameters."""
        now, graph = recorded_pose(subject, surroundings.t_us), surroundings.lanes
        x, y, _ = now.position
        place = None
        if graph is not None:
            place = graph.nearest(x, y, now.yaw, kinds=TRAVELLED, within=FARTHEST)
        if graph is None or place is None or math.cos(place.heading - now.yaw) < HEADED:
            known = spec.model_dump(include=set(IdmDriver.model_fields) - {"kind"})
            return Idm.begin(subject, IdmDriver(**known), surroundings)
        way = way_through(graph, place.lane_id)
        near = way.path.nearest(x, y)
        vx, vy, _ = now.velocity
        speed = max(vx * math.cos(near.yaw) + vy * math.sin(near.yaw), 0.0)
        return cls(subject, spec, way, near.s, near.offset, speed, now)

    @property
    def aim(self) -> tuple[float, float]:
        """Way x, y that is left to the middle of its lane [m]."""
        yaw = self.way.path.at(self.s)[3]
        return self.offset * math.sin(yaw), -self.offset * math.cos(yaw)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        driver = self._on_a_long_way(surroundings)._in_the_better_lane(surroundings)
        return driver._moved(surroundings)

    def _on_a_long_way(self, surroundings: Surroundings) -> Self:
        if not self.way.goes_on or self.way.path.length - self.s > RENEWED:
            return self
        graph = surroundings.lanes
        assert graph is not None
        return self._onto(way_through(graph, self.way.lane_at(self.s).lane_id))

    def _onto(self, way: LaneWay) -> Self:
        near = way.path.nearest(self.pose.position[0], self.pose.position[1])
        return replace(self, way=way, s=near.s, offset=near.offset)

    # --- changes of lanes -------------------------------------------------------------------------

    def _in_the_better_lane(self, surroundings: Surroundings) -> Self:
        """The driver as it begins to change, where that pays; the left one where both pay alike."""
        graph, lane = surroundings.lanes, self.way.lane_at(self.s)
        ready = self.changing is None and self.settled >= SETTLES and self.speed > SLOWEST
        if graph is None or not (ready and self.spec.changes and self._decides(surroundings)):
            return self
        names = [lane.left if lane.may_change_left else None]
        names += [lane.right if lane.may_change_right else None]
        beside = [graph.lane(name) for name in names if name is not None]
        tried = [self._onto(way_through(graph, n.lane_id)) for n in beside if n.kind in TRAVELLED]
        if not tried:
            return self
        length = self.subject.scaled_size[0]
        here = self._seen(surroundings, tried), self._desired(lane)
        best, most = self, 0.0
        for other in tried:
            there = other._seen(surroundings, [self]), other._desired(other.way.lane_at(other.s))
            gain = incentive(self.spec, self.speed, length, here=here, there=there)
            if gain is not None and gain > most:
                best, most = replace(other, changing=(other.offset, 0.0), settled=0.0), gain
        return best

    def _decides(self, surroundings: Surroundings) -> bool:
        """Whether this is the step of the present second in which it thinks of a change."""
        steps = max(round(DECIDES_EVERY / surroundings.dt), 1)
        step = (surroundings.t_us - surroundings.start_us) // surroundings.dt_us
        number, phase = divmod(step, steps)
        return crc32(f"{self.subject.object_id} {number}".encode()) % steps == phase

    def _seen(self, surroundings: Surroundings, beside: list[Self]) -> Neighbours:
        """Neighbours in the middle of its lane; the end of a lane stands in the way, where one
        beside it goes on."""
        length, width, _ = self.subject.scaled_size
        found = neighbours(
            self.way.path,
            self.s,
            length=length,
            width=width,
            object_id=self.subject.object_id,
            surroundings=surroundings,
        )
        end = self._end(beside)
        if end is not None and (found.leader is None or end.gap < found.leader.gap):
            found = found._replace(leader=end)
        return found

    def _end(self, beside: list[Self]) -> Leader | None:
        left = self.way.path.length - self.s
        longer = any(o.way.path.length - o.s > left + self.subject.scaled_size[0] for o in beside)
        if self.way.goes_on or not longer:
            return None
        return Leader(left - self.subject.scaled_size[0] / 2, 0.0)

    # --- along the lane ---------------------------------------------------------------------------

    def _moved(self, surroundings: Surroundings) -> Self:
        dt = surroundings.dt
        s, speed = advance_along(self.s, self.speed, self._acceleration(surroundings), dt)
        changing, offset = self.changing, self.offset * math.exp(-dt / BACK_TO_LANE)
        if changing is not None:
            start, since = changing[0], changing[1] + dt
            offset = start * (1.0 - _eased(since / self.spec.change_time))
            changing = None if since >= self.spec.change_time else (start, since)
        pose = pose_on_path(
            self.way.path, s, speed, offset=offset, drift=(offset - self.offset) / dt
        )
        x, y, _ = pose.position
        z = surroundings.ground.height(x, y) + self.subject.scaled_size[2] / 2
        return replace(
            self,
            s=s,
            offset=offset,
            speed=speed,
            pose=pose._replace(position=(x, y, z)),
            present=s < self.way.path.length,
            changing=changing,
            settled=self.settled + dt if changing is None else 0.0,
        )

    def _acceleration(self, surroundings: Surroundings) -> float:
        """Behind whoever is next where it is, in its lane, and at the end of that."""
        length, width, _ = self.subject.scaled_size
        path, lane = self.way.path, self.way.lane_at(self.s)
        bend = path.sharpest_turn(self.s, 2.0 * self.speed)
        desired = min(self._desired(lane), math.sqrt(self.spec.lateral / max(bend, 1e-4)))
        leaders = [
            leading_agent(
                path,
                self.s,
                offset=offset,
                length=length,
                width=width,
                object_id=self.subject.object_id,
                surroundings=surroundings,
            )
            for offset in ((0.0, self.offset) if self.changing else (self.offset,))
        ]
        leaders.append(self._end(self._beside(surroundings, lane)))
        return min(acceleration(self.spec, self.speed, desired, leader) for leader in leaders)

    def _beside(self, surroundings: Surroundings, lane: Lane) -> list[Self]:
        """The same in the neighbour lanes; only asked near the end of the way."""
        graph = surroundings.lanes
        if graph is None or self.way.goes_on or self.way.path.length - self.s > RENEWED:
            return []
        names = [name for name in (lane.left, lane.right) if name is not None]
        return [self._onto(way_through(graph, name)) for name in names]

    def _desired(self, lane: Lane) -> float:
        if self.spec.desired_speed is None and lane.speed_limit is not None:
            return lane.speed_limit
        return desired_speed(self.subject, self.spec)


def _eased(progress: float) -> float:
    """0 to 1 with slopes and curvatures of 0 at both ends."""
    u = min(max(progress, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)
