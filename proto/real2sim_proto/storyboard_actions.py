"""Positions and actions of a storyboard, after OpenSCENARIO XML 1.3 (ASAM 2024).

Positions refer to an entity's reference point: for vehicles, the centre of the rear axle on the
ground, as defined by the file's bounding box. Units are metres, seconds and radians.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import Model
from .storyboard_values import Name, Plain, Value

Reference = Annotated[str, Field(min_length=1, max_length=200)]
"""Name of an entity, signal or element of the storyboard."""


class Orientation(Model):
    """A heading [rad]; a relative one is relative to the frame of the position.

    The frame of `lane`, and of `relative_lane` with `along` "lane", is the driving direction of the
    lane; that of other positions on roads is the direction of the reference line.
    """

    h: Value = 0.0
    relative: bool = False


ALONG = Field(default=None, description="None: relative, with a heading of 0")


class WorldPosition(Model):
    """In the frame of the road network's map, or of the scene's world if there is none."""

    kind: Literal["world"] = "world"
    x: Value
    y: Value
    z: Value | None = Field(default=None, description="default: on the ground")
    h: Value = 0.0


class RelativeWorldPosition(Model):
    """Relative to an entity, along the axes of the world."""

    kind: Literal["relative_world"] = "relative_world"
    entity: Reference
    dx: Value
    dy: Value
    orientation: Orientation = Orientation(relative=True)


class RelativeObjectPosition(Model):
    """Relative to an entity, along its own axes."""

    kind: Literal["relative_object"] = "relative_object"
    entity: Reference
    dx: Value
    dy: Value
    orientation: Orientation = Orientation(relative=True)


class RoadPosition(Model):
    """Distance along a road's reference line and lateral offset, positive to the left."""

    kind: Literal["road"] = "road"
    road: str = Field(max_length=80)
    s: Value
    t: Value
    orientation: Orientation | None = ALONG


class RelativeRoadPosition(Model):
    """Relative to an entity, along the reference line and to the left of it."""

    kind: Literal["relative_road"] = "relative_road"
    entity: Reference
    ds: Value
    dt: Value
    orientation: Orientation | None = ALONG


class LanePosition(Model):
    """In a lane; without a map, `road` is ignored and lanes are those along the route."""

    kind: Literal["lane"] = "lane"
    road: str = Field(max_length=80)
    lane: int | Value
    s: Value
    offset: Value = 0.0
    orientation: Orientation | None = ALONG


class RelativeLanePosition(Model):
    """Relative to an entity, in its lane or `lanes` lanes to the left of it.

    Ahead and left are those of the entity, or with `along` "road" those of the reference line.
    """

    kind: Literal["relative_lane"] = "relative_lane"
    entity: Reference
    lanes: int | Value = 0
    ds: Value
    along: Literal["lane", "road"] = Field(
        default="lane", description="direction of `ds`, `lanes`, `offset` and relative headings"
    )
    offset: Value = 0.0
    orientation: Orientation | None = ALONG


PlainPosition = (
    WorldPosition
    | RelativeWorldPosition
    | RelativeObjectPosition
    | RoadPosition
    | RelativeRoadPosition
    | LanePosition
    | RelativeLanePosition
)
PlainPlace = Annotated[PlainPosition, Field(discriminator="kind")]


class Route(Model):
    """A path through waypoints, along lanes between them."""

    name: str = Field(default="route", max_length=200)
    closed: bool = False
    waypoints: list[PlainPlace] = Field(min_length=2, max_length=1000)


class RoutePosition(Model):
    """Along a route, in its lane there."""

    kind: Literal["route"] = "route"
    route: Route
    s: Value = Field(description="distance from the first point of the route [m]")
    t: Value = Field(default=0.0, description="positive to the left [m]")
    lane: int | Value | None = Field(
        default=None,
        description="lane id at that point; `t` is measured from its centre; None: from the route",
    )
    orientation: Orientation | None = ALONG


class TrajectoryPosition(Model):
    """Along a curve, with a lateral offset."""

    kind: Literal["trajectory"] = "trajectory"
    curve: Curve
    s: Value
    t: Value = Field(default=0.0, description="positive to the left [m]")
    orientation: Orientation | None = ALONG


Position = Annotated[
    PlainPosition | RoutePosition | TrajectoryPosition, Field(discriminator="kind")
]


# --- how values change ------------------------------------------------------------------------

Shape = Literal["step", "linear", "cubic", "sinusoidal", "quintic"]


class Dynamics(Model):
    """Transition of a value from its start to its target, f(0) = 0 to f(1) = 1.

    'linear' f = u; 'cubic' 3 u^2 - 2 u^3; 'sinusoidal' (1 - cos pi u) / 2; 'quintic' 10 u^3 -
    15 u^4 + 6 u^5, which OpenSCENARIO lacks; 'step' immediately.
    """

    shape: Shape = "linear"
    dimension: Literal["time", "distance", "rate"] = "time"
    value: Value = Field(default=0.0, description="[s], [m], or the largest rate of change")


STEP = Dynamics(shape="step")


class SpeedLimits(Model):
    """Limits of the motion during an action; None: unlimited."""

    acceleration: Value | None = Field(default=None, description="[m/s^2]")
    deceleration: Value | None = Field(default=None, description="[m/s^2], positive")
    speed: Value | None = Field(default=None, description="[m/s]")


class SpeedAction(Model):
    """Change to a target speed, with a given transition."""

    kind: Literal["speed"] = "speed"
    speed: Value = Field(description="[m/s]; or a difference [m/s] or a factor")
    relative_to: Reference | None = None
    relation: Literal["delta", "factor"] = "delta"
    continuous: bool = Field(default=False, description="keep following the other's speed")
    dynamics: Dynamics = STEP


class SpeedPoint(Model):
    """Target speed, and the time since the previous one."""

    time: Value
    speed: Value


class SpeedProfileAction(Model):
    """Speed profile with linear changes between entries."""

    kind: Literal["speed_profile"] = "speed_profile"
    points: list[SpeedPoint] = Field(min_length=1, max_length=10_000)
    relative_to: Reference | None = None


class LaneChangeAction(Model):
    """Change to the lane with an id, or to a lane relative to an entity's."""

    kind: Literal["lane_change"] = "lane_change"
    lane: int | Value = Field(description="lane id; or number of lanes, positive to the left")
    relative_to: Reference | None = None
    offset: Value = Field(default=0.0, description="offset from the centre of the target lane [m]")
    dynamics: Dynamics = Dynamics(shape="sinusoidal", value=3.0)


class LaneOffsetAction(Model):
    """Lateral offset from the centre of its lane, or from an entity."""

    kind: Literal["lane_offset"] = "lane_offset"
    offset: Value = Field(description="positive to the left of the lane or the entity [m]")
    relative_to: Reference | None = None
    continuous: bool = False
    shape: Shape = "step"
    acceleration: Value | None = Field(
        default=None, description="largest lateral acceleration [m/s^2]; None: immediate"
    )


class LateralDistanceAction(Model):
    """Keeps a lateral distance to an entity."""

    kind: Literal["lateral_distance"] = "lateral_distance"
    entity: Reference
    distance: Value
    side: Literal["any", "left", "right"] = Field(
        default="any", description="side of the entity to keep; 'any': the current side"
    )
    freespace: bool = False
    continuous: bool = False
    limits: SpeedLimits = SpeedLimits()


class LongitudinalDistanceAction(Model):
    """Keeps a distance or a time gap to an entity, along the road."""

    kind: Literal["longitudinal_distance"] = "longitudinal_distance"
    entity: Reference
    distance: Value | None = Field(default=None, description="[m]")
    time_gap: Value | None = Field(default=None, description="[s] at its own speed")
    place: Literal["any", "leading", "trailing"] = "any"
    freespace: bool = False
    continuous: bool = False
    limits: SpeedLimits = SpeedLimits()

    @model_validator(mode="after")
    def _one_aim(self) -> LongitudinalDistanceAction:
        if (self.distance is None) == (self.time_gap is None):
            raise ValueError("a longitudinal distance needs either distance or time_gap")
        return self


class SynchronizeAction(Model):
    """Arrives at its target when another entity arrives at its own.

    The acceleration is solved in every step: constant, or linear in time if the final speed is also
    given.
    """

    kind: Literal["synchronize"] = "synchronize"
    master: Reference
    master_target: Position
    target: Position
    final_speed: Value | None = Field(default=None, description="[m/s]")
    relative: bool = Field(default=False, description="final_speed is the difference to its speed")
    steady_distance: Value | None = Field(
        default=None, description="distance driven at the final speed before the arrival [m]"
    )
    steady_time: Value | None = Field(
        default=None, description="time driven at the final speed before the arrival [s]"
    )
    master_tolerance: Value = 0.0
    tolerance: Value = 0.0
    limits: SpeedLimits = Field(
        default=SpeedLimits(), description="limits of the entity; OpenSCENARIO has none here"
    )


class Vertex(Model):
    """A vertex of a polyline, and its time."""

    time: Value = 0.0
    position: Position
    oriented: bool = Field(
        default=False,
        description="use the heading of the position from here on; else that of the line",
    )


class Polyline(Model):
    """Straight lines between vertices."""

    shape: Literal["polyline"] = "polyline"
    vertices: list[Vertex] = Field(min_length=2, max_length=20_000)


class Clothoid(Model):
    """Curvature that changes linearly with distance."""

    shape: Literal["clothoid"] = "clothoid"
    position: Position
    curvature: Value = Field(description="curvature at its start [1/m]")
    curvature_rate: Value = Field(
        default=0.0, description="change of curvature per distance [1/m^2]"
    )
    length: Value = Field(description="[m]")
    start_time: Value | None = None
    stop_time: Value | None = None


class ControlPoint(Model):
    """Control point of a NURBS."""

    position: Position
    weight: Value = 1.0
    time: Value | None = None


class Nurbs(Model):
    """Non-uniform rational B-spline (Piegl & Tiller 1997)."""

    shape: Literal["nurbs"] = "nurbs"
    order: int = Field(ge=2, le=12)
    points: list[ControlPoint] = Field(min_length=2, max_length=1000)
    knots: list[Value] = Field(min_length=4, max_length=1012)

    @model_validator(mode="after")
    def _knots_fit(self) -> Nurbs:
        if len(self.knots) != len(self.points) + self.order or len(self.points) < self.order:
            raise ValueError(
                f"a NURBS of order {self.order} with {len(self.points)} points needs "
                f"{len(self.points) + self.order} knots and at least {self.order} points"
            )
        return self


class ClothoidPiece(Model):
    """Segment of a spline: curvature [1/m] changes linearly over its length [m]."""

    start: Value
    end: Value
    length: Value
    time: Value | None = Field(default=None, description="time at its start [s]")
    turn: Value = Field(default=0.0, description="change of heading at its start [rad]")
    position: Position | None = Field(
        default=None, description="its start; default: the end of the previous segment"
    )


class ClothoidSpline(Model):
    """Clothoid segments, each continuing the previous one unless it has a position of its own.

    Without a position, the first one starts where the entity is.
    """

    shape: Literal["clothoid_spline"] = "clothoid_spline"
    pieces: list[ClothoidPiece] = Field(min_length=1, max_length=1000)
    end_time: Value | None = None


Curve = Annotated[Polyline | Clothoid | ClothoidSpline | Nurbs, Field(discriminator="shape")]
TrajectoryPosition.model_rebuild()


class Timing(Model):
    """Times of a trajectory: scale x time + offset, from the action's start or the simulation's."""

    domain: Literal["absolute", "relative"] = "relative"
    scale: Value = 1.0
    offset: Value = 0.0


class FollowTrajectoryAction(Model):
    """Follows a curve, at its own speed or at the curve's times."""

    kind: Literal["follow_trajectory"] = "follow_trajectory"
    name: str = Field(default="trajectory", max_length=200)
    curve: Curve
    closed: bool = False
    timing: Timing | None = Field(default=None, description="None: the entity keeps its own speed")
    offset: Value = Field(default=0.0, description="distance from its start at which to begin [m]")


class AssignRouteAction(Model):
    """Sets the route of the entity."""

    kind: Literal["assign_route"] = "assign_route"
    route: Route


class RandomRouteAction(Model):
    """Sets a route along lanes that is random at each fork, sampled with the episode's seed."""

    kind: Literal["random_route"] = "random_route"


class AcquirePositionAction(Model):
    """Drives along lanes to a position."""

    kind: Literal["acquire_position"] = "acquire_position"
    position: Position


class TeleportAction(Model):
    """Moves the entity to a position immediately."""

    kind: Literal["teleport"] = "teleport"
    position: Position


class VisibilityAction(Model):
    """Whether the entity is in the world: visible, measured and collidable, always together."""

    kind: Literal["visibility"] = "visibility"
    visible: bool


class LightStateAction(Model):
    """Switches a lamp of the entity, at once."""

    kind: Literal["light_state"] = "light_state"
    lamp: Literal["brake", "indicator_left", "indicator_right", "hazard"] = Field(
        description="'hazard': both indicators, whatever their own states are"
    )
    mode: Literal["on", "off", "flashing"] = "on"
    on_time: Value = Field(default=0.5, description="lit part of a flash, which is first [s]")
    off_time: Value = Field(default=0.5, description="dark part of a flash [s]")


class FollowingParameters(Model):
    """Parameters of the intelligent driver model (Treiber et al. 2000), as for the driver
    ``idm``."""

    desired_speed: Annotated[float, Field(ge=0, le=150)] | None = Field(
        default=None, description="[m/s]; default: its speed at the start of the action"
    )
    headway: Annotated[float, Field(gt=0, le=3600)] = Field(
        default=1.5, description="time headway T [s]"
    )
    gap: Annotated[float, Field(ge=0, le=1e4)] = Field(
        default=2.0, description="gap s0 at rest [m]"
    )
    acceleration: Annotated[float, Field(gt=0, le=10)] = Field(default=1.5, description="[m/s^2]")
    braking: Annotated[float, Field(gt=0, le=10)] = Field(default=2.0, description="[m/s^2]")
    lateral: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.5, description="lateral acceleration that limits the speed in bends [m/s^2]"
    )


class ControllerAction(Model):
    """Drives by the intelligent driver model in its lane, until another action controls it."""

    kind: Literal["controller"] = "controller"
    active: bool = True
    idm: FollowingParameters = FollowingParameters()


PrivateAction = Annotated[
    SpeedAction
    | SpeedProfileAction
    | LaneChangeAction
    | LaneOffsetAction
    | LateralDistanceAction
    | LongitudinalDistanceAction
    | SynchronizeAction
    | FollowTrajectoryAction
    | AssignRouteAction
    | RandomRouteAction
    | AcquirePositionAction
    | TeleportAction
    | VisibilityAction
    | LightStateAction
    | ControllerAction,
    Field(discriminator="kind"),
]
"""Actions of each entity of a maneuver group."""


class AddEntityAction(Model):
    """Adds an entity to the world; without effect if it is there."""

    kind: Literal["add_entity"] = "add_entity"
    entity: Reference
    position: Position


class DeleteEntityAction(Model):
    """Removes an entity from the world."""

    kind: Literal["delete_entity"] = "delete_entity"
    entity: Reference


class SignalStateAction(Model):
    """Sets the state of a traffic signal."""

    kind: Literal["signal_state"] = "signal_state"
    signal: Reference
    state: str = Field(max_length=200)


class SignalPhaseAction(Model):
    """Sets a controller of traffic signals to the start of a phase."""

    kind: Literal["signal_phase"] = "signal_phase"
    controller: Reference
    phase: str = Field(max_length=200)


class SetVariableAction(Model):
    """Sets a variable, or adds to it, or multiplies it."""

    kind: Literal["set_variable"] = "set_variable"
    variable: Name
    value: Plain
    rule: Literal["set", "add", "multiply"] = "set"


class CustomAction(Model):
    """Does nothing; keeps the place of an action that has no effect here, such as weather."""

    kind: Literal["custom"] = "custom"
    type: str = Field(max_length=200, description="what the action is, for other programs")


GlobalAction = Annotated[
    AddEntityAction
    | DeleteEntityAction
    | SignalStateAction
    | SignalPhaseAction
    | SetVariableAction,
    Field(discriminator="kind"),
]
"""Actions without an entity."""

AnyAction = Annotated[
    SpeedAction
    | SpeedProfileAction
    | LaneChangeAction
    | LaneOffsetAction
    | LateralDistanceAction
    | LongitudinalDistanceAction
    | SynchronizeAction
    | FollowTrajectoryAction
    | AssignRouteAction
    | RandomRouteAction
    | AcquirePositionAction
    | TeleportAction
    | VisibilityAction
    | LightStateAction
    | ControllerAction
    | AddEntityAction
    | DeleteEntityAction
    | SignalStateAction
    | SignalPhaseAction
    | SetVariableAction
    | CustomAction,
    Field(discriminator="kind"),
]
