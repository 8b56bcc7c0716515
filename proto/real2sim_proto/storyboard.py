"""Storyboard of an episode: entities, and acts of events triggered by conditions.

The model follows OpenSCENARIO XML 1.3 (ASAM 2024). A storyboard can be written as such a file and
read again without loss, except for features that OpenSCENARIO lacks (shape ``quintic``). Numbers
may be expressions of ``parameters``, so a sweep only needs to set parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .base import Identifier, Model
from .storyboard_actions import (
    AnyAction,
    Clothoid,
    Dynamics,
    GlobalAction,
    LateralDistanceAction,
    LightStateAction,
    LongitudinalDistanceAction,
    PrivateAction,
    Reference,
    SpeedPoint,
    SynchronizeAction,
    WorldPosition,
)
from .storyboard_conditions import (
    Condition,
    EndOfRoad,
    Offroad,
    ReachPosition,
    StandStill,
    TraversedDistance,
    Trigger,
)
from .storyboard_values import Name, Plain, Value, with_values

MAX_ENTITIES = 64
MAX_ELEMENTS = 1000

ElementName = Annotated[str, Field(min_length=1, max_length=200)]


# --- entities ---------------------------------------------------------------------------------


class BoundingBox(Model):
    """(length, width, height) [m], and the box centre relative to the reference point [m]."""

    size: tuple[Value, Value, Value]
    centre: tuple[Value, Value, Value]


class Entity(Model):
    """A participant: an object of the scene, the ego, or a new road user.

    A new road user looks like `asset_id` of the library or `look` of the scene. By default it looks
    like the object of the scene with the most similar category and size, scaled to the box.
    """

    name: Reference
    kind: Literal["ego", "object", "new"] = "new"
    category: str = Field(default="car", max_length=80)
    object_id: Identifier | None = Field(
        default=None, description="object of the scene, for 'object'"
    )
    asset_id: Identifier | None = None
    look: Identifier | None = Field(default=None, description="an object of the scene")
    box: BoundingBox | None = Field(
        default=None, description="default: the object's, or by category"
    )
    model: str = Field(default="", max_length=200, description="name in the file's catalog")
    mass: Value | None = Field(default=None, description="[kg]")
    max_speed: Value = Field(default=70.0, description="limit of its actions [m/s]")
    max_acceleration: Value = Field(default=10.0, description="limit of its actions [m/s^2]")
    max_deceleration: Value = Field(default=10.0, description="limit of its actions [m/s^2]")

    @model_validator(mode="after")
    def _is_someone(self) -> Entity:
        if (self.kind == "object") != (self.object_id is not None):
            raise ValueError(f"entity {self.name!r}: object_id is only allowed with kind 'object'")
        return self


# --- road -------------------------------------------------------------------------------------


class RouteLanes(Model):
    """Lanes along the ego's route, for scenes without a map.

    Lanes right of the reference line have ids -1, -2 and so on outwards, those on the left 1, 2 ...
    Traffic is right-hand: the left lanes are oncoming.
    """

    kind: Literal["route"] = "route"
    lane_width: Annotated[float, Field(ge=1.5, le=10)] = 3.5
    ego_lane: int = Field(default=-1, ge=-20, le=-1, description="id of the lane of the route")
    s: float = Field(
        default=0.0, description="s of the reference line at the start of the route [m]"
    )
    left: int = Field(default=4, ge=0, le=20, description="number of lanes on the left")
    right: int = Field(default=4, ge=1, le=20, description="number of lanes on the right")


class MapRoads(Model):
    """Roads of the scene's map, or of a map included in the file."""

    kind: Literal["map"] = "map"
    file: str = Field(
        default="", max_length=1000, description="path of the map as written in the scenario file"
    )


Roads = Annotated[RouteLanes | MapRoads, Field(discriminator="kind")]


# --- traffic signals --------------------------------------------------------------------------


class SignalHead(Model):
    """A traffic signal, with its stop position."""

    signal_id: Reference
    stop_line: WorldPosition | None = Field(default=None, description="None: unknown")
    state: str = Field(
        default="off", max_length=200, description="initial state, until an action changes it"
    )


class Phase(Model):
    """States of signals for a duration."""

    name: ElementName
    duration: Value = Field(description="[s]")
    states: dict[Reference, str] = Field(max_length=200, description="states by signal id")


class SignalController(Model):
    """Cycles signals through phases."""

    name: ElementName
    delay: Value = Field(
        default=0.0, description="delay of its first phase after that of `reference` [s]"
    )
    reference: Reference | None = Field(
        default=None,
        description="controller that its cycle is relative to; None: simulation time",
    )
    phases: list[Phase] = Field(min_length=1, max_length=200)


class MapSignals(Model):
    """Cycle of the traffic lights of each junction of the scene's map.

    One group of lights after the other is green, then yellow; then all are red. Lights of the same
    or opposite directions, within 30 degrees, form a group, unless the map has different
    controllers for them. All cycles begin with the episode.
    """

    green: Value = Field(default=20.0, description="[s]")
    yellow: Value = Field(default=3.0, description="[s]")
    clearance: Value = Field(default=2.0, description="time in which all lights are red [s]")


# --- story ------------------------------------------------------------------------------------


class InitAction(Model):
    """Initial state of the episode."""

    entity: Reference
    action: PrivateAction


class Action(Model):
    """An action of an event."""

    name: ElementName
    action: AnyAction


class Event(Model):
    """Actions that start together."""

    name: ElementName
    priority: Literal["override", "skip", "parallel"] = Field(
        default="override", description="effect on other running events of the maneuver"
    )
    times: int = Field(default=1, ge=1, le=1_000_000, description="largest number of executions")
    actions: list[Action] = Field(min_length=1, max_length=100)
    start: Trigger | None = Field(default=None, description="None: starts with its maneuver")


class Maneuver(Model):
    """A sequence of events."""

    name: ElementName
    events: list[Event] = Field(min_length=1, max_length=200)


class ManeuverGroup(Model):
    """Maneuvers of the same entities."""

    name: ElementName
    entities: list[Reference] = Field(default_factory=list, max_length=64)
    times: int = Field(default=1, ge=1, le=1_000_000)
    maneuvers: list[Maneuver] = Field(default_factory=list, max_length=100)


class Act(Model):
    """Maneuver groups that start together."""

    name: ElementName
    groups: list[ManeuverGroup] = Field(min_length=1, max_length=100)
    start: Trigger | None = Field(default=None, description="None: starts with its story")
    stop: Trigger | None = None


class Story(Model):
    """A group of acts."""

    name: ElementName
    acts: list[Act] = Field(min_length=1, max_length=100)


# --- distributions ----------------------------------------------------------------------------


class ValueSet(Model):
    """These values, in order."""

    kind: Literal["set"] = "set"
    values: list[Plain] = Field(min_length=1, max_length=100_000)


class ValueRange(Model):
    """Values from lowest to highest with a constant step."""

    kind: Literal["range"] = "range"
    low: float
    high: float
    step: Annotated[float, Field(gt=0)]


class Uniform(Model):
    """Uniform distribution between low and high."""

    kind: Literal["uniform"] = "uniform"
    low: float
    high: float


class Normal(Model):
    """Normal distribution, truncated to the range by rejection if there is one."""

    kind: Literal["normal"] = "normal"
    mean: float
    variance: Annotated[float, Field(gt=0)]
    low: float | None = None
    high: float | None = None
    log: bool = Field(default=False, description="log-normal: mean and variance of the logarithm")


class Poisson(Model):
    """Poisson distribution with the given mean."""

    kind: Literal["poisson"] = "poisson"
    mean: Annotated[float, Field(gt=0, le=1e6)]
    low: float | None = None
    high: float | None = None


class Weighted(Model):
    """Value and weight."""

    value: Plain
    weight: Annotated[float, Field(ge=0)]


class Choice(Model):
    """Discrete distribution with weights."""

    kind: Literal["choice"] = "choice"
    values: list[Weighted] = Field(min_length=1, max_length=100_000)


class Bin(Model):
    """Range and weight."""

    low: float
    high: float
    weight: Annotated[float, Field(ge=0)]


class Histogram(Model):
    """Histogram distribution: ranges with weights, uniform in each."""

    kind: Literal["histogram"] = "histogram"
    bins: list[Bin] = Field(min_length=1, max_length=100_000)


Distribution = Annotated[
    ValueSet | ValueRange | Uniform | Normal | Poisson | Choice | Histogram,
    Field(discriminator="kind"),
]
DRAWN = (Uniform, Normal, Poisson, Choice, Histogram)
"""Distributions sampled with the episode's seed; a sweep enumerates the others."""


class Storyboard(Model):
    """Storyboard of an episode.

    Attributes that refer to names are checked: an unknown entity or parameter is a ValueError, and
    so is a negative time or distance. Rates use their magnitude.
    """

    name: str = Field(default="", max_length=200)
    author: str = Field(default="", max_length=200)
    date: str = Field(default="", max_length=40)
    parameters: dict[Name, Plain] = Field(default_factory=dict, max_length=1000)
    variables: dict[Name, Plain] = Field(default_factory=dict, max_length=1000)
    distributions: dict[Name, Distribution] = Field(
        default_factory=dict, max_length=200, description="distributions of parameter values"
    )
    roads: Roads = RouteLanes()
    origin: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0),
        description=(
            "x, y [m] and heading [rad], in the scene's world, of the frame of positions of "
            "kind 'world'"
        ),
    )
    entities: list[Entity] = Field(default_factory=list, max_length=MAX_ENTITIES)
    signals: list[SignalHead] = Field(default_factory=list, max_length=1000)
    controllers: list[SignalController] = Field(default_factory=list, max_length=200)
    map_signals: MapSignals | None = Field(
        default=None,
        description=(
            "cycle of the map's traffic lights that `signals` and `controllers` do not name; None: "
            "they have no states"
        ),
    )
    init: list[InitAction] = Field(default_factory=list, max_length=1000)
    global_init: list[GlobalAction] = Field(default_factory=list, max_length=1000)
    stories: list[Story] = Field(default_factory=list, max_length=100)
    stop: Trigger | None = Field(default=None, description="ends all acts; None: never")
    drives_ego: bool = Field(
        default=False, description="also moves the ego and ignores the planner"
    )
    ends_episode: bool = Field(
        default=False,
        description=(
            "the episode ends with `stop`; without a stop trigger, once all stories are complete"
        ),
    )

    @model_validator(mode="after")
    def _names_are_known(self) -> Storyboard:
        _check_names(self)
        board = resolved(self)
        for part in (board.controllers, board.map_signals, board.init, board.stories, board.stop):
            _check_magnitudes(part, "")
        return self


def resolved(board: Storyboard) -> Storyboard:
    """The storyboard with parameter values instead of expressions.

    Raises:
        ValueError: an expression without a value, or with an invalid one.
    """
    # Content without expressions is shared and validated only once.
    if not any(_has_expression(getattr(board, name)) for name in _RESOLVED):
        return board
    fields = {name: _plain(getattr(board, name)) for name in type(board).model_fields}
    known = {**board.parameters}
    found = {k: with_values(v, known) if k in _RESOLVED else v for k, v in fields.items()}
    return Storyboard.model_validate(found)


_RESOLVED = (
    "entities", "signals", "controllers", "map_signals", "init", "global_init", "stories", "stop",
)  # fmt: skip


def element_names(board: Storyboard) -> Iterator[tuple[str, ...]]:
    """Names of all stories, acts, groups, maneuvers, events and actions, from the story down."""
    for story in board.stories:
        yield (story.name,)
        for act in story.acts:
            yield (story.name, act.name)
            for group in act.groups:
                at = (story.name, act.name, group.name)
                yield at
                for maneuver in group.maneuvers:
                    yield (*at, maneuver.name)
                    for event in maneuver.events:
                        yield (*at, maneuver.name, event.name)
                        for action in event.actions:
                            yield (*at, maneuver.name, event.name, action.name)


def story_actions(board: Storyboard) -> Iterator[tuple[list[str], Any]]:
    """Names of the entities, and the action, of each action of the stories."""
    for story in board.stories:
        for act in story.acts:
            for group in act.groups:
                for maneuver in group.maneuvers:
                    for event in maneuver.events:
                        for each in event.actions:
                            yield list(map(str, group.entities)), each.action


def _plain(value: Any) -> Any:
    if isinstance(value, Model):
        return value.model_dump()
    return [_plain(v) for v in value] if isinstance(value, list) else value


def _has_expression(value: Any) -> bool:
    if isinstance(value, str):
        return value.startswith("$")
    if isinstance(value, Model):
        return any(_has_expression(v) for v in value.__dict__.values())
    if isinstance(value, dict):
        return any(_has_expression(v) for v in value.values())
    return isinstance(value, list | tuple) and any(_has_expression(v) for v in value)


_ENTITY_MEMBERS = frozenset({"entity", "relative_to", "master"})


def _check_names(board: Storyboard) -> None:
    names = [e.name for e in board.entities]
    if len(set(names)) != len(names):
        raise ValueError(f"entities need names of their own; given are {', '.join(names)}")
    if sum(e.kind == "ego" for e in board.entities) > 1:
        raise ValueError("at most one entity can be the ego")
    if unknown := sorted(set(board.distributions) - set(board.parameters)):
        raise ValueError(f"distribution of {unknown[0]!r}, which is not a parameter")
    for part in (board.init, board.global_init, board.stories, board.stop):
        for name in entity_references(part):
            _check_entity(name, names)
    count = sum(1 for _ in element_names(board))
    if count > MAX_ELEMENTS:
        raise ValueError(f"{count} elements of stories; {MAX_ELEMENTS} are allowed")


def entity_references(part: Any) -> Iterator[str]:
    """Names of the entities that part of a storyboard refers to."""
    if isinstance(part, list):
        for each in part:
            yield from entity_references(each)
    if not isinstance(part, Model):
        return
    for member, value in part.__dict__.items():
        if member in _ENTITY_MEMBERS and isinstance(value, str):
            yield value
        elif member == "entities" and value and isinstance(value[0], str):
            yield from value
        else:
            yield from entity_references(value)


_NEVER_NEGATIVE: Mapping[type[Model], tuple[str, ...]] = {
    SpeedPoint: ("time",),
    LongitudinalDistanceAction: ("distance", "time_gap"),
    LateralDistanceAction: ("distance",),
    SynchronizeAction: ("master_tolerance", "tolerance", "steady_distance", "steady_time"),
    Clothoid: ("length",),
    Condition: ("delay",),
    ReachPosition: ("tolerance",),
    LightStateAction: ("on_time", "off_time"),
    TraversedDistance: ("value",),
    StandStill: ("duration",),
    Offroad: ("duration",),
    EndOfRoad: ("duration",),
    Phase: ("duration",),
    MapSignals: ("green", "yellow", "clearance"),
}
"""Times and distances by model."""


def _check_magnitudes(part: Any, where: str) -> None:
    if isinstance(part, list):
        for each in part:
            _check_magnitudes(each, where)
    if not isinstance(part, Model):
        return
    own = part.entity if isinstance(part, InitAction) else getattr(part, "name", "")
    own = "map_signals" if isinstance(part, MapSignals) else own
    where = "::".join(name for name in (where, own) if name)
    members = {name: name for name in _NEVER_NEGATIVE.get(type(part), ())}
    if isinstance(part, Dynamics) and part.shape != "step" and part.dimension != "rate":
        members = {"value": f"the {part.dimension} of its dynamics"}
    for name, what in members.items():
        value = getattr(part, name)
        if isinstance(value, int | float) and value < 0:
            raise ValueError(f"{where}: {what} is {value:g}; it must be 0 or more")
    for value in part.__dict__.values():
        _check_magnitudes(value, where)


def _check_entity(name: str, names: Any) -> None:
    if name not in names and not name.startswith("$"):
        raise ValueError(
            f"{name!r} is not an entity; there are: {', '.join(sorted(names)) or 'none'}"
        )


__all__ = [
    "DRAWN",
    "Act",
    "Action",
    "BoundingBox",
    "Entity",
    "Event",
    "InitAction",
    "Maneuver",
    "ManeuverGroup",
    "MapRoads",
    "MapSignals",
    "Phase",
    "RouteLanes",
    "SignalController",
    "SignalHead",
    "Story",
    "Storyboard",
    "element_names",
    "entity_references",
    "resolved",
    "story_actions",
]
