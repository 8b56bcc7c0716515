"""Drivers based on IDM: lane following with MOBIL lane changes, and adversarial drivers."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Self
from weakref import WeakKeyDictionary
from zlib import crc32

import numpy as np

from real2sim_proto.episode import (
    CutInDriver,
    HardBrakeDriver,
    IdmDriver,
    JunctionCrossingDriver,
    LaneDriver,
)

from ...edit import ObjectState
from ...scene import Ground
from ...scene.lane import TRAVELLED, Lane
from ...scene.lane_graph import LaneGraph
from ..path import LoggedPath
from .driver import (
    BACK_TO_LANE,
    AgentDriver,
    AgentPose,
    Idm,
    Leader,
    Neighbours,
    Surroundings,
    acceleration,
    advance_along,
    desired_speed,
    incentive,
    leading_agent,
    level_quaternion,
    neighbours,
    pose_on_path,
    recorded_pose,
)

AHEAD, BEHIND = 600.0, 100.0
"""Maximum length of a lane chain beyond the end of its lane and before its start [m]."""


@dataclass(frozen=True, eq=False)
class LaneChain:
    """A chain of consecutive lanes; at forks, the lane that turns least.

    Attributes:
        path: path along their centre lines.
        lanes: the lanes, in order.
        starts: start of each lane along the path [m].
        goes_on: whether more lanes follow its end.
    """

    path: LoggedPath
    lanes: tuple[Lane, ...]
    starts: tuple[float, ...]
    goes_on: bool

    def lane_at(self, s: float) -> Lane:
        """The lane at a distance along the path [m]."""
        return self.lanes[max(bisect_right(self.starts, s) - 1, 0)]


_CHAINS: WeakKeyDictionary[LaneGraph, dict[str, LaneChain]] = WeakKeyDictionary()


def chain_through(graph: LaneGraph, lane_id: str) -> LaneChain:
    """The lane chain through a lane, cached per graph. Raises SceneError."""
    known = _CHAINS.setdefault(graph, {})
    if lane_id not in known:
        known[lane_id] = _made(graph, lane_id)
    return known[lane_id]


def _made(graph: LaneGraph, lane_id: str) -> LaneChain:
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
    return LaneChain(path, lanes, tuple(starts), any(one not in lanes for one in onward))


def _chain(
    graph: LaneGraph, lane: Lane, reach: float, names: Callable[[Lane], Iterable[str]]
) -> list[Lane]:
    """The lanes that follow one lane, without it and without repetition."""
    found, length, at = list[Lane](), 0.0, lane
    while length < reach:
        onward = [n for n in _travelled(graph, names(at)) if n is not lane and n not in found]
        if not onward:
            break
        at = graph.straightest_first(onward)[0]
        found.append(at)
        length += at.length
    return found


def _travelled(graph: LaneGraph, names: Iterable[str]) -> list[Lane]:
    return [lane for lane in map(graph.lane, names) if lane.kind in TRAVELLED]


MAX_LANE_OFFSET = 3.0
"""Maximum distance from the centre of a lane at the start of a driver [m]."""
HEADED = 0.7
"""Minimum cosine between a vehicle's heading and the lane that it drives along."""
SETTLES = 2.0
"""Minimum time between two lane changes [s]."""
MIN_CHANGE_SPEED = 3.0
"""Minimum speed for lane changes [m/s]."""
DECIDES_EVERY = 1.0
"""Interval between lane change decisions [s]. Drivers decide at different phases, because two that
always decide at once would yield to each other forever."""
TINY = 1e-6
"""Rounding of times that are sums of steps [s]."""
RENEWED = 200.0
"""Remaining length at which the lane chain is extended [m]."""


@dataclass(frozen=True, eq=False)
class LaneChanger:
    """Follows map lanes with IDM and changes lanes with MOBIL.

    At forks it takes the lane that turns least. It merges out of a lane that ends next to a
    continuing one. It leaves the world at the end of the map. It ignores traffic signals and right
    of way.

    Attributes:
        subject: the object.
        spec: IDM and MOBIL parameters.
        way: lane chain that it follows.
        s, offset, speed: position along it, offset from it [m], speed [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
        changing: offset at the start of the current lane change [m], and time since then [s].
        settled: time since the last lane change [s].
    """

    subject: ObjectState
    spec: LaneDriver
    way: LaneChain
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
        """Start from the current motion; outside all lanes, follow the recorded path with IDM."""
        now, graph = recorded_pose(subject, surroundings.t_us), surroundings.lanes
        x, y, _ = now.position
        place = None
        if graph is not None:
            place = graph.nearest(x, y, now.yaw, kinds=TRAVELLED, within=MAX_LANE_OFFSET)
        if graph is None or place is None or math.cos(place.heading - now.yaw) < HEADED:
            known = spec.model_dump(include=set(IdmDriver.model_fields) - {"kind"})
            return Idm.begin(subject, IdmDriver(**known), surroundings)
        way = chain_through(graph, place.lane_id)
        near = way.path.nearest(x, y)
        vx, vy, _ = now.velocity
        speed = max(vx * math.cos(near.yaw) + vy * math.sin(near.yaw), 0.0)
        return cls(subject, spec, way, near.s, near.offset, speed, now)

    @property
    def turning(self) -> tuple[float, float] | None:
        """The current lane change, as ``changing``."""
        if self.changing is None or self.changing[1] > self.spec.change_time - TINY:
            return None
        return self.changing

    @property
    def aim(self) -> tuple[float, float]:
        """Remaining displacement x, y to the centre of its lane [m]."""
        yaw = self.way.path.at(self.s)[3]
        return self.offset * math.sin(yaw), -self.offset * math.cos(yaw)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        driver = self._renewed(surroundings)._in_the_better_lane(surroundings)
        return driver._moved(surroundings)

    def _renewed(self, surroundings: Surroundings) -> Self:
        if not self.way.goes_on or self.way.path.length - self.s > RENEWED:
            return self
        graph = surroundings.lanes
        assert graph is not None
        return self._onto(chain_through(graph, self.way.lane_at(self.s).lane_id))

    def _onto(self, way: LaneChain) -> Self:
        near = way.path.nearest(self.pose.position[0], self.pose.position[1])
        return replace(self, way=way, s=near.s, offset=near.offset)

    # --- changes of lanes -------------------------------------------------------------------------

    def _in_the_better_lane(self, surroundings: Surroundings) -> Self:
        """The driver at the start of a lane change if that is beneficial; ties go to the left."""
        graph, lane = surroundings.lanes, self.way.lane_at(self.s)
        ready = self.changing is None and self.settled >= SETTLES and self.speed > MIN_CHANGE_SPEED
        if graph is None or not (ready and self.spec.changes and self._decides(surroundings)):
            return self
        names = [lane.left if lane.may_change_left else None]
        names += [lane.right if lane.may_change_right else None]
        beside = [graph.lane(name) for name in names if name is not None]
        tried = [self._onto(chain_through(graph, n.lane_id)) for n in beside if n.kind in TRAVELLED]
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
        """Whether the driver considers lane changes in this step; once per second."""
        steps = max(round(DECIDES_EVERY / surroundings.dt), 1)
        step = (surroundings.t_us - surroundings.start_us) // surroundings.dt_us
        number, phase = divmod(step, steps)
        return crc32(f"{self.subject.object_id} {number}".encode()) % steps == phase

    def _seen(self, surroundings: Surroundings, beside: list[Self]) -> Neighbours:
        """Neighbours at the centre of its lane.

        The end of the lane counts as a stationary leader if a neighbouring lane continues.
        """
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
        """Minimum over the leaders at its position, in its lane and at the end of the lane."""
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
        """The driver in the neighbouring lanes; only needed near the end of the lane chain."""
        graph = surroundings.lanes
        if graph is None or self.way.goes_on or self.way.path.length - self.s > RENEWED:
            return []
        names = [name for name in (lane.left, lane.right) if name is not None]
        return [self._onto(chain_through(graph, name)) for name in names]

    def _desired(self, lane: Lane) -> float:
        if self.spec.desired_speed is None and lane.speed_limit is not None:
            return lane.speed_limit
        return desired_speed(self.subject, self.spec)


def _eased(progress: float) -> float:
    """0 to 1 with slopes and curvatures of 0 at both ends."""
    u = min(max(progress, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)


# --- Adversarial drivers -------------------------------------------------------------------------

# Cut-in, hard braking and crossing, modelled on the side, front and stationary scenarios of
# NeuroNCAP (Ljungbergh et al. 2024) and the attacking agents of HUGSIM (Zhou et al. 2024), with
# closed-form rules instead of sampled trajectories.

PACE = 1.0
"""Time constant for reaching the position relative to the ego [s]."""
PACE_ACCELERATION = 4.0
CUT_BRAKING = 3.0
"""Acceleration limits of the car that cuts in, before and after it does [m/s^2]."""


@dataclass(frozen=True, eq=False)
class CutIn:
    """Drives next to the ego's route ahead of the ego, then cuts in.

    Attributes:
        subject, spec: the object and its parameters.
        s, offset, speed: position along the ego's route, offset from it [m], speed [m/s].
        began: offset and speed at the start of the cut-in, and time since then [s]; or None.
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: CutInDriver
    s: float
    offset: float
    speed: float
    pose: AgentPose
    began: tuple[float, float, float] | None = None
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, spec: CutInDriver, surroundings: Surroundings) -> CutIn:
        """Start ``gap`` ahead of the ego, at its speed."""
        s = surroundings.ego.s + surroundings.ego.front + spec.gap + subject.scaled_size[0] / 2
        speed = surroundings.ego.speed
        pose = _on_route(surroundings, subject, (s, spec.offset), (speed, 0.0))
        return cls(subject, spec, s, spec.offset, speed, pose)

    @property
    def turning(self) -> tuple[float, float] | None:
        """Offset at the start of the cut-in [m], and time since then [s]; None before and after."""
        if self.began is None or self.began[2] > self.spec.duration - TINY:
            return None
        return self.began[0], self.began[2]

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        began = self.began
        place = (
            surroundings.ego.s
            + surroundings.ego.front
            + self.spec.gap
            + self.subject.scaled_size[0] / 2
        )
        if began is None and surroundings.elapsed >= self.spec.delay and abs(place - self.s) < 2.0:
            began = (self.offset, max(surroundings.ego.speed + self.spec.speed_change, 0.0), 0.0)
        if began is None:
            wanted = surroundings.ego.speed + (place - self.s) / PACE
            rate = _towards(self.speed, wanted, PACE_ACCELERATION, surroundings.dt)
            offset = self.offset
        else:
            start, after, since = began
            began = (start, after, since + surroundings.dt)
            offset = start * (1.0 - _eased(began[2] / self.spec.duration))
            rate = _towards(self.speed, after, CUT_BRAKING, surroundings.dt)
        s, speed = advance_along(self.s, self.speed, rate, surroundings.dt)
        drift = (offset - self.offset) / surroundings.dt
        pose = _on_route(surroundings, self.subject, (s, offset), (speed, drift))
        return replace(self, s=s, speed=speed, offset=offset, began=began, pose=pose)


@dataclass(frozen=True, eq=False)
class HardBrake:
    """Replays its recorded drive, then brakes to a stop in front of the ego.

    Attributes:
        subject, spec: the object and its parameters.
        path: recorded path.
        s, speed: position and speed along it [m], [m/s].
        braking: whether it has started to brake.
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: HardBrakeDriver
    path: LoggedPath
    s: float
    speed: float
    pose: AgentPose
    braking: bool = False
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, spec: HardBrakeDriver, surroundings: Surroundings
    ) -> HardBrake:
        """Start from the current pose and motion of the object."""
        path, now = LoggedPath(subject.trajectory), recorded_pose(subject, surroundings.t_us)
        near = path.nearest(now.position[0], now.position[1])
        speed = math.hypot(now.velocity[0], now.velocity[1])
        return cls(subject, spec, path, near.s, speed, now)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        braking = self.braking or (
            surroundings.elapsed >= self.spec.delay and self._near(surroundings)
        )
        t_us, trajectory = surroundings.t_us + surroundings.dt_us, self.subject.trajectory
        if not braking and t_us <= trajectory.end_us:
            now = recorded_pose(self.subject, t_us)
            near = self.path.nearest(now.position[0], now.position[1], near_s=self.s)
            speed = math.hypot(now.velocity[0], now.velocity[1])
            return replace(self, s=near.s, speed=speed, pose=now)
        s, speed = advance_along(
            self.s, self.speed, -self.spec.braking if braking else 0.0, surroundings.dt
        )
        pose = pose_on_path(self.path, s, speed)
        return replace(self, s=s, speed=speed, pose=pose, braking=braking)

    def _near(self, surroundings: Surroundings) -> bool:
        """Whether the ego follows in the same lane within the trigger distance."""
        ego, (x, y, _), yaw = surroundings.ego, self.pose.position, self.pose.yaw
        dx, dy = x - ego.x, y - ego.y
        ahead_of = dx * math.cos(yaw) + dy * math.sin(yaw)
        # The path may begin here; it is extended straight backwards then.
        aside = abs(self.path.nearest(ego.x, ego.y).offset)
        gap = ahead_of - (self.subject.scaled_size[0] + ego.length) / 2
        return aside < 3.0 and 0.0 <= gap <= self.spec.gap


@dataclass(frozen=True, eq=False)
class JunctionCrossing:
    """Crosses the ego's route on a straight line, timed to arrive together with the ego.

    Attributes:
        subject, spec: the object and its parameters.
        crossing_s: crossing point along the route [m].
        crossing: crossing point x, y [m].
        heading: heading of its line [rad].
        left: distance to the crossing point, negative beyond it [m].
        speed: [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: JunctionCrossingDriver
    crossing_s: float
    crossing: tuple[float, float]
    heading: float
    left: float
    speed: float
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, spec: JunctionCrossingDriver, surroundings: Surroundings
    ) -> JunctionCrossing:
        """Start at the distance that it covers in the ego's time to the crossing point."""
        crossing_s = surroundings.ego.s + spec.ahead
        x, y, _, yaw = surroundings.route.at(crossing_s)
        eta = (spec.ahead - surroundings.ego.front) / max(surroundings.ego.speed, 1.0)
        made = cls(
            subject=subject,
            spec=spec,
            crossing_s=crossing_s,
            crossing=(x, y),
            heading=yaw + spec.angle,
            left=max(eta, 0.0) * spec.speed,
            speed=spec.speed,
            pose=recorded_pose(subject, subject.trajectory.start_us),
        )
        return replace(made, pose=made._placed(made.left, made.speed, surroundings.ground))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        eta = (self.crossing_s - surroundings.ego.s - surroundings.ego.front) / max(
            surroundings.ego.speed, 0.5
        )
        rate = 0.0
        if self.left > 0.0 and eta > self.spec.commit:
            wanted = min(self.left / eta, self.spec.max_speed)
            rate = _towards(self.speed, wanted, self.spec.acceleration, surroundings.dt)
        way, speed = advance_along(0.0, self.speed, rate, surroundings.dt)
        left = self.left - way
        pose = self._placed(left, speed, surroundings.ground)
        return replace(self, left=left, speed=speed, pose=pose)

    def _placed(self, left: float, speed: float, ground: Ground) -> AgentPose:
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x, y = self.crossing[0] - left * cos, self.crossing[1] - left * sin
        return AgentPose(
            (x, y, ground.height(x, y) + self.subject.scaled_size[2] / 2),
            level_quaternion(self.heading),
            self.heading,
            (speed * cos, speed * sin, 0.0),
        )


def _on_route(
    surroundings: Surroundings,
    subject: ObjectState,
    place: tuple[float, float],
    moving: tuple[float, float],
) -> AgentPose:
    """The pose of an object relative to the ego's route, on the ground.

    Args:
        surroundings: provides route and ground.
        subject: the object.
        place: distance along the route, and offset to its left [m].
        moving: speed along it and to its left [m/s].
    """
    s, offset = place
    pose = pose_on_path(surroundings.route, s, moving[0], offset=offset, drift=moving[1])
    x, y, _ = pose.position
    z = surroundings.ground.height(x, y) + subject.scaled_size[2] / 2
    return pose._replace(position=(x, y, z))


def _towards(speed: float, wanted: float, most: float, dt: float) -> float:
    """Acceleration [m/s^2] towards a target speed within a limit."""
    return min(max((wanted - speed) / dt, -most), most)
