"""One step of a storyboard: elements start and stop, entities move."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from real2sim_proto.storyboard_actions import (
    AddEntityAction,
    CustomAction,
    DeleteEntityAction,
    SetVariableAction,
    SignalPhaseAction,
    SignalStateAction,
)

from ..common import copy_with
from ..traffic.driver import Surroundings
from .begin_actions import Beginning, begun
from .motion import advanced
from .program import (
    ConditionContext,
    ConditionState,
    Element,
    Program,
    Start,
    is_triggered,
    phase_start,
    shown_at,
)
from .roads import RoadNetwork
from .view import EntityState, PositionResolver, View

STANDBY, RUNNING, COMPLETE = 0, 1, 2
STATES = {"standby": STANDBY, "running": RUNNING, "complete": COMPLETE}

BEFORE_ALL, STORYBOARD = -2, -1
"""Numbers for the time before elements are evaluated, and for the storyboard's own trigger."""

GLOBAL = (
    AddEntityAction,
    DeleteEntityAction,
    SetVariableAction,
    SignalPhaseAction,
    SignalStateAction,
    CustomAction,
)


class ElementChange(NamedTuple):
    """An element that has started, ended, been stopped or been skipped.

    Attributes:
        t_us: time of the change [us].
        element: names from the story down, joined by '::'.
        type: type of the element.
        change: 'start', 'end', 'stop' or 'skip'.
    """

    t_us: int
    element: str
    type: str
    change: str


class ProgressState(NamedTuple):
    """State of a storyboard between steps, apart from its entities.

    Attributes:
        status: status of each element.
        times: number of starts of each event.
        running: tokens of running actions by element number and entity.
        conditions: state of each condition.
        variables: parameters and variables.
        signal_starts, signal_states: traffic signal settings made by actions.
        token: token of the next action.
        over: whether the storyboard has been stopped.
        fresh: transitions of the last instant, each with the number of the element whose trigger
            was being evaluated.
    """

    status: tuple[int, ...]
    times: tuple[int, ...]
    running: Mapping[int, Mapping[str, int]]
    conditions: Mapping[int, ConditionState]
    variables: Mapping[str, Any]
    signal_starts: Mapping[str, float]
    signal_states: Mapping[str, str]
    token: int
    over: bool
    fresh: Mapping[tuple[int, str], int]


class Progress:
    """One step of a storyboard; created for the step and read at its end.

    Args:
        program: the prepared storyboard.
        entities, state: before the step.
        network: road network.
        surroundings: surroundings of the step.
    """

    def __init__(
        self,
        program: Program,
        entities: Mapping[str, EntityState],
        state: ProgressState,
        network: RoadNetwork,
        surroundings: Surroundings,
    ) -> None:
        self._program, self._network, self._surroundings = program, network, surroundings
        self.entities = dict(entities)
        self._status, self._times = list(state.status), list(state.times)
        self._running = {k: dict(v) for k, v in state.running.items()}
        self._conditions = dict(state.conditions)
        self._variables = dict(state.variables)
        self._starts, self._states = dict(state.signal_starts), dict(state.signal_states)
        self._token, self._over = state.token, state.over
        self._before, self._fresh = state.fresh, dict[tuple[int, str], int]()
        self._evaluated = BEFORE_ALL
        self.changes: list[ElementChange] = []

    @property
    def state(self) -> ProgressState:
        """The state after the step so far."""
        return ProgressState(
            tuple(self._status),
            tuple(self._times),
            self._running,
            self._conditions,
            self._variables,
            self._starts,
            self._states,
            self._token,
            self._over,
            self._before,
        )

    def initialise(self, t_us: int, elapsed: float) -> None:
        """Execute the init actions."""
        for action in self._program.board.global_init:
            self._global(action, t_us, elapsed)
        for entry in self._program.init:
            self._begin_private(entry.entity, entry.action, elapsed)

    def pass_instant(self, t_us: int, elapsed: float, *, first: bool) -> None:
        """Start and end elements at an instant."""
        self._fresh, self._now, self._evaluated = {}, t_us, BEFORE_ALL
        self._end_actions()
        if not self._over:
            context = self._context(elapsed, first=first)
            self._context_now, self._elapsed = context, elapsed
            self._pass_whole()
        self._before = self._fresh

    def move(self, elapsed: float, h: float, *, first: bool) -> None:
        """Move all entities by ``h`` seconds, each based on the current poses of the others."""
        view = self._view(elapsed, first=first)
        self.entities = {name: advanced(a, view, h) for name, a in self.entities.items()}

    # --- elements -------------------------------------------------------------------------------

    def _pass_whole(self) -> None:
        if self._program.stop is not None and self._fires(self._program.stop, STORYBOARD):
            for story in self._program.stories:
                self._stop(story)
            self._over = True
            return
        for story in self._program.stories:
            if self._status[story.number] == STANDBY:
                self._change(story, RUNNING, "start")
            for act in story.children:
                self._pass_act(act)
            self._complete_with_children(story)

    def _pass_act(self, act: Element) -> None:
        if self._status[act.number] == STANDBY and (
            act.start is None or self._fires(act.start, act.number)
        ):
            for element in act.within():
                if element.type in {"act", "maneuver_group", "maneuver"}:
                    self._change(element, RUNNING, "start")
        if self._status[act.number] != RUNNING:
            return
        if act.stop is not None and self._fires(act.stop, act.number):
            self._stop(act)
            return
        for group in act.children:
            for maneuver in group.children:
                if self._status[maneuver.number] == RUNNING:
                    for event in maneuver.children:
                        self._pass_event(event, maneuver)
                    self._complete_with_children(maneuver)
            self._complete_group(group)
        self._complete_with_children(act)

    def _pass_event(self, event: Element, maneuver: Element) -> None:
        if self._status[event.number] == STANDBY and (
            event.start is None or self._fires(event.start, event.number)
        ):
            self._begin_event(event, maneuver)
        if self._status[event.number] == RUNNING:
            self._end_actions(event)

    def _begin_event(self, event: Element, maneuver: Element) -> None:
        others = [
            e for e in maneuver.children if e is not event and self._status[e.number] == RUNNING
        ]
        self._times[event.number] += 1
        if event.spec.priority == "skip" and others:
            self._fresh[event.number, "skip_transition"] = self._evaluated
            self._note(event, "skip")
            if self._times[event.number] >= event.spec.times:
                self._status[event.number] = COMPLETE
            return
        if event.spec.priority == "override":
            for other in others:
                self._stop(other, again=self._times[other.number] < other.spec.times)
        self._change(event, RUNNING, "start")
        for action in event.children:
            self._begin_action(action)

    def _begin_action(self, action: Element) -> None:
        self._change(action, RUNNING, "start")
        tokens = self._running[action.number] = {}
        if isinstance(action.spec, GLOBAL):
            self._global(action.spec, self._now, self._elapsed)
            return
        for name in action.entities:
            # The planner drives an ego that is not scripted; for it, the action ends at once.
            if self.entities[name].scripted:
                tokens[name] = self._token
                self._begin_private(name, action.spec, self._elapsed)

    def _end_actions(self, event: Element | None = None) -> None:
        """End actions that no longer move their entities, and the events of these actions."""
        events = [event] if event is not None else [
            e for e in self._program.elements if e.type == "event"
        ]  # fmt: skip
        for each in events:
            if self._status[each.number] != RUNNING:
                continue
            for action in each.children:
                if self._status[action.number] == RUNNING and not self._moves(action):
                    ended = all(
                        token in self.entities[name].finished
                        for name, token in self._running[action.number].items()
                    )
                    self._change(action, COMPLETE, "end" if ended else "stop")
            if all(self._status[a.number] == COMPLETE for a in each.children):
                again = self._times[each.number] < each.spec.times
                self._change(each, STANDBY if again else COMPLETE, "end")
                self._forget_conditions(each)

    def _moves(self, action: Element) -> bool:
        tokens = self._running.get(action.number, {})
        return any(token in self.entities[name].tokens() for name, token in tokens.items())

    def _complete_group(self, group: Element) -> None:
        if self._status[group.number] != RUNNING or any(
            self._status[m.number] != COMPLETE for m in group.children
        ):
            return
        self._times[group.number] += 1
        if self._times[group.number] >= group.spec.times:
            self._change(group, COMPLETE, "end")
            return
        for element in group.within():
            if element is not group:
                self._status[element.number] = RUNNING if element.type == "maneuver" else STANDBY
                self._times[element.number] = 0
                self._forget_conditions(element)

    def _forget_conditions(self, element: Element) -> None:
        """Reset the edges and delays of an element that may start again."""
        for row in element.start.numbers if element.start is not None else ():
            for number in row:
                self._conditions.pop(number, None)

    def _complete_with_children(self, element: Element) -> None:
        if self._status[element.number] == RUNNING and all(
            self._status[c.number] == COMPLETE for c in element.children
        ):
            self._change(element, COMPLETE, "end")

    def _stop(self, element: Element, *, again: bool = False) -> None:
        """Stop an element and all its descendants."""
        for each in element.within():
            tokens = set(self._running.pop(each.number, {}).values())
            if tokens:
                self.entities = {
                    k: _without(a, tokens, self._network) for k, a in self.entities.items()
                }
            if self._status[each.number] != COMPLETE:
                if self._status[each.number] == RUNNING:
                    self._fresh[each.number, "stop_transition"] = self._evaluated
                    self._note(each, "stop")
                self._status[each.number] = COMPLETE
        if again:
            self._status[element.number] = STANDBY
            self._forget_conditions(element)

    def _change(self, element: Element, status: int, change: str) -> None:
        self._status[element.number] = status
        self._fresh[element.number, f"{change}_transition"] = self._evaluated
        self._note(element, change)

    def _note(self, element: Element, change: str) -> None:
        self.changes.append(ElementChange(self._now, element.label, element.type, change))

    # --- actions --------------------------------------------------------------------------------

    def _begin_private(self, name: str, action: Any, elapsed: float) -> None:
        actor = self.entities[name]
        view = self._view(elapsed, first=True)
        at = Beginning(view, self._places(), self._token)
        self._token += 1
        self.entities[name] = begun(actor, action, at)

    def _global(self, action: Any, t_us: int, elapsed: float) -> None:
        if isinstance(action, AddEntityAction):
            actor = self.entities[action.entity]
            if not actor.present:
                put = actor.put(self._places().of(action.position), self._network)
                self.entities[action.entity] = copy_with(put, present=True, visible=True)
        elif isinstance(action, DeleteEntityAction):
            actor = self.entities[action.entity]
            self.entities[action.entity] = copy_with(actor, present=False, visible=False)
        elif isinstance(action, SignalStateAction):
            self._states[action.signal] = action.state
        elif isinstance(action, SignalPhaseAction):
            known = {c.name: c for c in self._program.board.controllers}
            controller = known[action.controller]
            self._starts[action.controller] = phase_start(controller, action.phase, elapsed)
        elif isinstance(action, SetVariableAction):
            self._set_variable(action)

    def _set_variable(self, action: SetVariableAction) -> None:
        now, value = self._variables.get(action.variable), action.value
        if action.rule == "set":
            self._variables[action.variable] = value
        elif isinstance(now, int | float) and isinstance(value, int | float):
            self._variables[action.variable] = now + value if action.rule == "add" else now * value

    # --- context ----------------------------------------------------------------------------------

    def _fires(self, start: Start, number: int) -> bool:
        self._evaluated = number
        return is_triggered(start.trigger, start.numbers, self._context_now)

    def _context(self, elapsed: float, *, first: bool) -> ConditionContext:
        signals, phases = shown_at(self._program.board, elapsed, self._starts, self._states)
        return ConditionContext(
            view=self._view(elapsed, first=first),
            places=self._places(),
            states=self._is_in,
            variables=self._variables,
            signals=signals,
            phases=phases,
            condition_states=self._conditions,
        )

    def _is_in(self, type_: str, name: str, state: str) -> bool:
        elements = self._program.named(type_, name)
        if state in STATES:
            return any(self._status[e.number] == STATES[state] for e in elements)
        # Each condition sees a transition once: at this instant if it is evaluated after it, else
        # at the next one.
        keys = [(e.number, state) for e in elements]
        return any(
            key in self._fresh or self._before.get(key, BEFORE_ALL) >= self._evaluated
            for key in keys
        )

    def _view(self, elapsed: float, *, first: bool) -> View:
        return View(elapsed, first, self.entities, self._network, self._surroundings)

    def _places(self) -> PositionResolver:
        return PositionResolver(self.entities, self._network, self._program.board.origin)


def _without(actor: EntityState, tokens: set[int], network: RoadNetwork) -> EntityState:
    """The entity without the given actions; it keeps its speed and continues from its position."""
    changes: dict[str, Any] = {}
    if actor.longitudinal is not None and actor.longitudinal.token in tokens:
        changes["longitudinal"] = None
    if actor.lateral is not None and actor.lateral.token in tokens:
        changes |= {"lateral": None, "drift": 0.0}
    if changes:
        actor = copy_with(actor, **changes)
    if actor.trajectory is not None and actor.trajectory.token in tokens:
        actor = copy_with(actor, trajectory=None).on_lane(network)
    return actor
