"""Whether conditions of a storyboard hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from real2sim_proto.storyboard_conditions import (
    Acceleration,
    Angle,
    Collision,
    Condition,
    Distance,
    EndOfRoad,
    Offroad,
    ReachPosition,
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

from .view import (
    EntityState,
    Places,
    View,
    box_corners_of,
    closing_speed,
    corners,
    distance_to,
    overlapping,
)

EQUAL = 1e-6
"""Numbers that differ by less are equal."""

STANDING = 0.01
"""Speed of who stands [m/s]."""

INSTANT = 1e-9


class Memory(NamedTuple):
    """What a condition keeps from instant to instant.

    Attributes:
        before: outcome of its test at the last one; None: it is new.
        past: times at which what counts has changed, with what it became, as far back as its delay
            looks.
        since: of each entity, a figure of the test's own.
    """

    before: bool | None = None
    past: tuple[tuple[float, bool], ...] = ()
    since: Mapping[str, float] = {}


@dataclass(eq=False)
class Facts:
    """What conditions ask about, at one instant.

    Attributes:
        view: entities and roads.
        places: resolves positions.
        states: state of an element: (type, name, state) -> whether one is in it.
        variables: parameters and variables.
        signals: state of each traffic signal.
        phases: phase of each controller.
        memories: of conditions, by their number; written into.
    """

    view: View
    places: Places
    states: Callable[[str, str, str], bool]
    variables: Mapping[str, Any]
    signals: Mapping[str, str]
    phases: Mapping[str, str]
    memories: dict[int, Memory] = field(default_factory=dict)


def fires(trigger: Trigger, numbers: tuple[tuple[int, ...], ...], facts: Facts) -> bool:
    """Whether a trigger fires: all conditions of one of its groups. Each condition is looked at,
    so that none misses an edge."""
    outcomes = [
        [
            _counts(condition, number, facts)
            for condition, number in zip(group.conditions, row, strict=True)
        ]
        for group, row in zip(trigger.groups, numbers, strict=True)
    ]
    return any(all(group) for group in outcomes)


def _counts(condition: Condition, number: int, facts: Facts) -> bool:
    memory = facts.memories.get(number, Memory())
    test = condition.test
    now, since = _TESTS[type(test)](test, facts, memory.since)
    before = memory.before
    edge = {
        "none": now,
        "rising": before is False and now,
        "falling": before is True and not now,
        "rising_or_falling": before is not None and before != now,
    }[condition.edge]
    delay, past, elapsed = float(condition.delay), memory.past, facts.view.elapsed
    outcome = edge
    if delay > 0.0:
        past = (*past, (elapsed, edge)) if not past or past[-1][1] != edge else past
        old = [k for k, (t, _) in enumerate(past) if t <= elapsed - delay + INSTANT]
        outcome = bool(old) and past[old[-1]][1]
        past = past[old[-1] :] if old else past
    facts.memories[number] = Memory(now, past, since)
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
    test: Any, facts: Facts, since: Mapping[str, float], holds: Callable[[EntityState], bool]
) -> Outcome:
    outcomes = [holds(facts.view.entities[name]) for name in test.entities]
    return (any(outcomes) if test.of == "any" else all(outcomes)), since


def _lasting(
    test: Any, facts: Facts, since: Mapping[str, float], holds: Callable[[EntityState], bool]
) -> Outcome:
    """What has held for `duration`; ``since`` is when it began for each entity."""
    now, began, outcomes = facts.view.elapsed, dict(since), []
    for name in test.entities:
        if not holds(facts.view.entities[name]):
            began.pop(name, None)
            outcomes.append(False)
            continue
        start = began.setdefault(name, now)
        outcomes.append(now - start >= float(test.duration) - INSTANT)
    return (any(outcomes) if test.of == "any" else all(outcomes)), began


def _simulation_time(test: SimulationTime, facts: Facts, since: Mapping[str, float]) -> Outcome:
    return _compared(facts.view.elapsed, test.rule, float(test.value)), since


def _time_to_collision(test: TimeToCollision, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        if test.entity is not None:
            other: Any = facts.view.entities[test.entity]
        else:
            assert test.position is not None
            other = facts.places.of(test.position)
        distance = _distance(actor, other, test, facts)
        closing = closing_speed(actor, other, test.measure)
        time = distance / closing if closing > INSTANT else math.inf
        return _compared(time, test.rule, float(test.value))

    return _of_entities(test, facts, since, holds)


def _time_headway(test: TimeHeadway, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        distance = _distance(actor, facts.view.entities[test.entity], test, facts)
        time = distance / abs(actor.speed) if abs(actor.speed) > INSTANT else math.inf
        return _compared(time, test.rule, float(test.value))

    return _of_entities(test, facts, since, holds)


def _relative_distance(test: RelativeDistance, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        distance = _distance(actor, facts.view.entities[test.entity], test, facts)
        return _compared(distance, test.rule, float(test.value))

    return _of_entities(test, facts, since, holds)


def _to_place(test: Distance, facts: Facts, since: Mapping[str, float]) -> Outcome:
    place = facts.places.of(test.position)
    return _of_entities(
        test,
        facts,
        since,
        lambda a: _compared(_distance(a, place, test, facts), test.rule, float(test.value)),
    )


def _distance(actor: EntityState, other: Any, test: Any, facts: Facts) -> float:
    return distance_to(
        actor,
        other,
        test.measure,
        test.frame,
        freespace=test.freespace,
        network=facts.view.network,
    )


def _reach_position(test: ReachPosition, facts: Facts, since: Mapping[str, float]) -> Outcome:
    place = facts.places.of(test.position)
    return _of_entities(
        test,
        facts,
        since,
        lambda a: math.hypot(place.x - a.x, place.y - a.y) <= float(test.tolerance),
    )


def _speed(test: Speed, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def part(actor: EntityState) -> float:
        return actor.drift if test.direction == "lateral" else actor.speed

    def holds(actor: EntityState) -> bool:
        value = part(actor)
        if test.relative_to is not None:
            value -= part(facts.view.entities[test.relative_to])
        return _compared(value, test.rule, float(test.value))

    return _of_entities(test, facts, since, holds)


def _acceleration(test: Acceleration, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        value = actor.acceleration if test.direction is not None else abs(actor.acceleration)
        return _compared(value, test.rule, float(test.value))

    return _of_entities(test, facts, since, holds)


def _collision(test: Collision, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def holds(actor: EntityState) -> bool:
        if not actor.visible:
            return False
        own = corners(actor)
        if test.entity is not None:
            other = facts.view.entities[test.entity]
            return other.visible and overlapping(own, corners(other))
        return any(overlapping(own, box) for box in _others(actor, test.category, facts))

    return _of_entities(test, facts, since, holds)


def _others(
    actor: EntityState, category: str | None, facts: Facts
) -> list[list[tuple[float, float]]]:
    """Outlines of entities as they are now, and of all other objects at the start of the step."""
    entities = facts.view.entities
    found = [
        corners(other)
        for other in entities.values()
        if other is not actor
        and other.visible
        and (category is None or other.category == category)
        and _near(actor, other.x, other.y, other.size[0])
    ]
    known = {a.subject.object_id for a in entities.values() if a.subject is not None}
    around = facts.view.surroundings
    for row, subject in zip(around.bodies.tolist(), around.others.objects, strict=False):
        x, y, yaw, length, width, _, _ = row
        if subject.object_id in known or not _near(actor, x, y, length):
            continue
        if category is None or subject.category == category:
            found.append(box_corners_of(x, y, yaw, length, width))
    return found


def _near(actor: EntityState, x: float, y: float, length: float) -> bool:
    return math.hypot(x - actor.x, y - actor.y) < 2.0 * (actor.size[0] + length)


def _traversed(test: TraversedDistance, facts: Facts, since: Mapping[str, float]) -> Outcome:
    began, outcomes = dict(since), []
    for name in test.entities:
        travelled = facts.view.entities[name].travelled
        outcomes.append(travelled - began.setdefault(name, travelled) >= float(test.value))
    return (any(outcomes) if test.of == "any" else all(outcomes)), began


def _stand_still(test: StandStill, facts: Facts, since: Mapping[str, float]) -> Outcome:
    return _lasting(test, facts, since, lambda a: abs(a.speed) < STANDING)


def _offroad(test: Offroad, facts: Facts, since: Mapping[str, float]) -> Outcome:
    network = facts.view.network
    return _lasting(test, facts, since, lambda a: network.locate(a.x, a.y, a.h) is None)


def _end_of_road(test: EndOfRoad, facts: Facts, since: Mapping[str, float]) -> Outcome:
    def at_end(actor: EntityState) -> bool:
        way = actor.way if actor.way is not None else actor.on_lane(facts.view.network).way
        assert way is not None
        near = way.path.nearest(actor.x, actor.y).s
        return near >= way.length - STANDING

    return _lasting(test, facts, since, at_end)


def _angle(test: Angle, facts: Facts, since: Mapping[str, float]) -> Outcome:
    base = facts.places.origin[2]
    if test.entity is not None:
        base = facts.view.entities[test.entity].h

    def holds(actor: EntityState) -> bool:
        off = math.remainder(actor.h - base - float(test.angle), math.tau)
        return abs(off) <= float(test.tolerance)

    return _of_entities(test, facts, since, holds)


def _element_state(
    test: StoryboardElementState, facts: Facts, since: Mapping[str, float]
) -> Outcome:
    return facts.states(test.element_type, test.element, test.state), since


def _variable(test: VariableValue, facts: Facts, since: Mapping[str, float]) -> Outcome:
    if test.variable not in facts.variables:
        return False, since
    return _compared(facts.variables[test.variable], test.rule, test.value), since


def _signal_state(test: SignalState, facts: Facts, since: Mapping[str, float]) -> Outcome:
    return facts.signals.get(test.signal) == test.state, since


def _signal_phase(test: SignalPhase, facts: Facts, since: Mapping[str, float]) -> Outcome:
    return facts.phases.get(test.controller) == test.phase, since


_TESTS: Mapping[type[Any], Callable[[Any, Facts, Mapping[str, float]], Outcome]] = {
    SimulationTime: _simulation_time,
    TimeToCollision: _time_to_collision,
    TimeHeadway: _time_headway,
    RelativeDistance: _relative_distance,
    Distance: _to_place,
    ReachPosition: _reach_position,
    Speed: _speed,
    Acceleration: _acceleration,
    Collision: _collision,
    TraversedDistance: _traversed,
    StandStill: _stand_still,
    Offroad: _offroad,
    EndOfRoad: _end_of_road,
    Angle: _angle,
    StoryboardElementState: _element_state,
    VariableValue: _variable,
    SignalState: _signal_state,
    SignalPhase: _signal_phase,
}
