"""A storyboard that runs: its entities and elements at one instant of an episode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import Entity, RouteLanes, Storyboard, resolved

from ...edit import ObjectState
from ..draws import Draws
from ..ego.motion import Motion
from ..errors import WorldError
from ..evolve import evolved
from ..traffic.driver import Surroundings
from ..traffic.replay import recorded_pose
from ..traffic.scripted import ScriptedEntity
from .draw import drawn_values
from .entities import box_of, own_centre
from .entity_state import EntityState, observed
from .positions import Places
from .program import PLACING, Program, program_of
from .progress import COMPLETE, ElementChange, Memories, Progress
from .roads import Place, RoadNetwork, RouteNetwork
from .shown_signal import ShownSignal
from .signals import shown_at

TICK_US = 10_000
"""Elements begin and end within a step of the clock at most so far apart [us]."""


@dataclass(frozen=True, eq=False)
class StoryboardRun:
    """A storyboard at one instant. Immutable: a step makes a new one.

    Attributes:
        program: what runs.
        network: roads.
        entities: entities by name.
        memories: elements, conditions, variables.
        drivers: of the objects that it moves, by object id.
        changes: of elements, in the step that led here.
        ego_put: whether it has put the ego somewhere at the start.
        ego: name of the ego among the entities; None: it takes no part.
        elapsed: time since the episode began [s].
        drawn: what the seed has drawn, by name.
    """

    program: Program
    network: RoadNetwork
    entities: Mapping[str, EntityState]
    memories: Memories
    drivers: Mapping[str, ScriptedEntity]
    changes: tuple[ElementChange, ...]
    ego_put: bool
    ego: str | None
    elapsed: float
    drawn: Mapping[str, float]

    @classmethod
    def begin(
        cls,
        board: Storyboard,
        subjects: Mapping[str, ObjectState],
        surroundings: Surroundings,
        *,
        ego_size: tuple[float, float, float],
        network: RoadNetwork | None = None,
        draws: Draws | None = None,
    ) -> StoryboardRun:
        """At the start of an episode, after what it says of the beginning.

        Args:
            board: with or without expressions.
            subjects: object of each entity but the ego, by name.
            surroundings: the start, the ego as it was recorded.
            ego_size: of its box [m].
            network: roads; None: lanes along the route.
            draws: of the episode; None: parameters are as they are written.

        Raises:
            WorldError: INVALID_REQUEST, what it asks for cannot be.
        """
        board, drawn = drawn_values(board, draws)
        board = _resolved(board)
        if network is None:
            lanes = board.roads if isinstance(board.roads, RouteLanes) else RouteLanes()
            network = RouteNetwork.of(lanes, surroundings.route)
        program = program_of(board)
        entities = {
            e.name: _first(
                e,
                subjects.get(e.name),
                surroundings,
                network=network,
                board=board,
                ego_size=ego_size,
            )
            for e in board.entities
        }
        progress = Progress(program, entities, _nothing_yet(program), network, surroundings)
        progress.initialise(surroundings.t_us, 0.0)
        ego = next((e.name for e in board.entities if e.kind == "ego"), None)
        put = any(
            entry.entity == ego and entry.action.kind in {"speed", *PLACING} for entry in board.init
        )
        run = cls(
            program, network, MappingProxyType(progress.entities), progress.memories,
            MappingProxyType({}), (), put, ego, 0.0, drawn,
        )  # fmt: skip
        return run._with_drivers(surroundings)

    def advance(self, surroundings: Surroundings) -> StoryboardRun:
        """One step later. Elements begin and end every 10 ms, at which the planner's ego is taken
        to go straight on as it does at the start of the step."""
        entities = dict(self.entities)
        if self.ego is not None and not entities[self.ego].scripted:
            dt = surroundings.dt if self.elapsed > 0.0 else 0.0
            entities[self.ego] = observed(entities[self.ego], surroundings.ego, dt)
        progress = Progress(self.program, entities, self.memories, self.network, surroundings)
        count = math.ceil(surroundings.dt_us / TICK_US)
        start_us, now_us = surroundings.start_us, surroundings.t_us
        for k in range(count):
            t_us = now_us + surroundings.dt_us * k // count
            next_us = now_us + surroundings.dt_us * (k + 1) // count
            elapsed = (t_us - start_us) * 1e-6
            progress.pass_instant(t_us, elapsed, first=k == 0)
            progress.move(elapsed, (next_us - t_us) * 1e-6, first=k == 0)
        moved = evolved(
            self,
            entities=MappingProxyType(progress.entities),
            memories=progress.memories,
            changes=tuple(progress.changes),
            elapsed=(now_us + surroundings.dt_us - start_us) * 1e-6,
        )
        return moved._with_drivers(surroundings)

    @property
    def over(self) -> bool:
        """Whether it has been stopped; without a stop trigger, whether all its stories are
        complete."""
        program, status = self.program, self.memories.status
        if self.memories.over or (program.stop is not None and program.board.version >= 2):
            return self.memories.over
        return bool(program.stories) and all(status[s.number] == COMPLETE for s in program.stories)

    @property
    def drives_ego(self) -> bool:
        """Whether it moves the ego."""
        return self.ego is not None and self.program.board.drives_ego

    def ego_motion(self, before: Motion) -> Motion:
        """The ego as the storyboard has it; ``before``: a step ago."""
        assert self.ego is not None
        actor = self.entities[self.ego]
        turned = math.remainder(actor.h - before.yaw, math.tau)
        x, y = actor.axle
        return Motion(x, y, before.yaw + turned, actor.speed, actor.acceleration)

    def signals(self) -> tuple[ShownSignal, ...]:
        """What traffic signals show now."""
        board = self.program.board
        if not board.signals and not board.controllers:
            return ()
        states, _ = shown_at(
            board, self.elapsed, self.memories.signal_starts, self.memories.signal_states
        )
        places = Places(self.entities, self.network, board.origin)
        lines = {h.signal_id: h.stop_line for h in board.signals}
        return tuple(
            ShownSignal(name, state, places.of(line)[:3] if (line := lines.get(name)) else None)
            for name, state in states.items()
        )

    def _with_drivers(self, surroundings: Surroundings) -> StoryboardRun:
        drivers = {
            a.subject.object_id: ScriptedEntity(a.subject, a.pose(surroundings.ground), a.visible)
            for a in self.entities.values()
            if a.subject is not None
        }
        return evolved(self, drivers=MappingProxyType(drivers))


def _resolved(board: Storyboard) -> Storyboard:
    try:
        return resolved(board)
    except ValueError as error:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"the storyboard's parameters do not fit: {error}",
            hint="set storyboard.parameters to values that its expressions allow",
        ) from error


def _first(
    entity: Entity,
    subject: ObjectState | None,
    surroundings: Surroundings,
    *,
    network: RoadNetwork,
    board: Storyboard,
    ego_size: tuple[float, float, float],
) -> EntityState:
    """An entity before the storyboard has put it anywhere: the ego and objects of the scene where
    they were recorded, others not in the world."""
    size, centre = box_of(entity, subject, ego_size)
    if entity.kind == "ego" and board.version >= 2:
        centre = own_centre(entity, size) or centre
    scripted = entity.kind != "ego" or board.drives_ego
    actor = EntityState(
        entity.name, entity.category, subject, size, centre, 0.0, 0.0, 0.0,
        scripted=scripted, visible=entity.kind == "ego",
    )  # fmt: skip
    if entity.kind == "ego":
        return observed(actor, surroundings.ego, 0.0).on_lane(network)
    if entity.kind == "new":
        placed = any(e.entity == entity.name and e.action.kind in PLACING for e in board.init)
        there = EntityState.put(actor, Place(0.0, 0.0, 0.0), network)
        return evolved(there, visible=placed)
    assert subject is not None
    track = subject.trajectory
    t_us = min(max(surroundings.t_us, track.start_us), track.end_us)
    pose = recorded_pose(subject, t_us)
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    place = Place(
        pose.position[0] - centre[0] * cos + centre[1] * sin,
        pose.position[1] - centre[0] * sin - centre[1] * cos,
        pose.yaw,
    )
    speed = pose.velocity[0] * cos + pose.velocity[1] * sin
    return evolved(actor, speed=speed, visible=True).put(place, network)


def _nothing_yet(program: Program) -> Memories:
    count = len(program.elements)
    board = program.board
    return Memories(
        (0,) * count, (0,) * count, {}, {}, {**board.parameters, **board.variables}, {}, {}, 1,
        over=False, fresh=frozenset(),
    )  # fmt: skip
