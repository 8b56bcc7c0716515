"""A storyboard prepared for running: its elements as one list, its conditions numbered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from real2sim_proto.storyboard import Event, Storyboard
from real2sim_proto.storyboard_conditions import ElementType, Trigger


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
        stories: top elements.
        elements: all of them by number.
        stop: of the whole.
    """

    board: Storyboard
    stories: tuple[Element, ...]
    elements: tuple[Element, ...]
    stop: Start | None

    def named(self, type_: str, name: str) -> list[Element]:
        """Elements of a type with a name, or with names joined by '::' at the end of theirs."""
        wanted = tuple(name.split("::"))
        return [e for e in self.elements if e.type == type_ and e.path[-len(wanted) :] == wanted]


def program_of(board: Storyboard) -> Program:
    """The program of a storyboard whose parameters have their values."""
    maker = _Maker()
    stories = tuple(maker.story(story) for story in board.stories)
    elements = sorted((e for s in stories for e in s.within()), key=lambda e: e.number)
    return Program(board, stories, tuple(elements), maker.start(board.stop))


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

    def story(self, story: Any) -> Element:
        path = (story.name,)
        return self._made("story", path, story, [self._act(a, path) for a in story.acts])

    def _act(self, act: Any, above: tuple[str, ...]) -> Element:
        path = (*above, act.name)
        groups = [self._group(g, path) for g in act.groups]
        return self._made("act", path, act, groups, start=act.start, stop=act.stop)

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
        return self._made("event", path, event, actions, entities, start=event.start)

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
