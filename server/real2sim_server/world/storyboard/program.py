"""Preparation of a storyboard: a flat list of elements and numbered conditions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import (
    Event,
    InitAction,
    SignalController,
    Storyboard,
    entity_references,
)
from real2sim_proto.storyboard_conditions import (
    Acceleration,
    Angle,
    Collision,
    Condition,
    Distance,
    ElementType,
    EndOfRoad,
    Offroad,
    ReachPosition,
    RelativeClearance,
    RelativeDistance,
    Rule,
    SignalPhase,
    SignalState,
    SimulationTime,
    Speed,
    StandStill,
    StoryboardElementState,
    TimeHeadway,
    TimeToCollision,
    TraversedDistance,
    Trigger,
    VariableValue,
)

from ..common import WorldError
from .roads import lanes_between
from .view import (
    EntityState,
    PositionResolver,
    View,
    across,
    along,
    box_corners_of,
    closing_speed,
    corners,
    distance_to,
    overlapping,
)


@dataclass(frozen=True, eq=False)
class Start:
    """A trigger with the numbers of its conditions."""

    trigger: Trigger
    numbers: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, eq=False)
class Element:
    """One element of the stories.

    Attributes:
        number: index in the list of elements.
        type: element type.
        path: names from the story down to this element.
        spec: its wire model.
        children: child elements.
        entities: actors of its actions.
        start, stop: triggers, or None.
    """

    number: int
    type: ElementType
    path: tuple[str, ...]
    spec: Any
    children: tuple[Element, ...]
    entities: tuple[str, ...]
    start: Start | None = None
    stop: Start | None = None

    @property
    def label(self) -> str:
        """The joined names of the path."""
        return "::".join(self.path)

    def within(self) -> Iterator[Element]:
        """The element, then all its descendants."""
        yield self
        for child in self.children:
            yield from child.within()


@dataclass(frozen=True, eq=False)
class Program:
    """A storyboard prepared for running.

    Attributes:
        board: storyboard with parameter values filled in.
        init: init actions, in order of execution.
        stories: top elements.
        elements: all elements by number.
        stop: stop trigger of the storyboard.
    """

    board: Storyboard
    init: tuple[InitAction, ...]
    stories: tuple[Element, ...]
    elements: tuple[Element, ...]
    stop: Start | None

    def named(self, type_: str, name: str) -> list[Element]:
        """Elements of a type with a name; names joined by '::' match the end of their paths."""
        wanted = tuple(name.split("::"))
        return [e for e in self.elements if e.type == type_ and e.path[-len(wanted) :] == wanted]


def program_of(board: Storyboard) -> Program:
    """The program of a storyboard with resolved parameters.

    Raises:
        WorldError: INVALID_REQUEST if entities are placed relative to each other in a cycle.
    """
    maker = _Maker()
    stories = tuple(maker.story(story) for story in board.stories)
    elements = sorted((e for s in stories for e in s.within()), key=lambda e: e.number)
    return Program(board, _in_order(board.init), stories, tuple(elements), maker.start(board.stop))


PLACING = frozenset({"teleport", "follow_trajectory"})
"""Kinds of actions that set the position of an entity."""

_SPEEDING = frozenset({"speed", "speed_profile"})


def _in_order(entries: Sequence[InitAction]) -> tuple[InitAction, ...]:
    """Init actions in the order of the file, but after their dependencies.

    A position relative to an entity comes after the position of that entity, and a relative speed
    after the speed that it refers to, unless speeds refer to each other.
    """
    waiting, done = list(entries), list[InitAction]()
    while waiting:
        ready = next((e for k, e in enumerate(waiting) if _is_ready(e, waiting, k)), None)
        if ready is None:
            # Keeping a distance does not depend on the speed of the other entity, and speeds that
            # refer to each other take effect in the order of the file.
            firsts = {e.entity: e for e in reversed(waiting)}.values()
            later = [e for e in waiting if e in firsts and e.action.kind not in PLACING]
            ready = min(later, key=lambda e: e.action.kind in _SPEEDING, default=None)
        if ready is None:
            names = " and ".join(repr(e) for e in dict.fromkeys(e.entity for e in waiting))
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"{names} have initial positions relative to each other",
                hint="give one of them an absolute position in the storyboard's init",
            )
        waiting.remove(ready)
        done.append(ready)
    return tuple(done)


def _is_ready(entry: InitAction, waiting: Sequence[InitAction], k: int) -> bool:
    if any(earlier.entity == entry.entity for earlier in waiting[:k]):
        return False
    kinds = _SPEEDING if entry.action.kind in _SPEEDING else PLACING
    others = set(entity_references(entry.action)) - {entry.entity}
    return not any(w.entity in others and w.action.kind in kinds for w in waiting)


class _Maker:
    def __init__(self) -> None:
        self._elements, self._conditions = 0, 0

    def start(self, trigger: Trigger | None) -> Start | None:
        if trigger is None:
            return None
        numbers = []
        for group in trigger.groups:
            first = self._conditions
            self._conditions += len(group.conditions)
            numbers.append(tuple(range(first, self._conditions)))
        return Start(trigger, tuple(numbers))

    def _begin(self, trigger: Trigger | None) -> Trigger | None:
        """The start trigger; without conditions, its element starts with its parent."""
        return trigger if trigger is not None and trigger.groups else None

    def story(self, story: Any) -> Element:
        path = (story.name,)
        return self._made("story", path, story, [self._act(a, path) for a in story.acts])

    def _act(self, act: Any, above: tuple[str, ...]) -> Element:
        path = (*above, act.name)
        groups = [self._group(g, path) for g in act.groups]
        start = self._begin(act.start)
        return self._made("act", path, act, groups, start=start, stop=act.stop)

    def _group(self, group: Any, above: tuple[str, ...]) -> Element:
        path, entities = (*above, group.name), tuple(group.entities)
        made = [self._maneuver(m, path, entities) for m in group.maneuvers]
        return self._made("maneuver_group", path, group, made, entities)

    def _maneuver(
        self, maneuver: Any, above: tuple[str, ...], entities: tuple[str, ...]
    ) -> Element:
        path = (*above, maneuver.name)
        events = [self._event(e, path, entities) for e in maneuver.events]
        return self._made("maneuver", path, maneuver, events, entities)

    def _event(self, event: Event, above: tuple[str, ...], entities: tuple[str, ...]) -> Element:
        path = (*above, event.name)
        actions = [
            self._made("action", (*path, a.name), a.action, (), entities) for a in event.actions
        ]
        start = self._begin(event.start)
        return self._made("event", path, event, actions, entities, start=start)

    def _made(
        self,
        type_: ElementType,
        path: tuple[str, ...],
        spec: Any,
        children: Sequence[Element],
        entities: tuple[str, ...] = (),
        *,
        start: Trigger | None = None,
        stop: Trigger | None = None,
    ) -> Element:
        self._elements += 1
        return Element(
            self._elements - 1, type_, path, spec, tuple(children), entities,
            self.start(start), self.start(stop),
        )  # fmt: skip


def shown_at(
    board: Storyboard,
    elapsed: float,
    starts: Mapping[str, float],
    overrides: Mapping[str, str],
) -> tuple[dict[str, str], dict[str, str]]:
    """State of each signal, and phase of each controller.

    Args:
        board: storyboard with signals and controllers.
        elapsed: time since the start of the episode [s].
        starts: cycle start times of controllers set by actions [s].
        overrides: signal states set by actions.
    """
    states = {head.signal_id: head.state for head in board.signals}
    phases = {}
    known = {c.name: c for c in board.controllers}
    for controller in board.controllers:
        start = starts.get(controller.name)
        since = elapsed - (_delay(controller, known) if start is None else start)
        if since < -1e-9:
            continue
        phase = controller.phases[_phase_at(controller, since)]
        phases[controller.name] = phase.name
        states |= phase.states
    return states | dict(overrides), phases


def phase_start(controller: SignalController, phase: str, elapsed: float) -> float:
    """Cycle start time of a controller that enters a phase now [s]."""
    before = 0.0
    for each in controller.phases:
        if each.name == phase:
            break
        before += float(each.duration)
    return elapsed - before


def _delay(controller: SignalController, known: Mapping[str, SignalController]) -> float:
    delay, seen = float(controller.delay), {controller.name}
    while controller.reference is not None and controller.reference in known:
        controller = known[controller.reference]
        if controller.name in seen:
            break
        seen.add(controller.name)
        delay += float(controller.delay)
    return delay


def _phase_at(controller: SignalController, since: float) -> int:
    lengths = [float(p.duration) for p in controller.phases]
    cycle = sum(lengths)
    left = math.fmod(max(since, 0.0) + 1e-9, cycle) if cycle > 0 and math.isfinite(cycle) else since
    for number, length in enumerate(lengths):
        if left < length:
            return number
        left -= length
    return len(lengths) - 1


class ShownSignal(NamedTuple):
    """A traffic signal at one instant.

    Attributes:
        signal_id: id of the signal.
        state: current state.
        stop_line: x, y [m], heading [rad] of the stop line, world frame; None if unknown.
    """

    signal_id: str
    state: str
    stop_line: tuple[float, float, float] | None


# --- Conditions ----------------------------------------------------------------------------------

EQUAL = 1e-6
"""Tolerance for equal numbers."""

STANDING = 0.01
"""Maximum speed at standstill [m/s]."""

INSTANT = 1e-9


class ConditionState(NamedTuple):
    """State of a condition between instants.

    Attributes:
        before: result of its test at the previous instant; None for a new condition.
        past: times of result changes and the new results, as far back as its delay.
        since: test-specific number of each entity.
    """

    before: bool | None = None
    past: tuple[tuple[float, bool], ...] = ()
    since: Mapping[str, float] = {}


@dataclass(eq=False)
class ConditionContext:
    """Inputs of conditions at one instant.

    Attributes:
        view: entities and roads.
        places: resolves positions.
        states: ``states(type, name, state)``, whether any such element is in that state.
        variables: parameters and variables.
        signals: state of each traffic signal.
        phases: phase of each controller.
        condition_states: states of the conditions by number; updated.
    """

    view: View
    places: PositionResolver
    states: Callable[[str, str, str], bool]
    variables: Mapping[str, Any]
    signals: Mapping[str, str]
    phases: Mapping[str, str]
    condition_states: dict[int, ConditionState] = field(default_factory=dict)


def is_triggered(
    trigger: Trigger, numbers: tuple[tuple[int, ...], ...], context: ConditionContext
) -> bool:
    """Whether a trigger fires: all conditions of any of its groups hold.

    Evaluates every condition, so that no edge is missed.
    """
    outcomes = [
        [
            _counts(condition, number, context)
            for condition, number in zip(group.conditions, row, strict=True)
        ]
        for group, row in zip(trigger.groups, numbers, strict=True)
    ]
    return any(all(group) for group in outcomes)


def _counts(condition: Condition, number: int, context: ConditionContext) -> bool:
    previous = context.condition_states.get(number, ConditionState())
    test = condition.test
    now, since = _TESTS[type(test)](test, context, previous.since)
    before = previous.before
    edge = {
        "none": now,
        "rising": before is False and now,
        "falling": before is True and not now,
        "rising_or_falling": before is not None and before != now,
    }[condition.edge]
    delay, past, elapsed = float(condition.delay), previous.past, context.view.elapsed
    outcome = edge
    if delay > 0.0:
        past = (*past, (elapsed, edge)) if not past or past[-1][1] != edge else past
        old = [k for k, (t, _) in enumerate(past) if t <= elapsed - delay + INSTANT]
        outcome = bool(old) and past[old[-1]][1]
        past = past[old[-1] :] if old else past
    context.condition_states[number] = ConditionState(now, past, since)
    return bool(outcome)


def _compared(value: Any, rule: Rule, other: Any) -> bool:
    if isinstance(value, float | int) and isinstance(other, float | int):
        same = abs(float(value) - float(other)) <= EQUAL
        value, other = float(value), float(other)
    else:
        same, value, other = str(value) == str(other), str(value), str(other)
    if rule == "equal_to":
        return same
    if rule == "not_equal_to":
        return not same
    if rule == "greater_than":
        return bool(value > other)
    if rule == "less_than":
        return bool(value < other)
    return same or bool(value > other if rule == "greater_or_equal" else value < other)


Outcome = tuple[bool, Mapping[str, float]]


def _of_entities(
    test: Any,
    context: ConditionContext,
    since: Mapping[str, float],
    holds: Callable[[EntityState], bool],
) -> Outcome:
    outcomes = [holds(context.view.entities[name]) for name in test.entities]
    return (any(outcomes) if test.of == "any" else all(outcomes)), since


def _lasting(
    test: Any,
    context: ConditionContext,
    since: Mapping[str, float],
    holds: Callable[[EntityState], bool],
) -> Outcome:
    """Whether a test has held for ``duration``; ``since`` is its start for each entity."""
    now, began, outcomes = context.view.elapsed, dict(since), []
    for name in test.entities:
        if not holds(context.view.entities[name]):
            began.pop(name, None)
            outcomes.append(False)
            continue
        start = began.setdefault(name, now)
        outcomes.append(now - start >= float(test.duration) - INSTANT)
    return (any(outcomes) if test.of == "any" else all(outcomes)), began


def _simulation_time(
    test: SimulationTime, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    return _compared(context.view.elapsed, test.rule, float(test.value)), since


def _time_to_collision(
    test: TimeToCollision, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    def holds(actor: EntityState) -> bool:
        if test.entity is not None:
            other: Any = context.view.entities[test.entity]
        else:
            assert test.position is not None
            other = context.places.of(test.position)
        distance = _distance(actor, other, test, context)
        closing = closing_speed(actor, other, test.measure)
        time = distance / closing if closing > INSTANT else math.inf
        return _compared(time, test.rule, float(test.value))

    return _of_entities(test, context, since, holds)


def _time_headway(
    test: TimeHeadway, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    def holds(actor: EntityState) -> bool:
        distance = _distance(actor, context.view.entities[test.entity], test, context)
        time = distance / abs(actor.speed) if abs(actor.speed) > INSTANT else math.inf
        return _compared(time, test.rule, float(test.value))

    return _of_entities(test, context, since, holds)


def _relative_distance(
    test: RelativeDistance, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    def holds(actor: EntityState) -> bool:
        distance = _distance(actor, context.view.entities[test.entity], test, context)
        return _compared(distance, test.rule, float(test.value))

    return _of_entities(test, context, since, holds)


MAX_LANES = 20
"""Maximum number of lanes to either side of an entity that a clearance condition checks."""


def _clearance(
    test: RelativeClearance, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    view = context.view

    def counts(lanes: int) -> bool:
        return not test.lanes or any(low <= lanes <= high for low, high in test.lanes)

    def exists(actor: EntityState) -> bool:
        """Whether one of the lanes exists in a permitted direction."""
        here = view.network.locate(actor.x, actor.y, actor.h)
        if here is None:
            return False
        sense = 1 if math.cos(actor.h - here.h) >= 0.0 else -1
        for lanes in filter(counts, range(-MAX_LANES, MAX_LANES + 1)):
            try:
                lane = view.network.neighbour(here.road, here.lane, here.s, sense * lanes)
            except WorldError:
                continue
            if test.opposite or (lane < 0) == (here.lane < 0):
                return True
        return False

    def near(actor: EntityState, other: EntityState) -> bool:
        apart = _apart_on_road(actor, other, view)
        if apart is None or not counts(apart[0]):
            return False
        ahead = apart[1]
        if not test.opposite and math.cos(actor.h - other.h) < 0.0:
            return False
        front = back = 0.0
        if test.freespace:
            front = (actor.size[0] + other.size[0]) / 2 + actor.centre[0] - other.centre[0]
            back = actor.size[0] + other.size[0] - front
        return -float(test.behind) - back < ahead < float(test.ahead) + front

    def holds(actor: EntityState) -> bool:
        names = test.others or [name for name in view.entities if name != actor.name]
        others = (view.entities[name] for name in names)
        return exists(actor) and not any(o.visible and near(actor, o) for o in others)

    return _of_entities(test, context, since, holds)


def _apart_on_road(actor: EntityState, other: EntityState, view: View) -> tuple[int, float] | None:
    """Number of lanes to the left of an entity, and distance ahead [m], of another one.

    None if the road does not lead from one to the other.
    """
    network = view.network
    here = network.locate(actor.x, actor.y, actor.h)
    there = network.locate(other.x, other.y, other.h)
    ahead = along(actor.h, other.x - actor.x, other.y - actor.y)
    if here is None or there is None:
        return None
    sense = 1.0 if math.cos(actor.h - here.h) >= 0.0 else -1.0
    if here.road == there.road:
        return int(sense) * lanes_between(here.lane, there.lane), sense * (there.s - here.s)
    road, lane, s, onward = network.onward(here.road, here.lane, here.s, sense * ahead)
    if road != there.road:
        return None
    sense *= onward
    return int(sense) * lanes_between(lane, there.lane), ahead + sense * (there.s - s)


def _to_place(test: Distance, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    place = context.places.of(test.position)
    return _of_entities(
        test,
        context,
        since,
        lambda a: _compared(_distance(a, place, test, context), test.rule, float(test.value)),
    )


def _distance(actor: EntityState, other: Any, test: Any, context: ConditionContext) -> float:
    return distance_to(
        actor,
        other,
        test.measure,
        test.frame,
        freespace=test.freespace,
        network=context.view.network,
    )


def _reach_position(
    test: ReachPosition, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    place = context.places.of(test.position)
    return _of_entities(
        test,
        context,
        since,
        lambda a: math.hypot(place.x - a.x, place.y - a.y) <= float(test.tolerance),
    )


def _speed(test: Speed, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    other = None if test.relative_to is None else context.view.entities[test.relative_to]

    def holds(actor: EntityState) -> bool:
        if test.direction is None:
            value = actor.speed - (0.0 if other is None else other.speed)
        elif other is None:
            value = actor.drift if test.direction == "lateral" else actor.speed
        else:
            # Relative velocity, projected to the axes of the triggering entity.
            (vx, vy), (ux, uy) = actor.velocity, other.velocity
            component = across if test.direction == "lateral" else along
            value = component(actor.h, vx - ux, vy - uy)
        return _compared(value, test.rule, float(test.value))

    return _of_entities(test, context, since, holds)


def _acceleration(
    test: Acceleration, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    def holds(actor: EntityState) -> bool:
        value = actor.acceleration if test.direction is not None else abs(actor.acceleration)
        return _compared(value, test.rule, float(test.value))

    return _of_entities(test, context, since, holds)


def _collision(test: Collision, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        if not actor.visible:
            return False
        own = corners(actor)
        if test.entity is not None:
            other = context.view.entities[test.entity]
            return other.visible and overlapping(own, corners(other))
        return any(overlapping(own, box) for box in _others(actor, test.category, context))

    return _of_entities(test, context, since, holds)


def _others(
    actor: EntityState, category: str | None, context: ConditionContext
) -> list[list[tuple[float, float]]]:
    """Current outlines of entities, and outlines of all other objects at the start of the step."""
    entities = context.view.entities
    found = [
        corners(other)
        for other in entities.values()
        if other is not actor
        and other.visible
        and _is_of(other.category, category)
        and _near(actor, other.x, other.y, other.size[0])
    ]
    known = {a.subject.object_id for a in entities.values() if a.subject is not None}
    around = context.view.surroundings
    for row, subject in zip(around.bodies.tolist(), around.others.objects, strict=False):
        x, y, yaw, length, width, _, _ = row
        if subject.object_id in known or not _near(actor, x, y, length):
            continue
        if _is_of(subject.category, category):
            found.append(box_corners_of(x, y, yaw, length, width))
    return found


VEHICLE_CATEGORIES = frozenset({"car", "van", "truck", "bus", "motorcycle", "cyclist"})


def _is_of(category: str, wanted: str | None) -> bool:
    """Whether a category is the wanted one; ``vehicle`` means all vehicles, None anything."""
    if wanted == "vehicle":
        return category in VEHICLE_CATEGORIES
    return wanted is None or category == wanted


def _near(actor: EntityState, x: float, y: float, length: float) -> bool:
    return math.hypot(x - actor.x, y - actor.y) < 2.0 * (actor.size[0] + length)


def _traversed(
    test: TraversedDistance, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    began, outcomes = dict(since), []
    for name in test.entities:
        travelled = context.view.entities[name].travelled
        outcomes.append(travelled - began.setdefault(name, travelled) >= float(test.value))
    return (any(outcomes) if test.of == "any" else all(outcomes)), began


def _standstill(test: StandStill, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    return _lasting(test, context, since, lambda a: abs(a.speed) < STANDING)


def _offroad(test: Offroad, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    network = context.view.network
    return _lasting(test, context, since, lambda a: not network.is_drivable(a.x, a.y))


def _end_of_road(test: EndOfRoad, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    def at_end(actor: EntityState) -> bool:
        way = actor.way if actor.way is not None else actor.on_lane(context.view.network).way
        assert way is not None
        near = way.path.nearest(actor.x, actor.y).s
        return near >= way.length - STANDING

    return _lasting(test, context, since, at_end)


def _angle(test: Angle, context: ConditionContext, since: Mapping[str, float]) -> Outcome:
    base = context.places.origin[2]
    if test.entity is not None:
        base = context.view.entities[test.entity].h

    def holds(actor: EntityState) -> bool:
        off = math.remainder(actor.h - base - float(test.angle), math.tau)
        return abs(off) <= float(test.tolerance)

    return _of_entities(test, context, since, holds)


def _element_state(
    test: StoryboardElementState, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    return context.states(test.element_type, test.element, test.state), since


def _variable(
    test: VariableValue, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    if test.variable not in context.variables:
        return False, since
    return _compared(context.variables[test.variable], test.rule, test.value), since


def _signal_state(
    test: SignalState, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    return context.signals.get(test.signal) == test.state, since


def _signal_phase(
    test: SignalPhase, context: ConditionContext, since: Mapping[str, float]
) -> Outcome:
    return context.phases.get(test.controller) == test.phase, since


_TESTS: Mapping[type[Any], Callable[[Any, ConditionContext, Mapping[str, float]], Outcome]] = {
    SimulationTime: _simulation_time,
    TimeToCollision: _time_to_collision,
    TimeHeadway: _time_headway,
    RelativeDistance: _relative_distance,
    RelativeClearance: _clearance,
    Distance: _to_place,
    ReachPosition: _reach_position,
    Speed: _speed,
    Acceleration: _acceleration,
    Collision: _collision,
    TraversedDistance: _traversed,
    StandStill: _standstill,
    Offroad: _offroad,
    EndOfRoad: _end_of_road,
    Angle: _angle,
    StoryboardElementState: _element_state,
    VariableValue: _variable,
    SignalState: _signal_state,
    SignalPhase: _signal_phase,
}
