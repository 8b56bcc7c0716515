"""Drivers of other road users: the Protocol, replay, external plans, storyboards and IDM."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import numpy as np

from real2sim_proto.drive import Lamp
from real2sim_proto.episode import (
    ConstantVelocityDriver,
    ExternalDriver,
    IdmDriver,
    IdmParameters,
    LaneDriver,
    ReplayDriver,
)

from ...edit import ObjectState
from ...geometry import quaternion_yaw
from ...scene import Ground, Trajectory
from ...scene.lane_graph import LaneGraph
from ..agents import Agents, rows_of
from ..boxes import REAR_OVERHANG, headings
from ..ego_motion import Motion
from ..path import Float, LoggedPath, PathPoint, next_in_strip, previous_in_strip


class AgentPose(NamedTuple):
    """Pose and velocity of an object.

    Attributes:
        position: box centre, world frame [m].
        quaternion: wxyz, object to world.
        yaw: heading [rad].
        velocity: world frame [m/s].
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    yaw: float
    velocity: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class ObservedEgo:
    """The controlled vehicle as other road users observe it.

    Attributes:
        x, y: centre of its box [m].
        yaw: heading [rad].
        speed: along its heading [m/s].
        length, width: size of its box [m].
        s: position of its rear axle along the route [m].
        offset: offset of its rear axle from the route, positive left [m].
        front: distance from the rear axle to the front end of its box [m].
    """

    x: float
    y: float
    yaw: float
    speed: float
    length: float
    width: float
    s: float
    offset: float
    front: float

    @classmethod
    def of(cls, motion: Motion, near: PathPoint, size: tuple[float, float, float]) -> Self:
        """The ego with its motion, nearest route point and box size [m]."""
        length, width, _ = size
        ahead = length / 2 - REAR_OVERHANG
        return cls(
            x=motion.x + ahead * math.cos(motion.yaw),
            y=motion.y + ahead * math.sin(motion.yaw),
            yaw=motion.yaw,
            speed=motion.speed,
            length=length,
            width=width,
            s=near.s,
            offset=near.offset,
            front=length - REAR_OVERHANG,
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Inputs of an agent's decision: the committed instant before the step.

    Attributes:
        t_us: current time [us].
        start_us: start time of the episode [us].
        dt_us: time step [us].
        ego: the controlled vehicle.
        others: all objects, including the agent itself.
        route: the recorded path of the ego.
        ground: ground of the scene.
        lanes: lanes of the scene's map; None without a map.
        aims: remaining displacement x, y of lane-changing objects to the centre of their target
            lane [m], by id; corresponds to turn indicators.
    """

    t_us: int
    start_us: int
    dt_us: int
    ego: ObservedEgo
    others: Agents
    route: LoggedPath
    ground: Ground
    lanes: LaneGraph | None = None
    aims: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def dt(self) -> float:
        """The time step [s]."""
        return self.dt_us * 1e-6

    @cached_property
    def bodies(self) -> Float:
        """[B, 7] float64: all objects in order, then the ego.

        Columns: centre x, y [m], yaw [rad], length, width [m], velocity x, y [m/s].
        """
        others, ego = self.others, self.ego
        bodies = np.empty((len(others.objects) + 1, 7))
        bodies[:-1, :2], bodies[:-1, 3:5] = others.positions[:, :2], others.sizes[:, :2]
        bodies[:-1, 2], bodies[:-1, 5:] = headings(others.quaternions), others.velocities[:, :2]
        vx, vy = ego.speed * math.cos(ego.yaw), ego.speed * math.sin(ego.yaw)
        bodies[-1] = ego.x, ego.y, ego.yaw, ego.length, ego.width, vx, vy
        return bodies

    @cached_property
    def bodies_as_meant(self) -> Float:
        """``bodies``, with lane-changing objects at the lateral position of their target lane."""
        if not self.aims:
            return self.bodies
        bodies = self.bodies.copy()
        for name, way in self.aims.items():
            if name in self.rows:
                bodies[self.rows[name], :2] += way
        return bodies

    @cached_property
    def rows(self) -> dict[str, int]:
        """Row of each object in ``bodies``, by id."""
        return rows_of(self.others)

    @property
    def elapsed(self) -> float:
        """Time since the start of the episode [s]."""
        return (self.t_us - self.start_us) * 1e-6


class AgentDriver(Protocol):
    """Moves one object. Immutable: a step returns a new driver, so worlds can be forked.

    Deterministic: the same surroundings lead to the same pose. Drivers use no clock and no random
    numbers.
    """

    @property
    def subject(self) -> ObjectState:
        """The object as it was when its driver took over."""

    @property
    def pose(self) -> AgentPose:
        """Current pose."""

    @property
    def present(self) -> bool:
        """Whether the object is in the world; False once it has left."""

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""


def level_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """wxyz of a level object with a heading [rad]; w >= 0."""
    half = math.remainder(yaw, math.tau) / 2
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def pose_on_path(
    path: LoggedPath, s: float, speed: float, *, offset: float = 0.0, drift: float = 0.0
) -> AgentPose:
    """The pose of an object that drives along a path.

    Args:
        path: path, world frame.
        s: distance along it [m].
        speed: speed along it [m/s].
        offset: lateral offset from it, positive left [m].
        drift: rate of change of the offset [m/s].
    """
    x, y, z, yaw = path.at(s)
    cos, sin = math.cos(yaw), math.sin(yaw)
    heading = yaw + (math.atan2(drift, speed) if speed > 0.5 else 0.0)
    return AgentPose(
        (x - offset * sin, y + offset * cos, z),
        level_quaternion(heading),
        heading,
        (speed * cos - drift * sin, speed * sin + drift * cos, 0.0),
    )


def pose_moved_back(pose: AgentPose, route: LoggedPath, way: float) -> AgentPose:
    """The pose moved ``way`` metres back along a route, with the same offset and relative heading.

    The height is unchanged.
    """
    x, y, z = pose.position
    near = route.nearest(x, y)
    # The route continues straight beyond its ends, but the nearest point there is its end.
    beyond = (x - near.position[0]) * math.cos(near.yaw)
    beyond += (y - near.position[1]) * math.sin(near.yaw)
    px, py, _, yaw = route.at(near.s + beyond - way)
    turn = yaw - near.yaw
    cos, sin = math.cos(turn), math.sin(turn)
    vx, vy, vz = pose.velocity
    heading = pose.yaw + turn
    return AgentPose(
        (px - near.offset * math.sin(yaw), py + near.offset * math.cos(yaw), z),
        level_quaternion(heading),
        heading,
        (cos * vx - sin * vy, sin * vx + cos * vy, vz),
    )


@dataclass(frozen=True, eq=False)
class Replay:
    """Replays its trajectory in time, and is present while that lasts; ignores surroundings."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, _spec: ReplayDriver, surroundings: Surroundings) -> Replay:
        """Start at the current time, which the trajectory must cover."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        t_us, trajectory = surroundings.t_us + surroundings.dt_us, self.subject.trajectory
        if not trajectory.start_us <= t_us <= trajectory.end_us:
            return replace(self, present=False)
        return replace(self, pose=recorded_pose(self.subject, t_us), present=True)


@dataclass(frozen=True, eq=False)
class ConstantVelocity:
    """Keeps its initial velocity, height and heading; ignores surroundings."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, _spec: ConstantVelocityDriver, surroundings: Surroundings
    ) -> ConstantVelocity:
        """Start from the current motion of the object."""
        pose = recorded_pose(subject, surroundings.t_us)
        vx, vy, _ = pose.velocity
        return cls(subject, pose._replace(velocity=(vx, vy, 0.0)))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        (x, y, z), (vx, vy, _) = self.pose.position, self.pose.velocity
        moved = (x + vx * surroundings.dt, y + vy * surroundings.dt, z)
        return replace(self, pose=self.pose._replace(position=moved))


def recorded_pose(subject: ObjectState, t_us: int) -> AgentPose:
    """Pose and velocity of the object's trajectory at ``t_us``.

    Raises:
        TimeOutOfRangeError: outside the trajectory.
    """
    position, quaternion = subject.trajectory.pose(t_us)
    x, y, z = position.tolist()
    w, qx, qy, qz = quaternion.tolist()
    vx, vy, vz = subject.trajectory.velocity(t_us).tolist()
    yaw = float(quaternion_yaw(quaternion))
    return AgentPose((x, y, z), (w, qx, qy, qz), yaw, (vx, vy, vz))


@dataclass(frozen=True, eq=False)
class External:
    """Follows the newest client plan exactly, then continues straight at its last velocity.

    Attributes:
        subject: the object.
        pose, present: see :class:`~.driver.AgentDriver`.
        times_us: [N] times of the plan [us]; empty before the first plan.
        poses: [N] x, y [m], yaw [rad], world frame.
    """

    subject: ObjectState
    pose: AgentPose
    times_us: tuple[int, ...] = ()
    poses: tuple[tuple[float, float, float], ...] = ()
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, _spec: ExternalDriver, surroundings: Surroundings
    ) -> External:
        """Start from the current motion of the object."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def with_plan(
        self, t_us: int, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
    ) -> External:
        """The driver with a new plan, which starts at the object's pose at ``t_us``."""
        x, y, _ = self.pose.position
        here = (x, y, self.pose.yaw)
        return replace(self, times_us=(t_us, *times_us), poses=(here, *poses))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        t_us, (x, y, z) = surroundings.t_us + surroundings.dt_us, self.pose.position
        if not self.times_us or t_us > self.times_us[-1]:
            vx, vy, _ = self.pose.velocity
            moved = (x + vx * surroundings.dt, y + vy * surroundings.dt, z)
            velocity = (vx, vy, 0.0)
            return replace(self, pose=self.pose._replace(position=moved, velocity=velocity))
        nx, ny, yaw = self._planned(t_us)
        velocity = ((nx - x) / surroundings.dt, (ny - y) / surroundings.dt, 0.0)
        pose = AgentPose((nx, ny, z), level_quaternion(yaw), yaw, velocity)
        return replace(self, pose=pose)

    def _planned(self, t_us: int) -> tuple[float, float, float]:
        k = min(int(np.searchsorted(self.times_us, t_us)), len(self.times_us) - 1)
        a, b = self.poses[k - 1], self.poses[k]
        fraction = (t_us - self.times_us[k - 1]) / (self.times_us[k] - self.times_us[k - 1])
        turn = math.remainder(b[2] - a[2], math.tau)
        return (
            (1 - fraction) * a[0] + fraction * b[0],
            (1 - fraction) * a[1] + fraction * b[1],
            a[2] + fraction * turn,
        )


@dataclass(frozen=True, eq=False)
class ScriptedEntity:
    """An object that a storyboard moves, together with the other entities of that storyboard.

    Attributes:
        subject, pose, present: see :class:`~.driver.AgentDriver`.
        lamps: its lit lamps.
    """

    subject: ObjectState
    pose: AgentPose
    present: bool = True
    lamps: tuple[Lamp, ...] = ()

    def advance(self, surroundings: Surroundings) -> Self:
        """Returns itself; its storyboard creates the next one."""
        return self


class Script(Protocol):
    """Moves several objects together. Immutable, like drivers."""

    @property
    def drivers(self) -> Mapping[str, ScriptedEntity]:
        """Drivers of the objects, by id."""

    def advance(self, surroundings: Surroundings) -> Script:
        """The script one step later."""


# --- Intelligent driver model --------------------------------------------------------------------

# IDM on a path behind a lead vehicle, and MOBIL lane changes.


class Leader(NamedTuple):
    """The nearest body ahead: bumper-to-bumper gap [m], and its speed along the path [m/s]."""

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
    """The next body ahead in the strip that an object sweeps along a path.

    Args:
        path: path of the object.
        s, offset: its centre along the path, and its offset from it [m].
        length, width: size of its box [m].
        object_id: id of the object itself, which is excluded.
        surroundings: all bodies.
    """
    box = (float(offset), float(length), float(width))
    gap, speed = next_in_strip(
        path.knots, float(s), box, surroundings.bodies, surroundings.rows.get(object_id, -1)
    )
    return None if math.isinf(gap) else Leader(gap, speed)


class Neighbours(NamedTuple):
    """Leader and follower in a lane; None without one within 80 m."""

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
    """Leader and follower of a box at the centre of a lane.

    Objects that have started to change into the lane count as being in it.

    Args:
        path: centre line of the lane.
        s: position of the box centre along it [m].
        length, width: size of the box [m].
        object_id: id of the object itself, which is excluded.
        surroundings: all bodies.
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
"""Straight extension of lanes before and beyond the route [m]."""


def parallel_lane(route: LoggedPath, offset: float, *, oncoming: bool = False) -> LoggedPath:
    """The lane ``offset`` metres to the left of a route; ``oncoming`` reverses its direction."""
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
    """The lane parallel to a route through x, y [m], in the direction of ``yaw``."""
    near = route.nearest(x, y)
    return parallel_lane(route, near.offset, oncoming=math.cos(yaw - near.yaw) < 0.0)


MAX_BRAKING = 8.0
"""Maximum deceleration by the brakes [m/s^2]."""

BACK_TO_LANE = 2.0
"""Time constant for the decay of an offset from the path [s]."""

STANDSTILL = 0.1
"""Desired speed below which an object is stationary [m/s]."""

MIN_DESIRED_SPEED = 3.0
"""Minimum desired speed, for objects and drives that hardly moved in the recording [m/s]."""


@dataclass(frozen=True, eq=False)
class Idm:
    """Intelligent driver model on the recorded path, with a desired speed and a lead vehicle.

    a = a_max [1 - (v/v0)^4 - (s*/s)^2] with s* = s0 + max(0, v T + v dv / (2 sqrt(a_max b)))
    (Treiber, Hennecke & Helbing 2000, Phys. Rev. E 62, eqs. 1 to 3). In curves the lateral
    acceleration limits v0. The object leaves the world at the end of its path.

    Attributes:
        subject: the object.
        spec: IDM parameters.
        path: recorded path of its box centre.
        desired: desired speed on a free, straight road [m/s].
        s, offset, speed: position along the path, offset from it [m], speed [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
        along_route: whether the path is a lane parallel to the ego's route, without height.
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
        """Start from the current pose and motion of the object."""
        now = recorded_pose(subject, surroundings.t_us)
        if spec.path == "recorded":
            return cls.from_pose(subject, now, spec, LoggedPath(subject.trajectory))
        lane = lane_of(surroundings.route, now.position[0], now.position[1], now.yaw)
        return replace(cls.from_pose(subject, now, spec, lane), along_route=True)

    @classmethod
    def from_pose(
        cls, subject: ObjectState, now: AgentPose, spec: IdmDriver, path: LoggedPath
    ) -> Idm:
        """Start from a pose near its path."""
        near = path.nearest(now.position[0], now.position[1])
        vx, vy, _ = now.velocity
        speed = max(vx * math.cos(near.yaw) + vy * math.sin(near.yaw), 0.0)
        desired = desired_speed(subject, spec)
        return cls(subject, spec, path, desired, near.s, near.offset, speed, now)

    @classmethod
    def in_lane(
        cls, subject: ObjectState, spec: IdmDriver, lane: LoggedPath, s: float, *, speed: float
    ) -> Idm:
        """Start at the centre of a lane parallel to the ego's route.

        ``s`` is the position along the lane [m] and ``speed`` the initial speed [m/s]; ``spec``
        holds the desired speed.
        """
        pose, desired = pose_on_path(lane, s, speed), desired_speed(subject, spec)
        return cls(subject, spec, lane, desired, s, 0.0, speed, pose, along_route=True)

    def on(self, ground: Ground) -> Self:
        """The driver with its object on the ground."""
        x, y, _ = self.pose.position
        z = ground.height(x, y) + self.subject.scaled_size[2] / 2
        return replace(self, pose=self.pose._replace(position=(x, y, z)))

    def looped(self, route: LoggedPath, way: float, ground: Ground) -> Self:
        """The driver moved ``way`` metres back along the route, with its offset and heading."""
        pose = pose_moved_back(self.pose, route, way)
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
    """IDM acceleration [m/s^2], limited to the braking capability."""
    free = 1.0 - (speed / max(desired, STANDSTILL)) ** 4
    if leader is None:
        return max(spec.acceleration * free, -MAX_BRAKING)
    closing = speed - leader.speed
    dynamic = speed * spec.headway + speed * closing / (
        2 * math.sqrt(spec.acceleration * spec.braking)
    )
    wanted = spec.gap + max(0.0, dynamic)
    interaction = (wanted / max(leader.gap, 0.1)) ** 2
    return max(spec.acceleration * (free - interaction), -MAX_BRAKING)


def advance_along(s: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and speed after ``dt`` seconds; braking ends at rest."""
    if acceleration < 0 and speed + acceleration * dt <= 0:
        return s + speed * speed / (-2 * acceleration), 0.0
    return s + (speed + acceleration * dt / 2) * dt, speed + acceleration * dt


def desired_speed(subject: ObjectState, spec: IdmParameters) -> float:
    """Desired speed on a free, straight road [m/s]: from the spec, else the highest recorded."""
    if spec.desired_speed is not None:
        return spec.desired_speed
    return max(highest_speed(subject.trajectory), MIN_DESIRED_SPEED)


def highest_speed(trajectory: Trajectory) -> float:
    """Highest recorded speed [m/s], averaged over half a second."""
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
    """MOBIL incentive of a lane change beyond the threshold [m/s^2]; None if it is unsafe.

    Assumes that others use the same parameters, with a desired speed of at least their current
    speed.

    Args:
        spec: parameters of the driver.
        speed: its speed [m/s].
        length: length of its vehicle [m].
        here, there: neighbours in the current and target lane, and the desired speed there [m/s].
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
    """Acceleration of the follower in a lane, without and with the driver; 0 without follower."""
    behind, ahead = lane.follower, lane.leader
    if behind is None:
        return 0.0, 0.0
    wanted = max(desired, behind.speed)
    beyond = None if ahead is None else Leader(behind.gap + length + ahead.gap, ahead.speed)
    without = acceleration(spec, behind.speed, wanted, beyond)
    return without, acceleration(spec, behind.speed, wanted, Leader(behind.gap, speed))
