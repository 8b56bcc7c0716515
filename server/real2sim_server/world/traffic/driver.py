"""Drivers of other road users: Protocol, observation and poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import numpy as np

from ...edit import ObjectState
from ...scene import Ground
from ...scene.lane_graph import LaneGraph
from ..agents import Agents, rows_of
from ..broad_phase_kernels import headings
from ..ego.box import REAR_OVERHANG
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
