"""Spawning and removal of road users along the ego's route."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import AgentsSpec, IdmDriver, LaneSpec, SpawnSpec
from real2sim_proto.operations import DRAWN_PREFIX

from ...edit import ObjectState, ScenarioState
from ...geometry import quaternion_yaw
from ...scene import Ground, Trajectory
from ...scene.scene import MAX_OBJECTS
from ..agents import Agents
from ..common import Draws, WorldError
from ..path import LoggedPath
from .driver import (
    MIN_DESIRED_SPEED,
    AgentDriver,
    Idm,
    Surroundings,
    highest_speed,
    level_quaternion,
    parallel_lane,
)

PREFIX = DRAWN_PREFIX
"""Prefix of the ids of spawned objects; ids on the wire have no colon, so it cannot clash."""

LOOKS = frozenset({"car", "vehicle", "van", "truck", "bus", "motorcycle"})
"""Categories whose appearance spawned objects can use."""

SIDE = 0.3
"""Lateral clearance of a box that counts as blocked [m]."""


class Lane(NamedTuple):
    """A lane in which objects are spawned.

    Attributes:
        path: centre line.
        oncoming: whether it runs against the route.
        looks: objects whose appearance spawned objects use.
    """

    path: LoggedPath
    oncoming: bool
    looks: tuple[ObjectState, ...]


class Neighbour(NamedTuple):
    """A body in a lane: centre along it [m], half its length [m], speed along it [m/s]."""

    s: float
    half: float
    speed: float


@dataclass(frozen=True, eq=False)
class Spawner:
    """Spawns and removes objects. Immutable: a step returns a new one.

    Attributes:
        spec: density and range of spawned traffic.
        lanes: lanes of spawned objects.
        desired: mean of their sampled desired speeds [m/s].
        draws: random numbers of the episode.
        ground: ground of the scene.
        number: number of objects spawned so far.
    """

    spec: SpawnSpec
    lanes: tuple[Lane, ...]
    desired: float
    draws: Draws
    ground: Ground
    number: int = 0

    @classmethod
    def begin(
        cls,
        spec: SpawnSpec,
        state: ScenarioState,
        draws: Draws,
        *,
        route: LoggedPath,
        ego: Trajectory,
    ) -> Spawner:
        """The spawner at the start of an episode.

        Args:
            spec: density and range of spawned traffic.
            state: objects that provide the appearance.
            draws: random numbers of the episode.
            route: route of the ego, continued beyond the recorded drive.
            ego: the recorded drive.

        Raises:
            WorldError: UNKNOWN_OBJECT if an appearance refers to a missing object;
                INVALID_REQUEST if no object can provide the appearance.
        """
        looks = _looks(spec, state)
        desired = spec.driver.desired_speed
        if desired is None:
            desired = highest_speed(ego)
        lanes = tuple(_lane(lane, route, looks) for lane in spec.lanes)
        return cls(spec, lanes, max(desired, MIN_DESIRED_SPEED), draws, state.ground)

    def filled(self, agents: Agents, surroundings: Surroundings) -> tuple[Spawner, list[Idm]]:
        """Fill the range around the ego to the requested density, at the start."""
        spawner, added = self, list[Idm]()
        for number, lane in enumerate(self.lanes):
            bodies = list(_bodies_in(lane.path, agents, surroundings))
            here = lane.path.nearest(surroundings.ego.x, surroundings.ego.y).s
            first, last = here - self._reach(lane)[0], here + self._reach(lane)[1]
            s = first + spawner._draw("spacing", 0.0, 1000.0 / self.spec.density)
            while s < last and len(added) < self.spec.most:
                made = spawner._spawned(number, s, bodies, added)
                spawner = replace(spawner, number=spawner.number + 1)
                if made is not None:
                    added.append(made)
                    bodies.append(_neighbour(made))
                s += max(spawner._draw("spacing", 0.5, 1.5) * 1000.0 / self.spec.density, 5.0)
        return spawner, added

    def gone(self, drivers: Mapping[str, AgentDriver], surroundings: Surroundings) -> set[str]:
        """Ids of spawned objects to remove: at the end of their lane, or too far from the ego."""
        ego, leave = surroundings.ego, set[str]()
        for name, driver in drivers.items():
            if not name.startswith(PREFIX):
                continue
            x, y, _ = driver.pose.position
            dx, dy = x - ego.x, y - ego.y
            along = dx * math.cos(ego.yaw) + dy * math.sin(ego.yaw)
            reach = self.spec.ahead if along > 0 else self.spec.behind
            if not driver.present or math.hypot(dx, dy) > reach + self.spec.margin:
                leave.add(name)
        return leave

    def advance(
        self, drivers: Mapping[str, AgentDriver], agents: Agents, surroundings: Surroundings
    ) -> tuple[Spawner, list[Idm]]:
        """Spawn one object in each lane below the requested density.

        Args:
            drivers: drivers of all objects.
            agents: poses of all objects.
            surroundings: the instant before the step.
        """
        active = [d for i, d in drivers.items() if i.startswith(PREFIX)]
        spawner, added = self, list[Idm]()
        for number, lane in enumerate(self.lanes):
            stretch = (self.spec.ahead + self.spec.behind) / 1000.0
            here = sum(isinstance(d, Idm) and d.path is lane.path for d in active)
            if here >= max(round(self.spec.density * stretch), 1):
                continue
            if len(active) + len(added) >= self.spec.most:
                break
            made = spawner._at_an_edge(number, agents, surroundings, [*active, *added])
            if made is not None:
                spawner = replace(spawner, number=spawner.number + 1)
                added.append(made)
        return spawner, added

    def sampled(self, made: Idm) -> dict[str, float]:
        """Values sampled for a spawned object, by name."""
        name = f"agents.{made.subject.object_id}"
        return {f"{name}.desired_speed": made.desired, f"{name}.lane_position": made.s}

    # --- single objects -------------------------------------------------------------------------

    def _at_an_edge(
        self,
        number: int,
        agents: Agents,
        surroundings: Surroundings,
        active: list[AgentDriver],
    ) -> Idm | None:
        """An object at the edge from which it drives into the range, else at the other edge."""
        lane = self.lanes[number]
        bodies = list(_bodies_in(lane.path, agents, surroundings))
        here = lane.path.nearest(surroundings.ego.x, surroundings.ego.y).s
        back, on = self._reach(lane)
        edges = [here - back]
        if not lane.oncoming:
            faster = self._desired() > surroundings.ego.speed
            edges = [here - back, here + on] if faster else [here + on, here - back]
        for s in edges:
            made = self._spawned(number, s, bodies, active)
            if made is not None:
                return made
        return None

    def _spawned(
        self,
        number: int,
        s: float,
        bodies: list[Neighbour],
        active: list[Idm] | list[AgentDriver],
    ) -> Idm | None:
        """The next object, at ``s`` of a lane; None if there is no free space."""
        lane = self.lanes[number]
        look = lane.looks[int(self._draw("look", 0.0, len(lane.looks)))]
        half = look.scaled_size[0] / 2
        if not 0.0 <= s <= lane.path.length:
            return None
        gaps = [(b.s - s, abs(b.s - s) - b.half - half, b.speed) for b in bodies]
        if any(gap < self.spec.gap for _, gap, _ in gaps):
            return None
        subject = replace(
            look,
            object_id=f"{PREFIX}{self.number + 1}",
            instance_id=_free_instance_id(active),
            trajectory=_standing_at(lane.path, s),
            velocity=None,
            edited=True,
        )
        desired = self._desired()
        spec = self.spec.driver.model_copy(update={"desired_speed": desired})
        leader = min(((gap, v) for ds, gap, v in gaps if ds > 0), default=None)
        speed = desired if leader is None else _safe_speed(spec, desired, *leader)
        return Idm.in_lane(subject, spec, lane.path, s, speed=speed).on(self.ground)

    def _desired(self) -> float:
        spread = self.spec.speed_spread
        return self.desired * self._draw("speed", 1.0 - spread, 1.0 + spread)

    def _reach(self, lane: Lane) -> tuple[float, float]:
        """Extent of the range behind and ahead of the ego, along the lane [m]."""
        ahead, behind = self.spec.ahead, self.spec.behind
        return (ahead, behind) if lane.oncoming else (behind, ahead)

    def _draw(self, what: str, low: float, high: float) -> float:
        """A uniform number for the next object."""
        return low + (high - low) * self.draws.uniform(f"spawn.{what}", self.number)[0]


def begin_spawner(
    spec: AgentsSpec, state: ScenarioState, draws: Draws, *, route: LoggedPath, ego: Trajectory
) -> Spawner | None:
    """The spawner of an episode, or None. Raises the errors of :meth:`Spawner.begin`."""
    if spec.spawn is None:
        return None
    return Spawner.begin(spec.spawn, state, draws, route=route, ego=ego)


def _lane(spec: LaneSpec, route: LoggedPath, looks: tuple[ObjectState, ...]) -> Lane:
    path = parallel_lane(route, spec.offset, oncoming=spec.oncoming)
    alike = tuple(o for o in looks if _faces_along(o, path))
    return Lane(path, spec.oncoming, alike or looks)


def _faces_along(subject: ObjectState, path: LoggedPath) -> bool:
    """Whether an object was recorded heading along the path.

    Its appearance is then known from the ego's viewpoints.
    """
    x, y, _ = subject.trajectory.positions[0].tolist()
    yaw = float(quaternion_yaw(subject.trajectory.quaternions[0]))
    return math.cos(yaw - path.nearest(x, y).yaw) > 0.5


def _looks(spec: SpawnSpec, state: ScenarioState) -> tuple[ObjectState, ...]:
    if spec.looks:
        known = {o.object_id: o for o in state.visible}
        unknown = [name for name in spec.looks if name not in known]
        if unknown:
            raise WorldError(
                ErrorCode.UNKNOWN_OBJECT,
                f"agents.spawn.looks names {unknown[0]!r}, which is not an object of this world",
                hint=f"objects of this world: {', '.join(known) or 'none'}",
            )
        return tuple(known[name] for name in spec.looks)
    vehicles = tuple(o for o in state.visible if o.category in LOOKS)
    if not vehicles:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "agents.spawn has no appearance: the scene has no vehicle to copy",
            hint="insert a vehicle, or name objects in agents.spawn.looks",
        )
    moving = tuple(o for o in vehicles if o.trajectory.moves)
    return moving or vehicles


def _bodies_in(path: LoggedPath, agents: Agents, surroundings: Surroundings) -> Iterator[Neighbour]:
    """Objects and ego that overlap a lane of a car's width."""
    ego = surroundings.ego
    rows = np.column_stack(
        [agents.positions[:, :2], agents.sizes[:, :2], agents.velocities[:, :2]]
    ).tolist()
    moving = (ego.speed * math.cos(ego.yaw), ego.speed * math.sin(ego.yaw))
    rows.append([ego.x, ego.y, ego.length, ego.width, *moving])
    for x, y, length, width, vx, vy in rows:
        near = path.nearest(x, y)
        if abs(near.offset) < (width + 2.0) / 2 + SIDE:
            speed = vx * math.cos(near.yaw) + vy * math.sin(near.yaw)
            yield Neighbour(near.s, length / 2, speed)


def _neighbour(made: Idm) -> Neighbour:
    return Neighbour(made.s, made.subject.scaled_size[0] / 2, made.speed)


def _safe_speed(spec: IdmDriver, desired: float, gap: float, leader: float) -> float:
    """Speed from which comfortable braking ends behind the leader [m/s]."""
    room = max(gap - spec.gap - leader * spec.headway, 0.0)
    return min(desired, math.sqrt(max(leader, 0.0) ** 2 + 2.0 * spec.braking * room))


def _free_instance_id(active: list[Idm] | list[AgentDriver]) -> int:
    """The highest free instance id; edits use ids from the bottom."""
    taken = {d.subject.instance_id for d in active}
    return next(i for i in range(MAX_OBJECTS, 0, -1) if i not in taken)


def _standing_at(path: LoggedPath, s: float) -> Trajectory:
    x, y, z, yaw = path.at(s)
    quaternion = np.array([level_quaternion(yaw)])
    return Trajectory(np.zeros(1, np.int64), np.array([[x, y, z]]), quaternion)
