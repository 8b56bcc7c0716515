"""The metric registry and the accumulator.

A metric is a function of the accumulator, registered under a name and a version.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from ..common import copy_with
from ..path import Float, LoopTransform
from ..plan import PlannedTrajectory
from .comfort import (
    WINDOW_S,
    ComfortAccumulator,
    Feasibility,
    RowWindow,
    Window,
    plans_agree,
    windowed_sum,
)
from .instant import (
    NEVER,
    NO_LIGHTS,
    ContactRecord,
    EgoSample,
    Instant,
    ScoringContext,
    TrafficLights,
    ego_at_fault,
    fault_class,
    time_to_collision,
)


@dataclass(frozen=True, eq=False)
class MetricAccumulator:
    """Counts and extremes of an episode so far; immutable.

    Running episodes and recordings build it with the same code.

    Attributes:
        steps: number of steps; warm-up steps are excluded, here and below.
        start_s: route position at which scoring starts [m].
        distance: distance driven [m].
        outside: part of it outside all lanes of the ego's direction [m].
        tail_first: route distance covered in reverse gear, facing against the route [m].
        cut: route distance skipped by a short cut [m].
        s, furthest: current and maximum route position [m]; ``furthest`` excludes ``tail_first``
            and ``cut``.
        offset: current offset from the route [m].
        at_fault: at-fault contacts of the ego, by kind: vehicle, vru, object.
        contacts: number of new contacts, by category.
        off_road, far_off_road: whether a corner ever left the road at all, or by more than 0.3 m.
        ttc: current time to collision [s].
        min_ttc: smallest time to collision so far [s].
        comfort, comfort_with_history: comfort of the drive, without and with the log before the
            start.
        backward: [n] float64, distances driven against the route in each step of the last second
            [m]; empty if there are none.
        oncoming: longest distance against the route within one second [m].
        lane_run: time for which the lane offset has been too large [s].
        left_lane: whether the lane offset was ever too large for 2 s.
        plan: newest plan.
        plans_compared, plans_disagree: number of compared plan pairs, and whether any pair differs.
        overspeed: integral of the speed above the limit [m].
        hugsim: sum of HUGSIM's step scores.
        feasibility: kinematic feasibility of the drive.
        first_impact: relative speed at the first contact [m/s]; None without contact.
        impact_position: ego position at the first contact.
        pushes: impulses of the steps of the last 0.2 s [N s], of ongoing contacts, by name.
        impulse: magnitudes of the impulses on the ego, summed over objects and steps [N s].
        delta_v: largest velocity change of the ego by one impact [m/s].
        secondary: number of contacts after the first, of the ego or between objects.
        hit: objects in contact so far.
        lights: traffic light states and violations.
        ego: ego sample at the newest instant.
        states: states of single metrics, by name; see :class:`Metric`.
    """

    steps: int = 0
    start_s: float = 0.0
    distance: float = 0.0
    outside: float = 0.0
    tail_first: float = 0.0
    cut: float = 0.0
    s: float = 0.0
    furthest: float = 0.0
    offset: float = 0.0
    at_fault: dict[str, int] = field(default_factory=dict)
    contacts: dict[str, int] = field(default_factory=dict)
    off_road: bool = False
    far_off_road: bool = False
    ttc: float = NEVER
    min_ttc: float = NEVER
    comfort: ComfortAccumulator = field(default_factory=ComfortAccumulator)
    comfort_with_history: ComfortAccumulator = field(default_factory=ComfortAccumulator)
    backward: Float = field(default_factory=lambda: np.zeros(0))
    oncoming: float = 0.0
    lane_run: float = 0.0
    left_lane: bool = False
    plan: PlannedTrajectory | None = None
    plans_compared: int = 0
    plans_disagree: bool = False
    overspeed: float = 0.0
    hugsim: float = 0.0
    feasibility: Feasibility = field(default_factory=Feasibility)
    first_impact: float | None = None
    impact_position: tuple[float, float] | None = None
    pushes: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    impulse: float = 0.0
    delta_v: float = 0.0
    secondary: int = 0
    hit: frozenset[str] = frozenset()
    lights: TrafficLights = NO_LIGHTS
    ego: EgoSample | None = None
    states: Mapping[str, Any] = field(default_factory=dict)

    @property
    def collisions(self) -> int:
        """Number of contacts of the ego so far."""
        return sum(self.contacts.values())


MIN_ROUTE = 1.0
"""Minimum length of a recorded drive for relative progress [m]; shorter drives are stationary. A
short drive counts as well, so that a stationary ego makes no progress."""


def expert_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Route progress of the recorded drive in the same time [m]."""
    last = len(context.expert_s) - 1
    begin = min(context.warmup_steps, last)
    step = min(begin + accumulator.steps, last)
    return context.expert_s[step] - context.expert_s[begin]


Aspect = Literal[
    "progress",
    "comfort",
    "near_misses",
    "road",
    "lane",
    "direction",
    "speed_limit",
    "fault",
    "lights",
]
"""Inputs of a score, besides contacts and feasibility."""

UNSEEN: dict[Aspect, str] = {
    "progress": "progress",
    "lane": "lane keeping",
    "road": "leaving the road",
    "direction": "driving backwards or against the route",
    "near_misses": "near misses",
    "comfort": "comfort",
    "speed_limit": "speeding",
    "fault": "whose fault a contact is",
}
"""Phrases for inputs that a score ignores, most important first."""

LONG_STEP = 0.1
"""Maximum clock step without gaps between TTC values [s]; TTC is evaluated once per step."""

NOT_NOTICED = 2.0
"""Minimum distance mentioned in a score's blind spots [m]."""


def cannot_see(
    sees: frozenset[Aspect], accumulator: MetricAccumulator, context: ScoringContext
) -> str:
    """One sentence on the blind spots of a score that considers ``sees``.

    Names effects that this episode does not simulate, and events that the score did not count.
    """
    blind = [phrase for aspect, phrase in UNSEEN.items() if aspect not in sees]
    blind += _seen_in_part(sees, accumulator, context)
    seconds, most = accumulator.steps * context.dt, context.horizon * context.dt
    if not accumulator.contacts and seconds + context.warmup_steps * context.dt < most - 1e-9:
        blind.append(f"events after {seconds:g} s (the episode may last {most:g} s)")
    seen = "lights" in sees and bool(accumulator.lights.placed)
    blind.append(f"{'signs' if seen else 'traffic lights, signs'} and right of way (no map)")
    if not context.background:
        blind.append("walls and poles (contact.background is off)")
    if not context.reactive:
        blind.append("reactions of others (they replay the recording)")
    sentence = f"Cannot see {_listed(blind)}"
    uncounted = _uncounted(sees, accumulator, context)
    return f"{sentence}; uncounted here: {_listed(uncounted)}." if uncounted else f"{sentence}."


def _seen_in_part(
    sees: frozenset[Aspect], accumulator: MetricAccumulator, context: ScoringContext
) -> list[str]:
    """Inputs of the score that this episode does not simulate."""
    found = []
    if "progress" in sees and expert_progress(accumulator, context) < MIN_ROUTE:
        found.append("progress (the recorded ego does not move)")
    if "road" in sees:
        found.append(
            f"where the road ends (no map: {context.corridor:g} m to either side of the recorded "
            "drive count as road)"
        )
    if "near_misses" in sees:
        found.append("following closely at the same speed")
        if context.dt > LONG_STEP:
            found.append(f"near misses between instants, {context.dt:g} s apart")
    if "lane" in sees:
        found.append("lanes not driven in the recording")
    if "comfort" in sees:
        short = accumulator.steps * context.dt < WINDOW_S
        half = f"{WINDOW_S / 2:g} s"
        found.append(
            f"comfort (the drive is shorter than {WINDOW_S:g} s)"
            if short
            else f"comfort in the first and last {half}"
        )
    return found


def _uncounted(
    sees: frozenset[Aspect], accumulator: MetricAccumulator, context: ScoringContext
) -> list[str]:
    """Events of the episode that do not change the score."""
    found = []
    if "progress" not in sees and accumulator.distance < NOT_NOTICED:
        recorded = expert_progress(accumulator, context)
        if recorded > NOT_NOTICED:
            found.append(f"standing still while the recorded drive covers {recorded:.0f} m")
    if "direction" not in sees and accumulator.oncoming >= NOT_NOTICED:
        found.append(f"up to {accumulator.oncoming:.0f} m in a second against the route")
    if "progress" not in sees and accumulator.tail_first >= NOT_NOTICED:
        found.append(f"{accumulator.tail_first:.0f} m of the route driven in reverse")
    if "progress" not in sees and accumulator.cut >= NOT_NOTICED:
        found.append(f"{accumulator.cut:.0f} m of the route skipped by a shortcut")
    if "lane" not in sees and accumulator.outside >= NOT_NOTICED:
        found.append(f"{accumulator.outside:.0f} m off all driven lanes")
    if "lights" not in sees and (ran := len(accumulator.lights.ran)):
        found.append(f"stop lines crossed on red ({ran})")
    without_fault = accumulator.collisions - sum(accumulator.at_fault.values())
    if "fault" in sees and without_fault > 0:
        found.append(f"contacts without fault of the ego, or again ({without_fault})")
    return found


def _listed(phrases: list[str]) -> str:
    """``a, b and c``."""
    *most, last = phrases
    return f"{', '.join(most)} and {last}" if most else last


NO_TERMS: Mapping[str, float] = MappingProxyType({})


class Score(NamedTuple):
    """One score; the fields of the wire's Score."""

    name: str
    version: str
    value: float | None
    terms: dict[str, float]
    assumed: tuple[str, ...]
    missing: tuple[str, ...]
    cannot_see: str = ""

    def fields(self) -> dict[str, Any]:
        """The score as a plain map."""
        return {
            "name": self.name,
            "version": self.version,
            "value": self.value,
            "terms": dict(self.terms),
            "assumed": list(self.assumed),
            "missing": list(self.missing),
            "cannot_see": self.cannot_see,
        }


class MetricValue(NamedTuple):
    """Result of a metric.

    Attributes:
        value: the value; None if inputs are ``missing``.
        terms: terms of the value, by name.
        assumed: assumptions made.
        missing: missing inputs.
    """

    value: float | None
    terms: Mapping[str, float] = NO_TERMS
    assumed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


Formula = Callable[[MetricAccumulator, ScoringContext], MetricValue]
Running = Callable[[MetricAccumulator, ScoringContext], float | None]


NO_STEP = "a step that counts"


@dataclass(frozen=True)
class Metric:
    """A registered metric.

    Attributes:
        name: name on the wire and in recordings.
        version: increased when a value may change for the same episode.
        formula: function of the accumulator and the context only.
        running: function that returns the value alone, for every observation; None if the metric
            is not streamed.
        begin, update: optional state of the metric, for data that the accumulator lacks.
            ``begin(instant, context)`` creates it at the first scored instant, ``update(state,
            instant, context)`` returns the state one step later, and ``accumulator.states[name]``
            holds it. Set both or neither.
        sees: inputs besides contacts, for the sentence on blind spots; None omits that sentence.
    """

    name: str
    version: str
    formula: Formula
    running: Running | None = None
    begin: Callable[[Instant, ScoringContext], Any] | None = None
    update: Callable[[Any, Instant, ScoringContext], Any] | None = None
    sees: frozenset[Aspect] | None = None

    @property
    def streamed(self) -> bool:
        """Whether its value is part of every observation."""
        return self.running is not None

    def score(self, accumulator: MetricAccumulator, context: ScoringContext) -> Score:
        """The score of an episode so far."""
        found = self.formula(accumulator, context)
        if not accumulator.steps:
            # No step has been scored.
            found = MetricValue(None, {}, missing=(NO_STEP,))
        blind = "" if self.sees is None else cannot_see(self.sees, accumulator, context)
        return Score(
            self.name,
            self.version,
            found.value,
            dict(found.terms),
            found.assumed,
            found.missing,
            blind,
        )


METRICS: dict[str, Metric] = {}
"""All metrics by name, in the order in which they are reported."""


def metric(
    name: str,
    *,
    version: str,
    streamed: bool = False,
    running: Running | None = None,
    begin: Callable[[Instant, ScoringContext], Any] | None = None,
    update: Callable[[Any, Instant, ScoringContext], Any] | None = None,
    sees: Iterable[Aspect] | None = None,
) -> Callable[[Formula], Formula]:
    """Register a formula as a metric; see :class:`Metric` for the arguments.

    ``streamed`` sets ``running`` to the value of the formula.

    Raises:
        ValueError: the name is taken, or only one of ``begin`` and ``update`` is given.
    """
    if (begin is None) != (update is None):
        raise ValueError(f"metric {name!r} needs both begin and update, or neither")

    def register(formula: Formula) -> Formula:
        if name in METRICS:
            raise ValueError(f"there is a metric {name!r} already")
        seen = None if sees is None else frozenset(sees)
        value = _value_of(formula) if streamed and running is None else running
        METRICS[name] = Metric(name, version, formula, value, begin, update, seen)
        return formula

    return register


def _value_of(formula: Formula) -> Running:
    return lambda accumulator, context: formula(accumulator, context).value


def scores_of(accumulator: MetricAccumulator, context: ScoringContext) -> list[Score]:
    """All scores of an episode so far."""
    return [m.score(accumulator, context) for m in METRICS.values()]


def metric_versions() -> dict[str, str]:
    """Version of each metric by its name."""
    return {m.name: m.version for m in METRICS.values()}


def metrics_version() -> str:
    """Versions of all metrics in one string; published to clients and in recordings."""
    return " ".join(f"{name}@{version}" for name, version in metric_versions().items())


# --- Updates -------------------------------------------------------------------------------------

# Running episodes and recordings use the same code.


def looped(accumulator: MetricAccumulator, loop: LoopTransform) -> MetricAccumulator:
    """The accumulator after a loop reset, so that the reset does not count as motion.

    Route distances continue. The plan before the reset is not compared with the next one.
    """
    assert accumulator.ego is not None
    position, found = accumulator.impact_position, accumulator.feasibility
    samples = found.samples.mapped(lambda sample: (_moved(sample[0], loop), sample[1]))
    return replace(
        accumulator,
        ego=_moved(accumulator.ego, loop),
        impact_position=None if position is None else loop.place(*position),
        comfort=_turned(accumulator.comfort, loop),
        comfort_with_history=_turned(accumulator.comfort_with_history, loop),
        feasibility=replace(found, samples=samples),
        plan=None,
    )


def _moved(ego: EgoSample, loop: LoopTransform) -> EgoSample:
    x, y = loop.place(ego.x, ego.y)
    return ego._replace(x=x, y=y, yaw=ego.yaw + loop.turn, path_yaw=ego.path_yaw + loop.turn)


def _turned(comfort: ComfortAccumulator, loop: LoopTransform) -> ComfortAccumulator:
    return replace(comfort, window=RowWindow(comfort.samples + np.array([0.0, loop.turn])))


NUPLAN_DRIVABLE_TOLERANCE = 0.3
ONCOMING_WINDOW_S = 1.0
LANE_OFFSET, LANE_SECONDS = 0.5, 2.0
CRASH_S = 0.2
"""Time over which impulses of a crash are summed [s]; crash pulses of cars last 0.1 to 0.15 s."""
HUGSIM_TTC = 1.0
"""Maximum shift of the plan in HUGSIM's time to collision [s]."""
HUGSIM_REACHED = 3.0
"""Maximum distance from a route point that counts as reached [m]."""

NONE_AGAINST = np.zeros(0)

BEND, SHORT_CUT = 3.0, 10.0
"""Maximum ratio of route progress to driven distance inside a bend, and maximum jump of the nearest
route point at a corner [m]. Larger progress is a short cut."""


def begin_accumulator(instant: Instant, context: ScoringContext) -> MetricAccumulator:
    """The accumulator at step 0."""
    with_history = ComfortAccumulator()
    turns = round((instant.ego.yaw - context.history[-1][1]) / math.tau) if context.history else 0
    for speed, yaw in context.history:
        with_history = with_history.updated(speed, yaw + turns * math.tau, context.dt)
    return _begun(instant, context, with_history)


def _begun(
    instant: Instant, context: ScoringContext, with_history: ComfortAccumulator
) -> MetricAccumulator:
    """The accumulator at the first scored instant."""
    ego = instant.ego
    comfort = ComfortAccumulator().updated(ego.speed, ego.yaw, context.dt)
    if len(with_history.samples):
        with_history = with_history.updated(ego.speed, ego.yaw, context.dt)
    else:
        with_history = comfort
    return MetricAccumulator(
        start_s=ego.s,
        s=ego.s,
        furthest=ego.s,
        offset=ego.offset,
        ego=ego,
        states={m.name: m.begin(instant, context) for m in METRICS.values() if m.begin},
        comfort=comfort,
        comfort_with_history=with_history,
        feasibility=Feasibility(Window((ego, 0.0))),
        lights=NO_LIGHTS.updated(None, instant, context),
    )


def update_accumulator(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> MetricAccumulator:
    """The accumulator one step later; warm-up steps only extend the comfort history."""
    if instant.loop is not None:
        accumulator = looped(accumulator, instant.loop)
    if instant.step <= context.warmup_steps:
        return _begun(instant, context, accumulator.comfort_with_history.restarted())
    ego, dt = instant.ego, context.dt
    assert accumulator.ego is not None
    before = accumulator.ego
    beyond, quarters = context.off_road(ego)
    off_road = beyond > 0
    off_lane = off_road or bool(_in_several_lanes(ego, context))
    accumulator = _with_contacts(_with_pushes(accumulator, instant, context), instant, context)
    ttc = time_to_collision(instant, context, off_lane=off_lane, hit=accumulator.hit)
    comfort, comfort_with_history = accumulator.comfort.updated_with(
        accumulator.comfort_with_history, ego.speed, ego.yaw, dt
    )
    way = math.hypot(ego.x - before.x, ego.y - before.y)
    left_out = _left_out(ego.s - before.s, way)
    gain, cut = ego.s - before.s - left_out, accumulator.cut + left_out
    backward, oncoming = _against_route(
        accumulator.backward, context.distance_against_traffic(ego, way, gain), dt
    )
    lane_run = accumulator.lane_run + dt if abs(context.lane_offset(ego)) > LANE_OFFSET else 0.0
    backing = ego.speed < 0 and math.cos(ego.yaw - ego.path_yaw) < 0
    tail_first = accumulator.tail_first + (max(gain, 0.0) if backing else 0.0)
    limit = context.limit_at(ego)
    distance = accumulator.distance + way
    return copy_with(
        accumulator,
        **_compared_plans(accumulator, instant.plan),
        steps=accumulator.steps + 1,
        distance=distance,
        outside=accumulator.outside + (0.0 if context.in_lane(ego) else way),
        s=ego.s,
        tail_first=tail_first,
        cut=cut,
        furthest=max(accumulator.furthest, ego.s - tail_first - cut)
        if abs(ego.offset) < HUGSIM_REACHED
        else accumulator.furthest,
        offset=ego.offset,
        off_road=accumulator.off_road or off_road,
        far_off_road=accumulator.far_off_road or beyond > NUPLAN_DRIVABLE_TOLERANCE,
        ttc=ttc,
        min_ttc=min(accumulator.min_ttc, ttc),
        comfort=comfort,
        comfort_with_history=comfort_with_history,
        backward=backward,
        oncoming=max(accumulator.oncoming, oncoming),
        lane_run=lane_run,
        left_lane=accumulator.left_lane or lane_run >= LANE_SECONDS - 1e-9,
        overspeed=accumulator.overspeed + (max(ego.speed - limit, 0.0) * dt if limit else 0.0),
        hugsim=accumulator.hugsim + _hugsim_step(instant, quarters / 4, ttc, comfort),
        feasibility=accumulator.feasibility.updated(instant, distance, context),
        lights=accumulator.lights.updated(before, instant, context),
        ego=ego,
        states=_updated_states(accumulator, instant, context),
    )


def _against_route(backward: Float, way: float, dt: float) -> tuple[Float, float]:
    """Distances driven against the route in each step of the last second, and their sum [m].

    ``way`` is the distance of the newest step. The array is empty if all distances are zero.
    """
    if not way and not len(backward):
        return backward, 0.0
    backward, total = windowed_sum(backward, way, max(round(ONCOMING_WINDOW_S / dt), 1))
    return (backward, total) if total else (NONE_AGAINST, 0.0)


def _left_out(gain: float, way: float) -> float:
    """Route progress in a step that a short cut skipped [m]; negative after a jump backwards."""
    return gain - math.copysign(way, gain) if abs(gain) > BEND * way + SHORT_CUT else 0.0


def _updated_states(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> Mapping[str, Any]:
    """Updated states of all metrics with a state."""
    states = accumulator.states
    if not states:
        return states
    updates = {name: METRICS[name].update for name in states}
    return {n: update(states[n], instant, context) for n, update in updates.items() if update}


def _in_several_lanes(ego: EgoSample, context: ScoringContext) -> bool:
    """Whether the ego box extends beyond its lane, which is centred on the route."""
    return abs(ego.offset) + context.ego_size[1] / 2 > context.lane


def _with_contacts(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> MetricAccumulator:
    secondary = accumulator.secondary + instant.secondary
    if not instant.contacts:
        return (
            accumulator
            if secondary == accumulator.secondary
            else copy_with(accumulator, secondary=secondary)
        )
    at_fault, contacts = dict(accumulator.at_fault), dict(accumulator.contacts)
    hit = set(accumulator.hit)
    first, position = accumulator.first_impact, accumulator.impact_position
    for record in instant.contacts:
        name = record.object_id or record.category
        if not record.begun:
            continue
        if first is None:
            first, position = record.relative_speed, (instant.ego.x, instant.ego.y)
        else:
            secondary += 1
        contacts[record.category] = contacts.get(record.category, 0) + 1
        # Each object counts once, regardless of the number of contacts (nuPlan).
        if name not in hit and ego_at_fault(
            record, _was_off_lane(accumulator, instant, record, context)
        ):
            kind = fault_class(record.category)
            at_fault[kind] = at_fault.get(kind, 0) + 1
        hit.add(name)
    return copy_with(
        accumulator,
        at_fault=at_fault,
        contacts=contacts,
        hit=frozenset(hit),
        first_impact=first,
        impact_position=position,
        secondary=secondary,
    )


def _was_off_lane(
    accumulator: MetricAccumulator, instant: Instant, record: ContactRecord, context: ScoringContext
) -> bool:
    """Whether the ego was in several lanes or off the road when a contact began."""
    now, part = instant.ego, record.since
    if part < 1.0 and accumulator.ego is not None:
        before = accumulator.ego
        turned = before.yaw + part * math.remainder(now.yaw - before.yaw, math.tau)
        now = now._replace(
            x=before.x + part * (now.x - before.x),
            y=before.y + part * (now.y - before.y),
            offset=before.offset + part * (now.offset - before.offset),
            yaw=turned,
        )
    return context.off_road(now)[0] > 0 or _in_several_lanes(now, context)


def _with_pushes(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> MetricAccumulator:
    """Update velocity changes by impacts: impulse over mass, within the duration of a crash.

    Later impulses of a lasting contact, such as pushing against a wall, do not count.
    """
    pushing = [c for c in instant.contacts if c.impulse != (0.0, 0.0)]
    if not pushing:
        return copy_with(accumulator, pushes={}) if accumulator.pushes else accumulator
    kept = max(round(CRASH_S / context.dt), 1)
    pushes: dict[str, tuple[tuple[float, float], ...]] = {}
    impulse, delta_v = accumulator.impulse, accumulator.delta_v
    for record in pushing:
        name = record.object_id or record.category
        earlier = () if record.begun else accumulator.pushes.get(name, ())
        pushes[name] = (*earlier, record.impulse)[-kept:]
        strength = math.hypot(sum(x for x, _ in pushes[name]), sum(y for _, y in pushes[name]))
        delta_v = max(delta_v, strength / context.ego_mass)
        impulse += math.hypot(*record.impulse)
    return copy_with(accumulator, pushes=pushes, impulse=impulse, delta_v=delta_v)


def _compared_plans(
    accumulator: MetricAccumulator, plan: PlannedTrajectory | None
) -> dict[str, Any]:
    """The newest plan and the results of comparing successive plans."""
    compared, disagree = accumulator.plans_compared, accumulator.plans_disagree
    if plan is not None and accumulator.plan is not None:
        agree = plans_agree(accumulator.plan, plan)
        compared += agree is not None
        disagree = disagree or agree is False
    newest = plan if plan is not None else accumulator.plan
    return {"plan": newest, "plans_compared": compared, "plans_disagree": disagree}


def _hugsim_step(
    instant: Instant, on_road: float, ttc: float, comfort: ComfortAccumulator
) -> float:
    """HUGSIM's score of one step: NC DAC (5 TTC + 2 C) / 7; ``on_road``: fraction of the ego."""
    if instant.contacts:
        return 0.0
    drivable = 0.0 if on_road < 0.3 else 0.5 if on_road < 0.5 else 1.0
    safe = float(ttc > HUGSIM_TTC + 1e-9)
    soft = comfort.newest is None or comfort.newest.comfortable_to_hugsim
    return drivable * (5 * safe + 2 * float(soft)) / 7
