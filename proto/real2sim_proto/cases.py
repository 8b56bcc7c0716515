"""Build storyboards in a few lines: road users around the ego, and the events that move them.

::

    board = case(
        actor("cutter", in_lane(-15.0, lane=1), 14.0,
              event("move_in", at_time(2.0), change_lane(0, seconds=2.5)),
              event("brake", completed("move_in"), speed_to(0.0, rate=6.0))),
    )

Units are m, s, m/s and rad. A number may be an expression of parameters, such as ``"$gap"`` or
``"${2 * $gap}"``. The functions return models of the storyboard, and accept any other condition,
action and position of :mod:`real2sim_proto.storyboard` too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from . import storyboard_actions as actions
from . import storyboard_conditions as conditions
from .base import advice
from .storyboard import (
    Act,
    Action,
    BoundingBox,
    Entity,
    Event,
    InitAction,
    Maneuver,
    ManeuverGroup,
    Story,
    Storyboard,
)
from .storyboard_actions import AnyAction, Position
from .storyboard_conditions import Condition, Test, Trigger
from .storyboard_values import Value

DATE = "2026-01-01T00:00:00"
"""Default date of a case; OpenSCENARIO files need one."""


@dataclass(frozen=True)
class Actor:
    """A participant of a case, how it starts, and its events."""

    entity: Entity
    init: tuple[InitAction, ...] = ()
    events: tuple[Event, ...] = ()


def case(*actors: Actor, **fields: Any) -> Storyboard:
    """A storyboard of road users around the ego.

    Args:
        actors: see :func:`actor`; and :func:`ego`, if the ego starts elsewhere than in the scene.
        fields: other fields of the storyboard, such as ``name`` and ``parameters``.

    Raises:
        ValueError: an invalid storyboard, such as two events with the same name.
    """
    if not any(a.entity.kind == "ego" for a in actors):
        actors = (ego(), *actors)
    names = Counter(e.name for a in actors for e in a.events)
    if twice := next((name for name, count in names.items() if count > 1), None):
        raise ValueError(f"{names[twice]} events have the name {twice!r}; give each its own")
    for test in (c.test for a in actors for e in a.events for c in _conditions(e)):
        if (
            isinstance(test, conditions.StoryboardElementState)
            and test.element_type == "event"
            and test.element.split("::")[-1] not in names
        ):
            raise ValueError(
                f"no event {test.element!r} to wait for; {advice(test.element, names)}"
            )
    groups = [
        ManeuverGroup(
            name=f"{a.entity.name}_group", entities=[a.entity.name],
            maneuvers=[Maneuver(name=f"{a.entity.name}_maneuver", events=list(a.events))],
        )
        for a in actors if a.events
    ]  # fmt: skip
    stories = [Story(name="story", acts=[Act(name="act", groups=groups)])] if groups else []
    init = [each for a in actors for each in a.init]
    fields = {"date": DATE, **fields}
    return Storyboard(entities=[a.entity for a in actors], init=init, stories=stories, **fields)


def _conditions(event: Event) -> list[Condition]:
    return [c for group in (event.start.groups if event.start else []) for c in group.conditions]


_ALLOWED: dict[str, tuple[tuple[type, ...], str]] = {
    "position": (get_args(get_args(Position)[0]), "in_lane(20.0)"),
    "condition": ((Condition, *get_args(get_args(Test)[0])), "at_time(2.0)"),
    "action": (get_args(get_args(AnyAction)[0]), "speed_to(0.0, rate=6.0)"),
    "event": ((Event,), 'event("stop", at_time(2.0), speed_to(0.0, rate=6.0))'),
}
"""Models of each part, and an example."""


def _checked(what: str, given: Any) -> Any:
    models, example = _ALLOWED[what]
    if isinstance(given, models):
        return given
    raise TypeError(f"not a valid {what}: {given!r}; give one such as {example}")


# --- Actors ---------------------------------------------------------------------------------------

BODIES: dict[str, tuple[str, float, tuple[float, float, float], float]] = {
    "car": ("car", 1500.0, (4.5, 1.85, 1.5), 1.35),
    "van": ("van", 2200.0, (5.4, 2.0, 2.3), 1.6),
    "motorcycle": ("motorcycle", 280.0, (2.1, 0.8, 1.6), 0.0),
    "adult": ("pedestrian", 75.0, (0.5, 0.6, 1.8), 0.0),
    "child": ("pedestrian", 75.0, (0.4, 0.5, 1.2), 0.0),
    "cyclist": ("cyclist", 90.0, (1.8, 0.6, 1.8), 0.0),
    "deer": ("animal", 60.0, (1.4, 0.5, 1.2), 0.0),
    "debris": ("obstacle", 20.0, (0.8, 0.8, 0.5), 0.0),
}
"""Category, mass [kg], length, width, height, and distance of the centre from the rear axle [m]."""


def actor(
    name: str, at: Position, speed: Value = 0.0, *events: Event, body: str = "car",
    hidden: bool = False, **fields: Any,
) -> Actor:  # fmt: skip
    """A road user.

    Args:
        name: unique name.
        at: where it starts, for example ``in_lane(20.0)``.
        speed: initial speed [m/s].
        events: see :func:`event`.
        body: one of ``BODIES``.
        hidden: whether it starts outside the world; :func:`appear` brings it in.
        fields: other fields of its ``Entity``, such as ``asset_id``, ``box`` or ``max_speed``.

    Raises:
        ValueError: no such body, or an invalid field.
    """
    if body not in BODIES:
        raise ValueError(f"actor {name!r}: no body {body!r}; {advice(body, BODIES)}")
    category, mass, size, axle = BODIES[body]
    box = BoundingBox(size=size, centre=(axle, 0.0, size[2] / 2))
    look = {"category": category, "box": box, "model": category, "mass": mass}
    entity = Entity.model_validate({**look, **fields, "name": name})
    for each in events:
        _checked("event", each)
    init: list[Any] = [teleport(at), speed_to(speed)]
    init += [vanish()] if hidden else []
    return Actor(entity, tuple(InitAction(entity=name, action=a) for a in init), events)


def ego(at: Position | None = None, speed: Value | None = None) -> Actor:
    """The ego; ``at`` is relative to its start in the scene. None keeps the place or the speed."""
    box = BoundingBox(size=(4.6, 1.85, 1.6), centre=(1.35, 0.0, 0.8))
    init: list[Any] = [] if at is None else [teleport(at)]
    init += [] if speed is None else [speed_to(speed)]
    entity = Entity(name="Ego", kind="ego", box=box, model="ego")
    return Actor(entity, tuple(InitAction(entity="Ego", action=a) for a in init))


# --- Positions ------------------------------------------------------------------------------------

# Relative to the ego: to its start for actors, and to where it is at that time in events.


def in_lane(
    ahead: Value, *, lane: int = 0, left: Value = 0.0, heading: Value | None = None
) -> actions.RelativeLanePosition:
    """A position in the ego's lane, or in one beside it.

    Args:
        ahead: along the road, from rear axle to rear axle [m]; negative is behind the ego.
        lane: number of lanes to the left of the ego's; negative is to the right.
        left: from the middle of that lane [m].
        heading: from the direction of the road [rad]; ``math.pi`` is oncoming, None is 0.
    """
    turned = None if heading is None else actions.Orientation(h=heading, relative=True)
    return actions.RelativeLanePosition(
        entity="Ego", along="road", lanes=lane, ds=ahead, offset=left, orientation=turned
    )


def beside(ahead: Value, left: Value, heading: Value = 0.0) -> actions.RelativeRoadPosition:
    """A position along the road and to the left of the ego [m], such as on a pavement.

    ``heading`` is relative to the road [rad]: ``math.pi / 2`` faces left.
    """
    turned = actions.Orientation(h=heading, relative=True)
    return actions.RelativeRoadPosition(entity="Ego", ds=ahead, dt=left, orientation=turned)


def from_entity(entity: str, ahead: Value, left: Value = 0.0) -> actions.RelativeObjectPosition:
    """A position along and to the left of an entity's own axes [m]."""
    return actions.RelativeObjectPosition(entity=entity, dx=ahead, dy=left)


# --- Events and what starts them ------------------------------------------------------------------


def event(
    name: str,
    start: Test | Condition | Trigger | Sequence[Test | Condition] | None,
    *actions: AnyAction,
    priority: Literal["override", "skip", "parallel"] = "override",
) -> Event:
    """Actions that start together, once.

    Args:
        name: unique name, for :func:`completed`.
        start: a condition, a list of those that must all hold, or a trigger; None: at once.
        actions: what the actor does.
        priority: ``override`` ends running events of the actor, ``parallel`` does not, and
            ``skip`` does not start while one runs.

    Raises:
        TypeError: anything but conditions and actions.
    """
    if not (start is None or isinstance(start, Trigger)):
        tests = start if isinstance(start, list | tuple) else [start]
        held = [
            t if isinstance(t, Condition) else Condition(name=t.kind, test=t)
            for t in (_checked("condition", t) for t in tests)
        ]
        start = Trigger(groups=[conditions.ConditionGroup(conditions=held)])
    done = [
        Action(name=f"{name}_{a.kind}", action=a) for a in (_checked("action", a) for a in actions)
    ]
    return Event(name=name, start=start, actions=done, priority=priority)


def at_time(seconds: Value) -> conditions.SimulationTime:
    """At a time since the start of the episode [s]."""
    return conditions.SimulationTime(rule="greater_or_equal", value=seconds)


_GAP: Any = {"measure": "longitudinal", "freespace": True, "rule": "less_or_equal"}


def gap_below(entity: str, metres: Value, *, of: str = "Ego") -> conditions.RelativeDistance:
    """Once the gap of ``of`` to an entity, bumper to bumper along the heading, is at most this [m].

    It does not matter whether the entity is ahead or behind, and in which lane.
    """
    return conditions.RelativeDistance(entities=[of], entity=entity, value=metres, **_GAP)


def time_gap_below(entity: str, seconds: Value, *, of: str = "Ego") -> conditions.TimeHeadway:
    """Once the gap to an entity, divided by the speed of ``of``, is at most this [s]."""
    return conditions.TimeHeadway(entities=[of], entity=entity, value=seconds, **_GAP)


def ttc_below(entity: str, seconds: Value, *, of: str = "Ego") -> conditions.TimeToCollision:
    """Once the gap to an entity, divided by its closing speed, is at most this [s]."""
    return conditions.TimeToCollision(entities=[of], entity=entity, value=seconds, **_GAP)


def reached(entity: str, at: Position, *, within: Value = 1.0) -> conditions.ReachPosition:
    """Once an entity is within a distance [m] of a position, such as one next to the ego."""
    return conditions.ReachPosition(entities=[entity], position=at, tolerance=within)


def driven(entity: str, metres: Value) -> conditions.TraversedDistance:
    """Once an entity is this far along its way from its start [m]."""
    return conditions.TraversedDistance(entities=[entity], value=metres)


def completed(event: str) -> conditions.StoryboardElementState:
    """Once an event has ended."""
    return conditions.StoryboardElementState(element_type="event", element=event, state="complete")


# --- Actions --------------------------------------------------------------------------------------


def speed_to(
    speed: Value, *, rate: Value | None = None, seconds: Value | None = None
) -> actions.SpeedAction:
    """Change to a speed [m/s] at a constant rate [m/s^2] or within a time [s]; neither: at once."""
    if rate is None and seconds is None:
        return actions.SpeedAction(speed=speed)
    return actions.SpeedAction(
        speed=speed, dynamics=_dynamics("linear", rate=rate, seconds=seconds)
    )


def change_lane(
    to: int, *, of: str = "Ego", seconds: Value | None = None, metres: Value | None = None
) -> actions.LaneChangeAction:
    """Change lanes smoothly (sinusoidal), within a time [s] or a distance [m]; neither: 3 s.

    ``to`` counts lanes to the left of the lane of ``of``: 0 is that lane, -1 the next on its right.
    """
    if seconds is None and metres is None:
        seconds = 3.0
    how = _dynamics("sinusoidal", seconds=seconds, metres=metres)
    return actions.LaneChangeAction(lane=to, relative_to=of, dynamics=how)


_DIMENSIONS = {"rate": "rate", "seconds": "time", "metres": "distance"}


def _dynamics(shape: str, **by: Value | None) -> actions.Dynamics:
    given = {name: value for name, value in by.items() if value is not None}
    if len(given) > 1:
        raise ValueError(
            f"a change got {' and '.join(f'{n}={v!r}' for n, v in given.items())}; give one of them"
        )
    [(name, value)] = given.items()
    fields = {"shape": shape, "dimension": _DIMENSIONS[name], "value": value}
    return actions.Dynamics.model_validate(fields)


def shift(left: Value, *, acceleration: Value = 0.8) -> actions.LaneOffsetAction:
    """Move to an offset from the middle of the lane [m], with a lateral acceleration [m/s^2]."""
    return actions.LaneOffsetAction(offset=left, shape="sinusoidal", acceleration=acceleration)


def follow(*path: Position, name: str = "path") -> actions.FollowTrajectoryAction:
    """Follow straight lines through positions, at its own speed."""
    if len(path) < 2:
        raise ValueError(f"follow got {len(path)} positions; give at least 2")
    curve = actions.Polyline(vertices=[actions.Vertex(position=each) for each in path])
    return actions.FollowTrajectoryAction(name=name, curve=curve)


def teleport(to: Position) -> actions.TeleportAction:
    """Move to a position at once."""
    return actions.TeleportAction(position=_checked("position", to))


def appear() -> actions.VisibilityAction:
    """Come into the world: visible, measured and collidable."""
    return actions.VisibilityAction(visible=True)


def vanish() -> actions.VisibilityAction:
    """Leave the world; :func:`appear` brings it back."""
    return actions.VisibilityAction(visible=False)
