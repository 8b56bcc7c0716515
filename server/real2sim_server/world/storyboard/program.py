"""A storyboard prepared for running: its elements as one list, its conditions numbered."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import (
    Event,
    InitAction,
    SignalController,
    Storyboard,
    entity_references,
)
from real2sim_proto.storyboard_conditions import ElementType, Trigger

from ..common import WorldError


@dataclass(frozen=True, eq=False)
class Start:
    """A trigger with the numbers of its conditions."""

    trigger: Trigger
    numbers: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, eq=False)
class Element:
    """One element of the stories.

    Attributes:
        number: its place in the list.
        type: what it is.
        path: names from the story down to its own.
        spec: its model.
        children: what it is made of.
        entities: whom its actions are of.
        start, stop: triggers; None: it has none.
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
        """Its names joined."""
        return "::".join(self.path)

    def within(self) -> Iterator[Element]:
        """Itself, then all that it is made of."""
        yield self
        for child in self.children:
            yield from child.within()


@dataclass(frozen=True, eq=False)
class Program:
    """What runs.

    Attributes:
        board: with the values of its parameters.
        init: what holds when the episode begins, in the order in which it is done.
        stories: top elements.
        elements: all of them by number.
        stop: of the whole.
    """

    board: Storyboard
    init: tuple[InitAction, ...]
    stories: tuple[Element, ...]
    elements: tuple[Element, ...]
    stop: Start | None

    def named(self, type_: str, name: str) -> list[Element]:
        """Elements of a type with a name, or with names joined by '::' at the end of theirs."""
        wanted = tuple(name.split("::"))
        return [e for e in self.elements if e.type == type_ and e.path[-len(wanted) :] == wanted]


def program_of(board: Storyboard) -> Program:
    """The program of a storyboard whose parameters have their values.

    Raises:
        WorldError: INVALID_REQUEST, entities are placed relative to each other.
    """
    maker = _Maker(board.version)
    stories = tuple(maker.story(story) for story in board.stories)
    elements = sorted((e for s in stories for e in s.within()), key=lambda e: e.number)
    init = tuple(board.init) if board.version < 2 else _in_order(board.init)
    return Program(board, init, stories, tuple(elements), maker.start(board.stop))


PLACING = frozenset({"teleport", "follow_trajectory"})
"""Kinds of actions that put an entity somewhere."""

_SPEEDING = frozenset({"speed", "speed_profile"})


def _in_order(entries: Sequence[InitAction]) -> tuple[InitAction, ...]:
    """In the order of the file, but after what they refer to: a place relative to an entity comes
    after that entity's place, a speed relative to another's after that speed."""
    waiting, done = list(entries), list[InitAction]()
    while waiting:
        ready = next((e for k, e in enumerate(waiting) if _is_ready(e, waiting, k)), None)
        if ready is None:
            # Who keeps a distance to somebody need not wait for them.
            ready = next((e for e in waiting if e.action.kind not in PLACING | _SPEEDING), None)
        if ready is None:
            names = " and ".join(repr(e) for e in dict.fromkeys(e.entity for e in waiting))
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"{names} are placed relative to each other at the start",
                hint="give one of them a place or speed of its own in the storyboard's init",
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
    def __init__(self, version: int) -> None:
        self._elements, self._conditions = 0, 0
        self._version = version

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
        """A start trigger without conditions lets its element begin with its parent."""
        asked = trigger is not None and (trigger.groups or self._version < 2)
        return trigger if asked else None

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
        board: has them.
        elapsed: since the episode began [s].
        starts: when the cycle of a controller began that an action has set [s].
        overrides: states that actions have set.
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
    """When the cycle would have begun of a controller that begins a phase now [s]."""
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
        signal_id: of it.
        state: what it shows.
        stop_line: x, y [m], heading [rad] where vehicles are to stop, world; None: not known.
    """

    signal_id: str
    state: str
    stop_line: tuple[float, float, float] | None
