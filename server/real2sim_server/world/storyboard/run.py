"""A running storyboard: entities and elements at one instant of an episode."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.drive import Lamp
from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import (
    DRAWN,
    Choice,
    Entity,
    Histogram,
    MapRoads,
    Normal,
    Poisson,
    RouteLanes,
    Storyboard,
    Uniform,
    resolved,
)
from real2sim_proto.storyboard_actions import LightStateAction, SpeedLimits

from ...edit import ObjectState, ScenarioState
from ...edit.compose import figure_of
from ...scene import Scene, Trajectory
from ...scene.lane_graph import LaneGraph
from ...scene.scene import MAX_OBJECTS
from ..boxes import REAR_OVERHANG
from ..common import Draws, WorldError, copy_with
from ..ego_motion import Motion
from ..traffic.driver import ScriptedEntity, Surroundings, recorded_pose
from .map_lights import with_map_signals
from .program import PLACING, Program, ShownSignal, program_of, shown_at
from .progress import COMPLETE, ElementChange, Progress, ProgressState
from .roads import GraphNetwork, Place, RoadNetwork, RouteNetwork
from .view import EntityState, PositionResolver, observed

TRIES = 1000
"""Maximum number of draws for a value within a range."""


def drawn_values(board: Storyboard, draws: Draws | None) -> tuple[Storyboard, Mapping[str, float]]:
    """The storyboard with sampled values for its stochastic parameters.

    Also returns the sampled numbers by name. Without ``draws`` the storyboard is unchanged.

    Raises:
        WorldError: INVALID_REQUEST for a range without samples.
    """
    stochastic = {k: d for k, d in board.distributions.items() if isinstance(d, DRAWN)}
    if draws is None or not stochastic:
        return board, {}
    values = {name: _drawn(d, name, draws) for name, d in stochastic.items()}
    named = {
        f"storyboard.parameters.{k}": float(v)
        for k, v in values.items()
        if isinstance(v, int | float)
    }
    return board.model_copy(update={"parameters": {**board.parameters, **values}}), named


def _drawn(distribution: Any, name: str, draws: Draws) -> Any:
    what = f"storyboard.{name}"
    if isinstance(distribution, Uniform):
        u = draws.uniform(what)[0]
        return distribution.low + (distribution.high - distribution.low) * u
    if isinstance(distribution, Choice):
        weights = [v.weight for v in distribution.values]
        return distribution.values[_picked(weights, draws.uniform(what)[0])].value
    if isinstance(distribution, Histogram):
        u, v = draws.uniform(what, count=2)
        chosen = distribution.bins[_picked([b.weight for b in distribution.bins], u)]
        return chosen.low + (chosen.high - chosen.low) * v
    for attempt in range(TRIES):
        value = _unbounded(distribution, what, draws, attempt)
        low, high = distribution.low, distribution.high
        if (low is None or value >= low) and (high is None or value <= high):
            return value
    raise WorldError(
        ErrorCode.INVALID_REQUEST,
        f"nothing drawn for storyboard parameter {name!r} falls within its range",
        hint="widen the range of its distribution",
    )


def _unbounded(distribution: Normal | Poisson, what: str, draws: Draws, attempt: int) -> float:
    if isinstance(distribution, Normal):
        value = (
            distribution.mean + math.sqrt(distribution.variance) * (draws.normal(what, attempt)[0])
        )
        return math.exp(value) if distribution.log else value
    # Sum of waiting times (Knuth 1969), in parts that do not underflow.
    left, count, number = distribution.mean, 0, 0
    while True:
        u = draws.uniform(what, attempt, number)[0]
        number += 1
        left += math.log(max(1.0 - u, 1e-300))
        if left <= 0.0:
            return float(count)
        count += 1


def _picked(weights: list[float], u: float) -> int:
    left = u * sum(weights)
    for k, weight in enumerate(weights):
        if left < weight:
            return k
        left -= weight
    return len(weights) - 1


BOXES = {
    "car": ((4.6, 1.85, 1.5), 1.35),
    "van": ((5.2, 2.0, 2.0), 1.5),
    "truck": ((8.0, 2.5, 3.2), 2.5),
    "bus": ((11.0, 2.5, 3.2), 3.0),
    "motorcycle": ((2.1, 0.8, 1.6), 0.0),
    "cyclist": ((1.8, 0.6, 1.8), 0.0),
    "pedestrian": ((0.5, 0.6, 1.8), 0.0),
    "animal": ((0.9, 0.3, 0.7), 0.0),
}
"""Default size of a category, and distance from the reference point to its centre [m]."""

OTHER = ((1.0, 1.0, 1.0), 0.0)

ALIKE = (
    frozenset({"car", "vehicle", "van", "truck", "bus"}),
    frozenset({"motorcycle", "cyclist", "bicycle"}),
    frozenset({"pedestrian", "person", "animal"}),
)
"""Categories that can share appearances."""

Vector = tuple[float, float, float]


def box_of(entity: Entity, subject: ObjectState | None, ego_size: Vector) -> tuple[Vector, Vector]:
    """Size of an entity's box, and its centre relative to the reference point [m].

    From the entity itself, its object, the ego, or its category.
    """
    if entity.kind == "ego":
        return ego_size, (ego_size[0] / 2 - REAR_OVERHANG, 0.0, ego_size[2] / 2)
    if entity.box is not None:
        length, width, height = (float(v) for v in entity.box.size)
        x, y, z = (float(v) for v in entity.box.centre)
        return (length, width, height), (x, y, z)
    if entity.kind == "object" and subject is not None:
        size = subject.scaled_size
        return size, (0.0, 0.0, size[2] / 2)
    size, ahead = BOXES.get(entity.category, OTHER)
    return size, (ahead, 0.0, size[2] / 2)


def own_centre(ego: Entity, ego_size: Vector) -> Vector | None:
    """Box centre of the ego relative to its reference point [m], from the storyboard.

    None if the storyboard describes no vehicle, or one of another size.
    """
    if ego.box is None or not np.allclose([float(v) for v in ego.box.size], ego_size, atol=1e-6):
        return None
    x, y, z = (float(v) for v in ego.box.centre)
    return x, y, z


def subjects_of(
    entities: Iterable[Entity], state: ScenarioState, scene: Scene
) -> dict[str, ObjectState]:
    """The object of each entity except the ego, by name.

    New entities use the appearance of objects in ``scene``.

    Raises:
        WorldError: UNKNOWN_OBJECT for a missing object or appearance, UNKNOWN_ASSET, or
            INVALID_REQUEST if no object can provide the appearance or an id is taken.
    """
    found, number = dict[str, ObjectState](), MAX_OBJECTS
    for entity in entities:
        if entity.kind == "ego":
            continue
        if entity.kind == "object":
            found[entity.name] = _known(state, str(entity.object_id), f"entity {entity.name!r}")
            continue
        found[entity.name] = _new(entity, state, scene, number)
        number -= 1
    ids = [subject.object_id for subject in found.values()]
    if twice := sorted({i for i in ids if ids.count(i) > 1}):
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"two entities of the storyboard are the object {twice[0]!r}",
            hint="name each object once, and entities unlike the objects of the scene",
        )
    return found


def object_ids_of(name: str) -> tuple[str, str]:
    """The object id of a new entity, and the alternative if it is taken."""
    object_id = "".join(c if c.isalnum() or c in "_.-" else "_" for c in name)[:80]
    return object_id, f"{object_id[:72]}.story"


def _known(state: ScenarioState, object_id: str, who: str) -> ObjectState:
    known = {o.object_id: o for o in state.visible}
    if object_id not in known:
        raise WorldError(
            ErrorCode.UNKNOWN_OBJECT,
            f"{who} of the storyboard is {object_id!r}, which is not an object of this world",
            hint=f"objects of this world: {', '.join(known) or 'none'}",
        )
    return known[object_id]


def _new(entity: Entity, state: ScenarioState, scene: Scene, instance_id: int) -> ObjectState:
    size, _ = box_of(entity, None, (1.0, 1.0, 1.0))
    object_id, else_id = object_ids_of(entity.name)
    if state.has_id(object_id):
        object_id = else_id
    here = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    common = {
        "object_id": object_id,
        "category": entity.category,
        "instance_id": instance_id,
        "trajectory": here,
        "velocity": None,
        "edited": True,
    }
    if entity.asset_id is not None:
        asset = state.assets(entity.asset_id) if state.assets else None
        if asset is None:
            raise WorldError(
                ErrorCode.UNKNOWN_ASSET,
                f"entity {entity.name!r} shows asset {entity.asset_id!r}, which is not in the "
                "library",
                hint="GET /v1/assets lists them; POST /v1/assets adds one",
            )
        fitted = _fitted(size, asset.size, walks=asset.figure is not None)
        return ObjectState(source_id="", asset=asset, **fitted, **common)  # type: ignore[arg-type]
    look = _look(entity, state, size)
    fitted = _fitted(size, look.size, walks=figure_of(scene, look) is not None)
    return replace(look, **fitted, **common)  # type: ignore[arg-type]


def _look(entity: Entity, state: ScenarioState, size: Vector) -> ObjectState:
    """The object with the appearance of an entity: the named one, else by category and size."""
    if entity.look is not None:
        return _known(state, entity.look, f"the look of {entity.name!r}")
    candidates = list(state.visible)
    if not candidates:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"entity {entity.name!r} has no appearance: the scene has no object to copy",
            hint="name an asset of the library in `asset_id`",
        )
    group = next((g for g in ALIKE if entity.category in g), frozenset({entity.category}))

    def unlike(subject: ObjectState) -> tuple[bool, bool, float, str]:
        ratios = [a / b for a, b in zip(size, subject.size, strict=True)]
        stretch = sum(math.log(r) ** 2 for r in ratios)
        same = subject.category == entity.category
        return subject.category not in group, not same, stretch, subject.object_id

    return min(candidates, key=unlike)


def _fitted(size: Vector, of: Vector, *, walks: bool) -> dict[str, Vector]:
    """Unscaled size and scale of an object of box ``size`` with the appearance of size ``of``.

    Pedestrians are scaled uniformly to their height, all others are stretched.
    """
    if not walks:
        return {"size": of, "scale": (size[0] / of[0], size[1] / of[1], size[2] / of[2])}
    scale = size[2] / of[2]
    length, width, height = (edge / scale for edge in size)
    return {"size": (length, width, height), "scale": (scale, scale, scale)}


TICK_US = 10_000
"""Maximum interval between two checks of elements within a clock step [us]."""


@dataclass(frozen=True, eq=False)
class StoryboardRun:
    """A storyboard at one instant. Immutable: a step returns a new one.

    Attributes:
        program: prepared storyboard.
        network: road network.
        entities: entities by name.
        state: elements, conditions, variables.
        drivers: drivers of the objects that it moves, by object id.
        changes: element changes of the last step.
        ego_put: whether the storyboard placed the ego at the start.
        ego: name of the ego among the entities, or None.
        elapsed: time since the start of the episode [s].
        sampled: sampled values by name.
    """

    program: Program
    network: RoadNetwork
    entities: Mapping[str, EntityState]
    state: ProgressState
    drivers: Mapping[str, ScriptedEntity]
    changes: tuple[ElementChange, ...]
    ego_put: bool
    ego: str | None
    elapsed: float
    sampled: Mapping[str, float]

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
        lanes: LaneGraph | None = None,
    ) -> StoryboardRun:
        """The storyboard at the start of an episode, after its init actions.

        Args:
            board: storyboard, with or without expressions.
            subjects: object of each entity except the ego, by name.
            surroundings: the start instant, with the recorded ego.
            ego_size: size of the ego's box [m].
            network: road network; None for lanes along the route.
            draws: random numbers of the episode; None to keep parameters as written.
            lanes: map with the traffic lights of ``map_signals``; None: they have no states.

        Raises:
            WorldError: INVALID_REQUEST if the storyboard cannot be executed.
        """
        board, sampled = drawn_values(board, draws)
        board = _resolved(board)
        if board.map_signals is not None and lanes is not None:
            board = with_map_signals(board, board.map_signals, lanes)
        if network is None:
            roads = board.roads if isinstance(board.roads, RouteLanes) else RouteLanes()
            network = RouteNetwork.of(roads, surroundings.route)
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
            program, network, MappingProxyType(progress.entities), progress.state,
            MappingProxyType({}), (), put, ego, 0.0, sampled,
        )  # fmt: skip
        return run._with_drivers(surroundings)

    def advance(self, surroundings: Surroundings) -> StoryboardRun:
        """The storyboard one step later.

        Elements start and end on a 10 ms grid. Within the step, a planner's ego is extrapolated
        from its motion at the start of the step.
        """
        entities = dict(self.entities)
        if self.ego is not None and not entities[self.ego].scripted:
            dt = surroundings.dt if self.elapsed > 0.0 else 0.0
            entities[self.ego] = observed(entities[self.ego], surroundings.ego, dt)
        progress = Progress(self.program, entities, self.state, self.network, surroundings)
        count = math.ceil(surroundings.dt_us / TICK_US)
        start_us, now_us = surroundings.start_us, surroundings.t_us
        for k in range(count):
            t_us = now_us + surroundings.dt_us * k // count
            next_us = now_us + surroundings.dt_us * (k + 1) // count
            elapsed = (t_us - start_us) * 1e-6
            progress.pass_instant(t_us, elapsed, first=k == 0)
            progress.move(elapsed, (next_us - t_us) * 1e-6, first=k == 0)
        moved = copy_with(
            self,
            entities=MappingProxyType(progress.entities),
            state=progress.state,
            changes=tuple(progress.changes),
            elapsed=(now_us + surroundings.dt_us - start_us) * 1e-6,
        )
        return moved._with_drivers(surroundings)

    @property
    def over(self) -> bool:
        """Whether it has been stopped or, without a stop trigger, all stories are complete."""
        program, status = self.program, self.state.status
        if self.state.over or program.stop is not None:
            return self.state.over
        return bool(program.stories) and all(status[s.number] == COMPLETE for s in program.stories)

    @property
    def drives_ego(self) -> bool:
        """Whether it moves the ego."""
        return self.ego is not None and self.program.board.drives_ego

    def ego_motion(self, before: Motion) -> Motion:
        """The ego motion of the storyboard; ``before``: motion one step earlier."""
        assert self.ego is not None
        actor = self.entities[self.ego]
        turned = math.remainder(actor.h - before.yaw, math.tau)
        x, y = actor.axle
        return Motion(x, y, before.yaw + turned, actor.speed, actor.acceleration)

    def signals(self) -> tuple[ShownSignal, ...]:
        """Current states of the traffic signals."""
        board = self.program.board
        if not board.signals and not board.controllers:
            return ()
        states, _ = shown_at(
            board, self.elapsed, self.state.signal_starts, self.state.signal_states
        )
        places = PositionResolver(self.entities, self.network, board.origin)
        lines = {h.signal_id: h.stop_line for h in board.signals}
        return tuple(
            ShownSignal(name, state, places.of(line)[:3] if (line := lines.get(name)) else None)
            for name, state in states.items()
        )

    def _with_drivers(self, surroundings: Surroundings) -> StoryboardRun:
        drivers = {
            a.subject.object_id: ScriptedEntity(
                a.subject, a.pose(surroundings.ground), a.visible, _lit(a, self.elapsed)
            )
            for a in self.entities.values()
            if a.subject is not None
        }
        return copy_with(self, drivers=MappingProxyType(drivers))


def _lit(actor: EntityState, elapsed: float) -> tuple[Lamp, ...]:
    """The lamps of an entity that are lit at a time [s]."""
    lit = {
        lamp for lamp, (action, since) in actor.lights.items() if _is_lit(action, elapsed - since)
    }
    indicators: tuple[Lamp, ...] = ("indicator_left", "indicator_right")
    brake: tuple[Lamp, ...] = ("brake",) if "brake" in lit else ()
    return *brake, *(lamp for lamp in indicators if lamp in lit or "hazard" in lit)


def _is_lit(action: LightStateAction, since: float) -> bool:
    # In whole microseconds: 0.7 - 0.2 is less than 0.5.
    on_us, off_us = (round(float(t) * 1e6) for t in (action.on_time, action.off_time))
    if action.mode != "flashing" or not off_us:
        return action.mode != "off"
    return round(since * 1e6) % (on_us + off_us) < on_us


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
    """An entity before the init actions.

    The ego and objects of the scene are at their recorded poses; others are not in the world.
    """
    size, centre = box_of(entity, subject, ego_size)
    if entity.kind == "ego":
        centre = own_centre(entity, size) or centre
    scripted = entity.kind != "ego" or board.drives_ego
    actor = EntityState(
        entity.name, entity.category, subject, size, centre, 0.0, 0.0, 0.0,
        scripted=scripted,
        performance=SpeedLimits(
            speed=entity.max_speed,
            acceleration=entity.max_acceleration,
            deceleration=entity.max_deceleration,
        ),
    )  # fmt: skip
    if entity.kind == "ego":
        return observed(actor, surroundings.ego, 0.0).on_lane(network)
    if entity.kind == "new":
        placed = any(e.entity == entity.name and e.action.kind in PLACING for e in board.init)
        there = EntityState.put(actor, Place(0.0, 0.0, 0.0), network)
        return copy_with(there, present=placed, visible=placed)
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
    return copy_with(actor, speed=speed).put(place, network)


def _nothing_yet(program: Program) -> ProgressState:
    count = len(program.elements)
    board = program.board
    return ProgressState(
        (0,) * count, (0,) * count, {}, {}, {**board.parameters, **board.variables}, {}, {}, 1,
        over=False, fresh={},
    )  # fmt: skip


def begin_storyboard(
    spec: ResetSpec, state: ScenarioState, surroundings: Surroundings, scene: Scene, draws: Draws
) -> StoryboardRun:
    """Start the storyboard of a reset.

    Args:
        spec: reset with a storyboard.
        state: objects of the scenario.
        surroundings: the start instant, with the recorded ego.
        scene: the scene.
        draws: random numbers of the episode.

    Raises:
        WorldError: INVALID_REQUEST if it conflicts with other options or cannot be executed;
            UNKNOWN_OBJECT, UNKNOWN_ASSET.
    """
    board = spec.storyboard
    assert board is not None
    if spec.beyond_log == "loop":
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a storyboard runs once, but beyond_log 'loop' returns the ego to the start",
            hint="set beyond_log to 'extend' or 'end'",
        )
    if spec.warmup_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a storyboard says where the ego begins, and a warm-up lets it follow the log",
            hint="leave out warmup_us, or the storyboard",
        )
    driven = {e.object_id for e in board.entities if e.kind == "object"} & set(spec.agents.drivers)
    if driven:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"object {min(map(str, driven))!r} has a driver and is moved by the storyboard",
            hint="leave it out of agents.drivers",
        )
    return StoryboardRun.begin(
        board,
        subjects_of(resolved(board).entities, state, scene),
        surroundings,
        ego_size=scene.ego_size,
        network=_network(board, scene, draws),
        draws=draws,
        lanes=_lights(board, scene),
    )


def _network(board: Storyboard, scene: Scene, draws: Draws) -> RoadNetwork | None:
    """Road network of the scene's map if the storyboard uses one; None for route lanes."""
    if not isinstance(board.roads, MapRoads):
        return None
    graph: LaneGraph | None = getattr(scene, "lanes", None)
    if graph is None or not graph.roads:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"the storyboard is for a road network ({board.roads.file or 'unnamed'}), and scene "
            f"{scene.name!r} has no map with roads",
            hint="run it on a scene made from that network, or with storyboard.roads of kind "
            "'route', lanes along the ego's route",
        )
    return GraphNetwork(graph, draws)


def _lights(board: Storyboard, scene: Scene) -> LaneGraph | None:
    """The scene's map if the storyboard sets the phases of its traffic lights."""
    if board.map_signals is None:
        return None
    graph: LaneGraph | None = getattr(scene, "lanes", None)
    if graph is None or all(s.kind != "traffic_light" for s in graph.signals.values()):
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "storyboard.map_signals sets the phases of the map's traffic lights, and scene "
            f"{scene.name!r} has {'no map' if graph is None else 'a map without traffic lights'}",
            hint="leave it out, or give the scene a map with traffic lights",
        )
    return graph
