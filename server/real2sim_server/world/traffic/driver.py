"""Drivers of other road users: their Protocol; replay, plans from outside, and storyboards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import numpy as np

from real2sim_proto.episode import ConstantVelocityDriver, ExternalDriver, ReplayDriver

from ...edit import ObjectState
from ...geometry.rotation import quaternion_yaw
from ...scene import Ground
from ...scene.lane_graph import LaneGraph
from ..agents import Agents, rows_of
from ..boxes import REAR_OVERHANG, headings
from ..ego.motion import Motion
from ..path import Float, LoggedPath, PathPoint


class AgentPose(NamedTuple):
    """Where an object is and how it moves.

    Attributes:
        position: box centre, world [m].
        quaternion: wxyz, object to world.
        yaw: heading [rad].
        velocity: world [m/s].
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
        length, width: of its box [m].
        s: where its rear axle is along the route [m].
        offset: of its rear axle from the route, positive on the left [m].
        front: from the rear axle to the front end of its box [m].
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
        """The ego in motion, ``near`` a point of its route; ``size`` of its box [m]."""
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
    """What an agent may know when it decides: the committed instant before the step.

    Attributes:
        t_us: now [us].
        start_us: of the episode [us].
        dt_us: the step to be made [us].
        ego: the controlled vehicle.
        others: all objects, the agent itself among them.
        route: the recorded way of the ego.
        ground: what everybody stands on.
        lanes: of the scene's map; None without one.
        aims: way x, y that objects have left to the middle of the lane that they change to [m], by
            id: what indicators tell.
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
        """The step to be made [s]."""
        return self.dt_us * 1e-6

    @cached_property
    def bodies(self) -> Float:
        """[B, 7] float64: middle x, y [m], yaw [rad], length, width [m], velocity x, y [m/s] of all
        objects in their order, then of the ego."""
        others, ego = self.others, self.ego
        bodies = np.empty((len(others.objects) + 1, 7))
        bodies[:-1, :2], bodies[:-1, 3:5] = others.positions[:, :2], others.sizes[:, :2]
        bodies[:-1, 2], bodies[:-1, 5:] = headings(others.quaternions), others.velocities[:, :2]
        vx, vy = ego.speed * math.cos(ego.yaw), ego.speed * math.sin(ego.yaw)
        bodies[-1] = ego.x, ego.y, ego.yaw, ego.length, ego.width, vx, vy
        return bodies

    @cached_property
    def bodies_as_meant(self) -> Float:
        """``bodies``, with those that change lanes where they are going to be aside."""
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
        """Time since the episode began [s]."""
        return (self.t_us - self.start_us) * 1e-6


class AgentDriver(Protocol):
    """Moves one object. Immutable: a step makes a new one, so that a copied world goes on alike.

    The same surroundings always lead to the same place: drivers know no clock and no chance.
    """

    @property
    def subject(self) -> ObjectState:
        """The object as it was when its driver took over."""

    @property
    def pose(self) -> AgentPose:
        """Where it is now."""

    @property
    def present(self) -> bool:
        """Whether it is in the world; False once it has left it."""

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""


def level_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """wxyz of an object that stands level with that heading; w >= 0."""
    half = math.remainder(yaw, math.tau) / 2
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def pose_on_path(
    path: LoggedPath, s: float, speed: float, *, offset: float = 0.0, drift: float = 0.0
) -> AgentPose:
    """An object that drives along a path.

    Args:
        path: in the world.
        s: along it [m].
        speed: along it [m/s].
        offset: from it, positive on the left [m].
        drift: rate at which the offset grows [m/s].
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


def pose_put_back(pose: AgentPose, route: LoggedPath, way: float) -> AgentPose:
    """The pose ``way`` metres back along a route: beside it and turned against it as before; its
    height is left as it is."""
    x, y, z = pose.position
    near = route.nearest(x, y)
    # Beyond the ends of the route it goes straight on, where the nearest point is the end.
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
    """Moves along its trajectory in time and is in the world while that lasts; observes nothing."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, _spec: ReplayDriver, surroundings: Surroundings) -> Replay:
        """From where the trajectory is now, which it must cover."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        t_us, trajectory = surroundings.t_us + surroundings.dt_us, self.subject.trajectory
        if not trajectory.start_us <= t_us <= trajectory.end_us:
            return replace(self, present=False)
        return replace(self, pose=recorded_pose(self.subject, t_us), present=True)


@dataclass(frozen=True, eq=False)
class ConstantVelocity:
    """Goes on as it moved when it began, at its height and with its heading; observes nothing."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, _spec: ConstantVelocityDriver, surroundings: Surroundings
    ) -> ConstantVelocity:
        """From how the object moves now."""
        pose = recorded_pose(subject, surroundings.t_us)
        vx, vy, _ = pose.velocity
        return cls(subject, pose._replace(velocity=(vx, vy, 0.0)))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        (x, y, z), (vx, vy, _) = self.pose.position, self.pose.velocity
        moved = (x + vx * surroundings.dt, y + vy * surroundings.dt, z)
        return replace(self, pose=self.pose._replace(position=moved))


def recorded_pose(subject: ObjectState, t_us: int) -> AgentPose:
    """Where the object's trajectory is at ``t_us``, with its velocity there.

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
    """Follows the newest plan it was given, exactly; then goes straight on as it moved last.

    Attributes:
        subject: the object.
        pose, present: see :class:`~.driver.AgentDriver`.
        times_us: [N] of the plan; empty before the first one [us].
        poses: [N] x, y [m], yaw [rad], world.
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
        """From how the object moves now."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def with_plan(
        self, t_us: int, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
    ) -> External:
        """The driver with a new plan; it leads there from where the object is at ``t_us``."""
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
    """Where a storyboard has an object. It is moved with the others of its storyboard, and not by
    itself.

    Attributes:
        subject, pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    def advance(self, surroundings: Surroundings) -> Self:
        """Itself: its storyboard makes the next one."""
        return self


class Script(Protocol):
    """Moves several objects together. Immutable, as drivers are."""

    @property
    def drivers(self) -> Mapping[str, ScriptedEntity]:
        """Of the objects, by id."""

    def advance(self, surroundings: Surroundings) -> Script:
        """The script one step later."""
