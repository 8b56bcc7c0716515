"""The intelligent driver model on a path, its leading object, and MOBIL, which changes lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from real2sim_proto.episode import IdmDriver, IdmParameters, LaneDriver

from ...edit import ObjectState
from ...scene import Ground, Trajectory
from ..path import LoggedPath, next_in_strip, previous_in_strip
from .driver import AgentPose, Surroundings, pose_on_path, pose_put_back, recorded_pose


class Leader(NamedTuple):
    """The nearest body ahead: bumper to bumper [m], and its speed along the path [m/s]."""

    gap: float
    speed: float


def leading_agent(
    path: LoggedPath,
    s: float,
    *,
    offset: float,
    length: float,
    width: float,
    object_id: str,
    surroundings: Surroundings,
) -> Leader | None:
    """The body that is next in the strip an object sweeps along a path.

    Args:
        path: of the object.
        s, offset: of its centre along the path, and from it [m].
        length, width: of its box [m].
        object_id: of the object, which is not its own leader.
        surroundings: everybody.
    """
    box = (float(offset), float(length), float(width))
    gap, speed = next_in_strip(
        path.knots, float(s), box, surroundings.bodies, surroundings.rows.get(object_id, -1)
    )
    return None if math.isinf(gap) else Leader(gap, speed)


class Neighbours(NamedTuple):
    """Who is next before and behind something in a lane; None where nobody is within 80 m."""

    leader: Leader | None
    follower: Leader | None


def neighbours(
    path: LoggedPath,
    s: float,
    *,
    length: float,
    width: float,
    object_id: str,
    surroundings: Surroundings,
) -> Neighbours:
    """Leader and follower that a box would have in the middle of a lane, those among them who have
    begun to change into it.

    Args:
        path: of the lane.
        s: of the middle of the box along it [m].
        length, width: of the box [m].
        object_id: of the object, which is neither.
        surroundings: everybody.
    """
    box, own = (0.0, float(length), float(width)), surroundings.rows.get(object_id, -1)
    now = surroundings.bodies
    then = surroundings.bodies_as_meant
    found = []
    for query in (next_in_strip, previous_in_strip):
        gap, speed = min(query(path.knots, float(s), box, bodies, own) for bodies in (now, then))
        found.append(None if math.isinf(gap) else Leader(gap, speed))
    return Neighbours(*found)


STRAIGHT = 600.0
"""Lanes begin so far before the route and end so far behind it, straight on [m]."""


def lane_beside(route: LoggedPath, offset: float, *, oncoming: bool = False) -> LoggedPath:
    """The lane ``offset`` metres to the left of a route; ``oncoming``: against it."""
    (x, y, z), (ex, ey, ez) = route.positions[0].tolist(), route.positions[-1].tolist()
    first, last = float(route.yaws[0]), float(route.yaws[-1])
    start = [x - STRAIGHT * math.cos(first), y - STRAIGHT * math.sin(first), z]
    end = [ex + STRAIGHT * math.cos(last), ey + STRAIGHT * math.sin(last), ez]
    longer = LoggedPath.through(
        np.vstack([start, route.positions, end]),
        np.concatenate([[first], route.yaws, [last]]),
        np.vstack([route.ups[:1], route.ups, route.ups[-1:]]),
    )
    return longer.beside(offset, reverse=oncoming)


def lane_of(route: LoggedPath, x: float, y: float, yaw: float) -> LoggedPath:
    """The lane beside a route in which something is at x, y [m], the way it faces: ``yaw``."""
    near = route.nearest(x, y)
    return lane_beside(route, near.offset, oncoming=math.cos(yaw - near.yaw) < 0.0)


HARDEST = 8.0
"""Deceleration that brakes can bring about [m/s^2]."""

BACK_TO_LANE = 2.0
"""Time constant with which an offset from the path fades [s]."""

STANDSTILL = 0.1
"""A desired speed below this is one of standing [m/s]."""

SLOWEST_DESIRED = 3.0
"""Desired speed of objects that hardly moved in the recording [m/s]."""


@dataclass(frozen=True, eq=False)
class Idm:
    """Keeps to its recorded path, at a desired speed or behind its leader.

    a = a_max [1 - (v/v0)^4 - (s*/s)^2] with s* = s0 + max(0, v T + v dv / (2 sqrt(a_max b)))
    (Treiber, Hennecke & Helbing 2000, Phys. Rev. E 62, eqs. 1 to 3). In bends v0 is what the
    lateral acceleration allows. It leaves the world at the end of its path.

    Attributes:
        subject: the object.
        spec: parameters.
        path: recorded, of its box centre.
        desired: speed on a free and straight road [m/s].
        s, offset, speed: along and beside the path [m], [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
        along_route: whether the path is a lane beside the ego's route, at no height of its own.
    """

    subject: ObjectState
    spec: IdmDriver
    path: LoggedPath
    desired: float
    s: float
    offset: float
    speed: float
    pose: AgentPose
    present: bool = True
    along_route: bool = False

    @classmethod
    def begin(cls, subject: ObjectState, spec: IdmDriver, surroundings: Surroundings) -> Idm:
        """From where and how the object moves now."""
        now = recorded_pose(subject, surroundings.t_us)
        if spec.path == "recorded":
            return cls.from_pose(subject, now, spec, LoggedPath(subject.trajectory))
        lane = lane_of(surroundings.route, now.position[0], now.position[1], now.yaw)
        return replace(cls.from_pose(subject, now, spec, lane), along_route=True)

    @classmethod
    def from_pose(
        cls, subject: ObjectState, now: AgentPose, spec: IdmDriver, path: LoggedPath
    ) -> Idm:
        """From a pose beside its path."""
        near = path.nearest(now.position[0], now.position[1])
        vx, vy, _ = now.velocity
        speed = max(vx * math.cos(near.yaw) + vy * math.sin(near.yaw), 0.0)
        desired = desired_speed(subject, spec)
        return cls(subject, spec, path, desired, near.s, near.offset, speed, now)

    @classmethod
    def in_lane(
        cls, subject: ObjectState, spec: IdmDriver, lane: LoggedPath, s: float, *, speed: float
    ) -> Idm:
        """In the middle of a lane beside the ego's route, ``s`` metres along it at ``speed``
        [m/s]; ``spec`` holds the desired speed."""
        pose, desired = pose_on_path(lane, s, speed), desired_speed(subject, spec)
        return cls(subject, spec, lane, desired, s, 0.0, speed, pose, along_route=True)

    def on(self, ground: Ground) -> Self:
        """The driver with its object standing on the ground."""
        x, y, _ = self.pose.position
        z = ground.height(x, y) + self.subject.scaled_size[2] / 2
        return replace(self, pose=self.pose._replace(position=(x, y, z)))

    def put_back(self, route: LoggedPath, way: float, ground: Ground) -> Self:
        """The driver ``way`` metres back along the route: beside it and turned as it is now."""
        pose = pose_put_back(self.pose, route, way)
        near = self.path.nearest(pose.position[0], pose.position[1])
        return replace(self, s=near.s, offset=near.offset, pose=pose).on(ground)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        length, width, _ = self.subject.scaled_size
        leader = leading_agent(
            self.path,
            self.s,
            offset=self.offset,
            length=length,
            width=width,
            object_id=self.subject.object_id,
            surroundings=surroundings,
        )
        bend = self.path.sharpest_turn(self.s, 2.0 * self.speed)
        desired = min(self.desired, math.sqrt(self.spec.lateral / max(bend, 1e-4)))
        s, speed = advance_along(
            self.s,
            self.speed,
            acceleration(self.spec, self.speed, desired, leader),
            surroundings.dt,
        )
        offset = self.offset * math.exp(-surroundings.dt / BACK_TO_LANE)
        drift = (offset - self.offset) / surroundings.dt
        pose = pose_on_path(self.path, s, speed, offset=offset, drift=drift)
        present = s < self.path.length
        moved = replace(self, s=s, speed=speed, offset=offset, pose=pose, present=present)
        return moved.on(surroundings.ground) if self.along_route else moved


def acceleration(spec: IdmParameters, speed: float, desired: float, leader: Leader | None) -> float:
    """IDM acceleration [m/s^2], no harder than brakes can."""
    free = 1.0 - (speed / max(desired, STANDSTILL)) ** 4
    if leader is None:
        return max(spec.acceleration * free, -HARDEST)
    closing = speed - leader.speed
    dynamic = speed * spec.headway + speed * closing / (
        2 * math.sqrt(spec.acceleration * spec.braking)
    )
    wanted = spec.gap + max(0.0, dynamic)
    interaction = (wanted / max(leader.gap, 0.1)) ** 2
    return max(spec.acceleration * (free - interaction), -HARDEST)


def advance_along(s: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Place and speed after ``dt`` seconds; braking ends at rest."""
    if acceleration < 0 and speed + acceleration * dt <= 0:
        return s + speed * speed / (-2 * acceleration), 0.0
    return s + (speed + acceleration * dt / 2) * dt, speed + acceleration * dt


def desired_speed(subject: ObjectState, spec: IdmParameters) -> float:
    """Speed on a free, straight road [m/s]: what the spec says, else the highest recorded one."""
    if spec.desired_speed is not None:
        return spec.desired_speed
    return max(highest_speed(subject.trajectory), SLOWEST_DESIRED)


def highest_speed(trajectory: Trajectory) -> float:
    """Highest recorded speed [m/s], over half a second against noise."""
    times = trajectory.times_us * 1e-6
    if len(times) == 1:
        return 0.0
    later = np.minimum(np.searchsorted(times, times + 0.5), len(times) - 1)
    spans = np.maximum(times[later] - times, 1e-6)
    ways = np.linalg.norm(trajectory.positions[later] - trajectory.positions, axis=1)
    full = spans >= 0.25
    return float((ways / spans)[full].max()) if full.any() else float((ways / spans).max())


def incentive(
    spec: LaneDriver,
    speed: float,
    length: float,
    *,
    here: tuple[Neighbours, float],
    there: tuple[Neighbours, float],
) -> float | None:
    """What a change of lanes gains, beyond the threshold [m/s^2]; None where it is not safe.

    Others are taken to drive by the same parameters, at least as fast as they do now.

    Args:
        spec: of the driver.
        speed: its speed [m/s].
        length: of its vehicle [m].
        here, there: neighbours in a lane, and the desired speed in it [m/s].
    """
    (now, desired_here), (then, desired_there) = here, there
    me = speed
    if any(other is not None and other.gap <= 0.0 for other in then):
        return None
    own = acceleration(spec, speed, desired_there, then.leader)
    gain = own - acceleration(spec, speed, desired_here, now.leader)
    new_before, new_after = _with_and_without(spec, me, length, then, desired_there)
    if min(own, new_after) < -spec.safe_braking:
        return None
    old_after, old_before = _with_and_without(spec, me, length, now, desired_here)
    others = (new_after - new_before) + (old_after - old_before)
    return gain + spec.politeness * others - spec.threshold


def _with_and_without(
    spec: LaneDriver, speed: float, length: float, lane: Neighbours, desired: float
) -> tuple[float, float]:
    """Acceleration of the one behind in a lane without the driver, and with it; 0 where nobody is
    behind."""
    behind, ahead = lane.follower, lane.leader
    if behind is None:
        return 0.0, 0.0
    wanted = max(desired, behind.speed)
    beyond = None if ahead is None else Leader(behind.gap + length + ahead.gap, ahead.speed)
    without = acceleration(spec, behind.speed, wanted, beyond)
    return without, acceleration(spec, behind.speed, wanted, Leader(behind.gap, speed))
