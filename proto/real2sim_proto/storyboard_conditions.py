"""Conditions and triggers of a storyboard, after OpenSCENARIO XML 1.3 (ASAM 2024)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import Model
from .storyboard_actions import Position, Reference
from .storyboard_values import Name, Plain, Value

Rule = Literal[
    "greater_than",
    "less_than",
    "equal_to",
    "greater_or_equal",
    "less_or_equal",
    "not_equal_to",
]
Direction = Literal["longitudinal", "lateral"]
Measure = Literal["euclidean", "longitudinal", "lateral"]
Frame = Literal["entity", "lane", "road"]


class Entities(Model):
    """Triggering entities: the condition must hold for any of them, or for all."""

    entities: list[Reference] = Field(min_length=1, max_length=64)
    of: Literal["any", "all"] = "any"


class Distances(Model):
    """Definition of a distance: between reference points or boxes (`freespace`); Euclidean, or
    along or across the frame of the entity, or of its lane or road."""

    measure: Measure = "euclidean"
    frame: Frame = "entity"
    freespace: bool = False
    rule: Rule
    value: Value


class SimulationTime(Model):
    """Time since the start of the episode [s]."""

    kind: Literal["simulation_time"] = "simulation_time"
    rule: Rule
    value: Value


class TimeToCollision(Entities, Distances):
    """Distance divided by closing speed [s], to an entity or a position."""

    kind: Literal["time_to_collision"] = "time_to_collision"
    entity: Reference | None = None
    position: Position | None = None


class TimeHeadway(Entities, Distances):
    """Distance to another entity divided by own speed [s]."""

    kind: Literal["time_headway"] = "time_headway"
    entity: Reference


class RelativeDistance(Entities, Distances):
    """Distance to another entity [m]."""

    kind: Literal["relative_distance"] = "relative_distance"
    entity: Reference


class Distance(Entities, Distances):
    """Distance to a position [m]."""

    kind: Literal["distance"] = "distance"
    position: Position


class RelativeClearance(Entities):
    """One of the given lanes exists, and no other entity is near in any of them."""

    kind: Literal["relative_clearance"] = "relative_clearance"
    ahead: Value = Field(default=0.0, description="distance ahead that must be clear [m]")
    behind: Value = Field(default=0.0, description="distance behind that must be clear [m]")
    lanes: list[tuple[int, int]] = Field(
        default_factory=list,
        max_length=64,
        description="ranges relative to the entity's lane, positive to the left; empty: all",
    )
    opposite: bool = Field(default=False, description="also lanes in the opposite direction")
    others: list[Reference] = Field(
        default_factory=list, max_length=64, description="entities to check; empty: all others"
    )
    freespace: bool = Field(default=False, description="measure between the boxes")


class ReachPosition(Entities):
    """Within a tolerance [m] of a position."""

    kind: Literal["reach_position"] = "reach_position"
    position: Position
    tolerance: Value


class Speed(Entities):
    """[m/s], along its heading or lateral; `relative_to` subtracts the speed of another entity."""

    kind: Literal["speed"] = "speed"
    rule: Rule
    value: Value
    relative_to: Reference | None = None
    direction: Direction | None = Field(default=None, description="default: amount, along heading")


class Acceleration(Entities):
    """Acceleration [m/s^2]."""

    kind: Literal["acceleration"] = "acceleration"
    rule: Rule
    value: Value
    direction: Direction | None = None


class Collision(Entities):
    """Collision with an entity, or with any of a category; None: with any entity.

    The category ``vehicle`` includes cars, vans, trucks, buses, motorcycles and cyclists.
    """

    kind: Literal["collision"] = "collision"
    entity: Reference | None = None
    category: str | None = Field(default=None, max_length=80)


class TraversedDistance(Entities):
    """Minimum distance travelled since the condition became active [m]."""

    kind: Literal["traversed_distance"] = "traversed_distance"
    value: Value


class StandStill(Entities):
    """Standing still for this duration [s]."""

    kind: Literal["stand_still"] = "stand_still"
    duration: Value


class Offroad(Entities):
    """Outside every drivable lane for this duration [s]."""

    kind: Literal["offroad"] = "offroad"
    duration: Value


class EndOfRoad(Entities):
    """At the end of the road for this duration [s]."""

    kind: Literal["end_of_road"] = "end_of_road"
    duration: Value


class Angle(Entities):
    """Heading in the world, or relative to another entity's, within a tolerance [rad]."""

    kind: Literal["angle"] = "angle"
    entity: Reference | None = None
    angle: Value
    tolerance: Value


ElementType = Literal["story", "act", "maneuver_group", "maneuver", "event", "action"]
ElementState = Literal[
    "standby",
    "running",
    "complete",
    "start_transition",
    "end_transition",
    "stop_transition",
    "skip_transition",
]


class StoryboardElementState(Model):
    """State of a storyboard element, by its name or by names joined with '::'."""

    kind: Literal["element_state"] = "element_state"
    element_type: ElementType
    element: Reference
    state: ElementState


class VariableValue(Model):
    """Comparison of a parameter or variable with a value."""

    kind: Literal["variable"] = "variable"
    variable: Name
    rule: Rule
    value: Plain


class SignalState(Model):
    """State of a traffic signal."""

    kind: Literal["signal_state"] = "signal_state"
    signal: Reference
    state: str = Field(max_length=200)


class SignalPhase(Model):
    """Phase of a controller of traffic signals."""

    kind: Literal["signal_phase"] = "signal_phase"
    controller: Reference
    phase: str = Field(max_length=200)


Test = Annotated[
    SimulationTime
    | TimeToCollision
    | TimeHeadway
    | RelativeDistance
    | Distance
    | RelativeClearance
    | ReachPosition
    | Speed
    | Acceleration
    | Collision
    | TraversedDistance
    | StandStill
    | Offroad
    | EndOfRoad
    | Angle
    | StoryboardElementState
    | VariableValue
    | SignalState
    | SignalPhase,
    Field(discriminator="kind"),
]


class Condition(Model):
    """A test, and when it triggers: while it is true, or on a rising or falling edge; after a
    delay."""

    name: str = Field(default="", max_length=200)
    edge: Literal["none", "rising", "falling", "rising_or_falling"] = "none"
    delay: Value = Field(default=0.0, description="[s]")
    test: Test


class ConditionGroup(Model):
    """Conditions that must all hold."""

    conditions: list[Condition] = Field(min_length=1, max_length=100)


class Trigger(Model):
    """True if any of the groups is; without groups never."""

    groups: list[ConditionGroup] = Field(default_factory=list, max_length=100)
