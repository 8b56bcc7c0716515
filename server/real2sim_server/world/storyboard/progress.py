"""One step of a storyboard: elements start and stop, actions begin, entities move."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from real2sim_proto import ErrorCode
from real2sim_proto.episode import IdmDriver
from real2sim_proto.storyboard_actions import (
    AcquirePositionAction,
    AddEntityAction,
    AssignRouteAction,
    ControllerAction,
    DeleteEntityAction,
    Dynamics,
    FollowTrajectoryAction,
    LaneChangeAction,
    LaneOffsetAction,
    LateralDistanceAction,
    LongitudinalDistanceAction,
    SetVariableAction,
    SignalPhaseAction,
    SignalStateAction,
    SpeedAction,
    SpeedProfileAction,
    SynchronizeAction,
    TeleportAction,
    VisibilityAction,
)

from ..common import WorldError, copy_with
from ..path import LoggedPath
from ..traffic.driver import Surroundings
from .motion import (
    FollowIdm,
    FollowOffset,
    FollowSpeed,
    HoldOffset,
    KeepAside,
    KeepDistance,
    OffsetChange,
    SpeedChange,
    SpeedCourse,
    Synchronize,
    advanced,
    duration,
    gentle_duration,
    lane_offset,
)
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
from .roads import Place, RoadNetwork, RoadPoint, Trajectory, Way, course_of, path_through
from .view import ACROSS, EntityState, PositionResolver, View, across, ahead_on_way

# --- Private actions -----------------------------------------------------------------------------

# Each action gives its entity the controller that moves it from now on.

BESIDE_ROUTE = 10.0
"""An entity teleported within this distance of its assigned route keeps the route [m]."""

SLOWEST_DESIRED = 3.0
"""Desired speed of an entity that stands when its controller is activated [m/s]."""


@dataclass(frozen=True, eq=False)
class Beginning:
    """What an action may know when it begins.

    Attributes:
        view: the instant.
        places: resolves positions then.
        token: of the action.
        version: of the storyboard.
    """

    view: View
    places: PositionResolver
    token: int
    version: int


def begun(actor: EntityState, action: Any, at: Beginning) -> EntityState:
    """The entity with an action of the storyboard begun; one that takes no time is finished.

    Raises:
        WorldError: INVALID_REQUEST, a place, lane or form that it cannot go to.
    """
    return _BEGIN[type(action)](actor, action, at)


def _done(actor: EntityState, at: Beginning, **changes: Any) -> EntityState:
    return copy_with(actor, finished=actor.finished | {at.token}, **changes)


def _dynamics(dynamics: Dynamics, at: Beginning) -> Dynamics:
    """With the magnitude of a rate: some write braking as a negative one."""
    if at.version < 2 or dynamics.dimension != "rate":
        return dynamics
    return dynamics.model_copy(update={"value": abs(float(dynamics.value))})


def _freed(actor: EntityState) -> EntityState:
    """Off a trajectory whose times ruled its speed, which it goes on along at its own; off one
    that only rules its place nothing changes."""
    if actor.trajectory is None or actor.trajectory.timing is None:
        return actor
    course = actor.trajectory.course
    places = [Place(float(x), float(y), 0.0) for x, y in zip(course.x, course.y, strict=True)]
    way = Way("trajectory", 1, True, path_through(places))
    return copy_with(actor, trajectory=None).on_way(way)


def _on_lane(actor: EntityState, at: Beginning) -> EntityState:
    """Off its trajectory, on the lane where it is."""
    if actor.trajectory is None:
        return actor
    return copy_with(actor, trajectory=None).on_lane(at.view.network)


def _speed(actor: EntityState, action: SpeedAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    value, dynamics = float(action.speed), _dynamics(action.dynamics, at)
    if action.continuous and action.relative_to is not None:
        rate = float(dynamics.value) if dynamics.dimension == "rate" else math.inf
        rate = math.inf if dynamics.shape == "step" else rate
        follow = FollowSpeed(at.token, action.relative_to, action.relation, value, rate)
        return copy_with(actor, longitudinal=follow)
    if action.relative_to is not None:
        other = at.view.entities[action.relative_to].speed
        value = other + value if action.relation == "delta" else other * value
    seconds = _speed_duration(dynamics, actor.speed, value)
    if seconds <= 0.0:
        return _done(actor, at, speed=value, longitudinal=None)
    change = SpeedChange(at.token, dynamics.shape, actor.speed, value, seconds)
    return copy_with(actor, longitudinal=change)


def _speed_duration(dynamics: Dynamics, start: float, end: float) -> float:
    """How long it takes [s]. All forms have the mean of both speeds as their mean, which tells
    the time that a way takes."""
    if dynamics.dimension != "distance" or dynamics.shape == "step":
        return duration(dynamics, end - start)
    mean = (start + end) / 2
    return float(dynamics.value) / mean if mean > 0 else 0.0


def _speed_profile(actor: EntityState, action: SpeedProfileAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    base = at.view.entities[action.relative_to].speed if action.relative_to is not None else 0.0
    points, time = [(0.0, actor.speed)], 0.0
    for point in action.points:
        time += max(float(point.time), 0.0)
        points.append((time, base + float(point.speed)))
    if time <= 0.0:
        return _done(actor, at, speed=points[-1][1], longitudinal=None)
    return copy_with(actor, longitudinal=SpeedCourse(at.token, tuple(points)))


def _longitudinal_distance(
    actor: EntityState, action: LongitudinalDistanceAction, at: Beginning
) -> EntityState:
    actor = _freed(actor)
    other = at.view.entities[action.entity]
    ahead = ahead_on_way(actor, other.x, other.y, at.view.network)
    leading = ahead < 0.0 if action.place == "any" else action.place == "leading"
    return copy_with(actor, longitudinal=KeepDistance(at.token, action, leading))


def _synchronize(actor: EntityState, action: SynchronizeAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    final = None if action.final_speed is None else float(action.final_speed)
    tolerances = (float(action.master_tolerance), float(action.tolerance))
    steady = float(action.steady_distance or 0.0), float(action.steady_time or 0.0)
    there, own = at.places.of(action.master_target), at.places.of(action.target)
    control = Synchronize(
        at.token,
        action.master,
        there,
        own,
        final,
        action.relative,
        tolerances,
        steady,
        action.limits,
    )
    return copy_with(actor, longitudinal=control)


def _where(actor: EntityState, at: Beginning, what: str) -> RoadPoint:
    here = at.view.network.locate(actor.x, actor.y, actor.h)
    if here is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"{actor.name!r} is beside all lanes and cannot begin a {what}",
            hint="let it begin on a lane; storyboard.roads says how many there are",
        )
    return here


def _lane_change(actor: EntityState, action: LaneChangeAction, at: Beginning) -> EntityState:
    actor, network = _on_lane(actor, at), at.view.network
    here = _where(actor, at, "lane change")
    along = math.cos(actor.h - here.h) >= 0.0
    lane = int(action.lane)
    if action.relative_to is not None:
        other = at.view.entities[action.relative_to]
        base = _where(other, at, "lane change relative to it")
        sense = 1 if math.cos(other.h - base.h) >= 0.0 else -1
        lane = network.neighbour(base.road, base.lane, base.s, lane * sense)
    actor = actor.on_way(network.way(here.road, lane, here.s, along=along))
    end = float(action.offset) * (1.0 if along else -1.0)
    dynamics, change = _dynamics(action.dynamics, at), end - actor.offset
    by_way = dynamics.dimension == "distance" and dynamics.shape != "step"
    extent = float(dynamics.value) if by_way else duration(dynamics, change)
    return _shifted(actor, dynamics.shape, end, extent, at, by_way=by_way)


def _lane_offset(actor: EntityState, action: LaneOffsetAction, at: Beginning) -> EntityState:
    actor = _on_lane(actor, at)
    value, acceleration = float(action.offset), action.acceleration
    if action.relative_to is not None:
        if action.continuous and acceleration is None:
            return copy_with(actor, lateral=FollowOffset(at.token, action.relative_to, value))
        value += lane_offset(at.view.entities[action.relative_to], at.view)
    # Who was straight on beside the road or on a route counts from its lane's middle now.
    actor = actor.on_lane(at.view.network)
    if action.continuous and acceleration is None:
        return copy_with(actor, lateral=HoldOffset(at.token, value))
    most = None if acceleration is None else float(acceleration)
    extent = gentle_duration(action.shape, value - actor.offset, most)
    return _shifted(actor, action.shape, value, extent, at)


def _shifted(
    actor: EntityState,
    shape: Any,
    end: float,
    extent: float,
    at: Beginning,
    *,
    by_way: bool = False,
) -> EntityState:
    if extent <= 0.0:
        return _done(copy_with(actor, lateral=None, offset=end, drift=0.0).placed(), at)
    change = OffsetChange(at.token, shape, actor.offset, end, extent, by_way)
    return copy_with(actor, lateral=change)


def _lateral_distance(
    actor: EntityState, action: LateralDistanceAction, at: Beginning
) -> EntityState:
    actor, other = _on_lane(actor, at), at.view.entities[action.entity]
    side = {"left": 1.0, "right": -1.0}.get(action.side, 0.0)
    if not side:
        side = math.copysign(1.0, across(other.h, actor.x - other.x, actor.y - other.y))
    return copy_with(actor, lateral=KeepAside(at.token, action, side))


def _follow_trajectory(
    actor: EntityState, action: FollowTrajectoryAction, at: Beginning
) -> EntityState:
    course = course_of(action.curve, at.places.of)
    timing, s = action.timing, float(action.offset)
    if timing is not None and course.times is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"trajectory {action.name!r} is to be followed by its times and has none",
            hint="give times to its vertices, or leave out `timing`",
        )
    elapsed = at.view.elapsed if timing is not None and timing.domain == "absolute" else 0.0
    following = Trajectory(at.token, course, timing, s, elapsed)
    longitudinal = actor.longitudinal if timing is None else None
    actor = copy_with(
        actor, trajectory=following, lateral=None, longitudinal=longitudinal, drift=0.0
    )
    if not following.begun():
        return actor
    if timing is not None:
        time = elapsed * float(timing.scale) + float(timing.offset)
        following = Trajectory(at.token, course, timing, course.way_at(time), elapsed)
        actor = copy_with(actor, trajectory=following)
    place = following.place()
    return copy_with(actor, x=place.x, y=place.y, h=place.h)


def _assign_route(actor: EntityState, action: AssignRouteAction, at: Beginning) -> EntityState:
    places = [at.places.of(w) for w in action.route.waypoints]
    return _done(_on_route(actor, at.view.network.route(places)), at)


def _acquire_position(
    actor: EntityState, action: AcquirePositionAction, at: Beginning
) -> EntityState:
    here = Place(actor.x, actor.y, actor.h)
    path = at.view.network.route([here, at.places.of(action.position)])
    moved = _on_route(actor, path)
    return copy_with(moved, lateral=OffsetChange(
        at.token, "linear", moved.offset, moved.offset, max(path.length - moved.s, 1e-6), True
    ))  # fmt: skip


def _on_route(actor: EntityState, path: LoggedPath) -> EntityState:
    way = Way("route", 1, True, path, assigned=True)
    return copy_with(actor, trajectory=None, lateral=None).on_way(way)


def _teleport(actor: EntityState, action: TeleportAction, at: Beginning) -> EntityState:
    place = at.places.of(action.position)
    put = actor.put(place, at.view.network)
    route = actor.way
    if at.version >= 2 and route is not None and route.assigned and _is_beside(place, route):
        put = put.on_way(route)
    return _done(put, at, lateral=None)


def _is_beside(place: Place, route: Way) -> bool:
    """Whether a place is one to drive a route from."""
    near = route.path.nearest(place.x, place.y)
    # Headings of a route turn between its places, which may be far apart: its points tell more.
    (x0, y0, *_), (x1, y1, *_) = (route.path.at(near.s + ds) for ds in (-0.5, 0.5))
    turn = math.remainder(math.atan2(y1 - y0, x1 - x0) - place.h, math.tau)
    away = math.dist((place.x, place.y), near.position[:2])
    return away <= BESIDE_ROUTE and abs(turn) <= ACROSS


def _visibility(actor: EntityState, action: VisibilityAction, at: Beginning) -> EntityState:
    return _done(actor, at, visible=action.visible)


def _controller(actor: EntityState, action: ControllerAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    if not action.active:
        return _done(actor, at, longitudinal=None)
    desired = action.idm.desired_speed
    desired = max(actor.speed, SLOWEST_DESIRED) if desired is None else desired
    return _done(actor, at, longitudinal=FollowIdm(at.token, _idm(action), desired))


def _idm(action: ControllerAction) -> IdmDriver:
    return IdmDriver(path="route", **action.idm.model_dump())


_BEGIN: Mapping[type[Any], Callable[[EntityState, Any, Beginning], EntityState]] = {
    SpeedAction: _speed,
    SpeedProfileAction: _speed_profile,
    LaneChangeAction: _lane_change,
    LaneOffsetAction: _lane_offset,
    LateralDistanceAction: _lateral_distance,
    LongitudinalDistanceAction: _longitudinal_distance,
    SynchronizeAction: _synchronize,
    FollowTrajectoryAction: _follow_trajectory,
    AssignRouteAction: _assign_route,
    AcquirePositionAction: _acquire_position,
    TeleportAction: _teleport,
    VisibilityAction: _visibility,
    ControllerAction: _controller,
}


STANDBY, RUNNING, COMPLETE = 0, 1, 2
STATES = {"standby": STANDBY, "running": RUNNING, "complete": COMPLETE}

GLOBAL = (
    AddEntityAction,
    DeleteEntityAction,
    SetVariableAction,
    SignalPhaseAction,
    SignalStateAction,
)


class ElementChange(NamedTuple):
    """An element has begun, ended, been stopped or been skipped.

    Attributes:
        t_us: when [us].
        element: names from the story down, joined by '::'.
        type: of the element.
        change: 'start', 'end', 'stop' or 'skip'.
    """

    t_us: int
    element: str
    type: str
    change: str


class ProgressState(NamedTuple):
    """State of a storyboard between steps, apart from its entities.

    Attributes:
        status: of each element.
        times: that each event has begun.
        running: tokens of the actions that run: by number of the element, of each entity.
        conditions: state of each.
        variables: parameters and variables.
        signal_starts, signal_states: what actions have set of traffic signals.
        token: of the next action.
        over: whether the whole has been stopped.
        fresh: changes of elements that conditions have not been asked about yet.
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
    fresh: frozenset[tuple[int, str]]


class Progress:
    """One step of a storyboard: made for the step and read at its end.

    Args:
        program: what runs.
        entities, state: before the step.
        network: roads.
        surroundings: of the step.
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
        self._before, self._fresh = state.fresh, set[tuple[int, str]]()
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
        """Do what the storyboard says of the beginning."""
        for action in self._program.board.global_init:
            self._global(action, t_us, elapsed)
        for entry in self._program.init:
            self._begin_private(entry.entity, entry.action, elapsed, first=True)

    def pass_instant(self, t_us: int, elapsed: float, *, first: bool) -> None:
        """Let elements begin and end at an instant."""
        self._fresh, self._now = set(), t_us
        self._end_actions()
        if not self._over:
            context = self._context(elapsed, first=first)
            self._context_now, self._elapsed = context, elapsed
            self._pass_whole()
        self._before = frozenset(self._fresh)

    def move(self, elapsed: float, h: float, *, first: bool) -> None:
        """Move all entities on by ``h`` seconds, each by where the others are now."""
        view = self._view(elapsed, first=first)
        self.entities = {name: advanced(a, view, h) for name, a in self.entities.items()}

    # --- elements -------------------------------------------------------------------------------

    def _pass_whole(self) -> None:
        if self._program.stop is not None and self._fires(self._program.stop):
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
        if self._status[act.number] == STANDBY and (act.start is None or self._fires(act.start)):
            for element in act.within():
                if element.type in {"act", "maneuver_group", "maneuver"}:
                    self._change(element, RUNNING, "start")
        if self._status[act.number] != RUNNING:
            return
        if act.stop is not None and self._fires(act.stop):
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
            event.start is None or self._fires(event.start)
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
            self._fresh.add((event.number, "skip_transition"))
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
            tokens[name] = self._token
            self._begin_private(name, action.spec, self._elapsed, where=action.label)

    def _end_actions(self, event: Element | None = None) -> None:
        """Actions whose entities are moved by them no more are over; so are events of theirs."""
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

    def _complete_with_children(self, element: Element) -> None:
        if self._status[element.number] == RUNNING and all(
            self._status[c.number] == COMPLETE for c in element.children
        ):
            self._change(element, COMPLETE, "end")

    def _stop(self, element: Element, *, again: bool = False) -> None:
        """Stop an element and all that it is made of."""
        for each in element.within():
            tokens = set(self._running.pop(each.number, {}).values())
            if tokens:
                self.entities = {
                    k: _without(a, tokens, self._network) for k, a in self.entities.items()
                }
            if self._status[each.number] != COMPLETE:
                if self._status[each.number] == RUNNING:
                    self._fresh.add((each.number, "stop_transition"))
                    self._note(each, "stop")
                self._status[each.number] = COMPLETE
        if again:
            self._status[element.number] = STANDBY

    def _change(self, element: Element, status: int, change: str) -> None:
        self._status[element.number] = status
        self._fresh.add((element.number, f"{change}_transition"))
        self._note(element, change)

    def _note(self, element: Element, change: str) -> None:
        self.changes.append(ElementChange(self._now, element.label, element.type, change))

    # --- actions --------------------------------------------------------------------------------

    def _begin_private(
        self, name: str, action: Any, elapsed: float, *, first: bool = False, where: str = "init"
    ) -> None:
        actor = self.entities[name]
        if not actor.scripted and not first:
            raise WorldError(
                ErrorCode.INVALID_REQUEST,
                f"action {where!r} is of {name!r}, the ego, which the planner drives",
                hint="let the storyboard drive the ego (drives_ego), or leave the action out",
            )
        view = self._view(elapsed, first=True)
        at = Beginning(view, self._places(), self._token, self._program.board.version)
        self._token += 1
        self.entities[name] = begun(actor, action, at)

    def _global(self, action: Any, t_us: int, elapsed: float) -> None:
        if isinstance(action, AddEntityAction):
            actor = self.entities[action.entity].put(
                self._places().of(action.position), self._network
            )
            self.entities[action.entity] = copy_with(actor, visible=True)
        elif isinstance(action, DeleteEntityAction):
            self.entities[action.entity] = copy_with(self.entities[action.entity], visible=False)
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

    def _fires(self, start: Start) -> bool:
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
        return any((e.number, state) in self._before for e in elements)

    def _view(self, elapsed: float, *, first: bool) -> View:
        return View(elapsed, first, self.entities, self._network, self._surroundings)

    def _places(self) -> PositionResolver:
        return PositionResolver(self.entities, self._network, self._program.board.origin)


def _without(actor: EntityState, tokens: set[int], network: RoadNetwork) -> EntityState:
    """An entity that actions move no more; it keeps its speed, and goes on from where it is."""
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
