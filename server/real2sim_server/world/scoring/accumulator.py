"""Counts and extremes that the metrics are made of, accumulated from instant to instant."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..ego.reference import PlannedTrajectory
from ..path import Float
from .comfort import ComfortAccumulator, plans_agree
from .comfort_kernels import windowed_sum
from .hazard import NEVER, time_to_collision
from .instant import VEHICLES, VRU, ContactRecord, EgoSample, Instant, ScoringContext

NUPLAN_DRIVABLE_TOLERANCE = 0.3
ONCOMING_WINDOW_S = 1.0
LANE_OFFSET, LANE_SECONDS = 0.5, 2.0
HUGSIM_TTC = 1.0
"""Longest shift of the plan in HUGSIM's time to collision [s]."""
HUGSIM_REACHED = 3.0
"""Distance from the route within which a point of it counts as reached [m]."""

MAX_ACCELERATION, MAX_CURVATURE = 10.4, 0.3
"""Waymax, kinematic infeasibility [m/s^2], [1/m]."""

SLOWEST_CURVATURE = 0.5
"""Below this speed curvature is noise [m/s]."""


@dataclass(frozen=True, eq=False)
class MetricAccumulator:
    """Counts and extremes of an episode so far; immutable. One way to make them serves both the
    running episode and a recording.

    Attributes:
        steps: made.
        distance: driven [m].
        s, furthest: along the route: now and at most [m].
        offset: from the route now [m].
        at_fault: at-fault contacts of the ego, by kind: vehicle, vru, object.
        contacts: contacts begun, by category.
        off_road, far_off_road: whether a corner ever left the corridor; by more than 0.3 m.
        ttc: time to collision now [s].
        min_ttc: smallest so far [s].
        comfort, comfort_with_history: of the drive; with the log before the start prepended.
        backward: [n] float64, ways made against the route in the steps of the last second [m].
        oncoming: longest way against the route within a second [m].
        lane_run: how long the offset has been too large [s].
        left_lane: whether it was so for 2 s.
        plan: the newest one.
        plans_compared, plans_disagree: successive plans compared; whether any two differ.
        overspeed: integral of speed above the limit [m].
        hugsim: sum of HUGSIM's score of the steps.
        infeasible: whether any step was out of reach for a car.
        first_impact: ego speed relative to what it hit first, there [m/s]; None without contact.
        impact_position: of the ego at the first contact.
        impulses: impulse on the ego by object, summed [N s].
        secondary: contacts begun after the first, of the ego or between objects.
        hit: objects in contact so far.
        ego: at the newest instant.
    """

    steps: int = 0
    distance: float = 0.0
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
    infeasible: bool = False
    first_impact: float | None = None
    impact_position: tuple[float, float] | None = None
    impulses: dict[str, tuple[float, float]] = field(default_factory=dict)
    secondary: int = 0
    hit: frozenset[str] = frozenset()
    ego: EgoSample | None = None

    @property
    def collisions(self) -> int:
        """Contacts of the ego begun so far."""
        return sum(self.contacts.values())


def begin_accumulator(instant: Instant, context: ScoringContext) -> MetricAccumulator:
    """The accumulator at step 0."""
    with_history = ComfortAccumulator()
    turns = round((instant.ego.yaw - context.history[-1][1]) / math.tau) if context.history else 0
    for speed, yaw in context.history:
        with_history = with_history.updated(speed, yaw + turns * math.tau, context.dt)
    ego = instant.ego
    accumulator = MetricAccumulator(s=ego.s, furthest=ego.s, offset=ego.offset, ego=ego)
    return replace(
        accumulator,
        comfort=ComfortAccumulator().updated(ego.speed, ego.yaw, context.dt),
        comfort_with_history=with_history.updated(ego.speed, ego.yaw, context.dt),
    )


def update_accumulator(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> MetricAccumulator:
    """The accumulator one step later."""
    ego, dt = instant.ego, context.dt
    assert accumulator.ego is not None
    before = accumulator.ego
    beyond, quarters = context.off_road(ego)
    off_road = beyond > 0
    off_lane = off_road or bool(_in_several_lanes(ego, context))
    accumulator = _with_contacts(accumulator, instant, off_lane)
    ttc = time_to_collision(instant, context, off_lane=off_lane, hit=accumulator.hit)
    comfort = accumulator.comfort.updated(ego.speed, ego.yaw, dt)
    backward, oncoming = windowed_sum(
        accumulator.backward, max(before.s - ego.s, 0.0), max(round(ONCOMING_WINDOW_S / dt), 1)
    )
    lane_run = accumulator.lane_run + dt if abs(ego.offset) > LANE_OFFSET else 0.0
    limit = context.speed_limit
    return replace(
        accumulator,
        **_compared_plans(accumulator, instant.plan),
        steps=accumulator.steps + 1,
        distance=accumulator.distance + math.hypot(ego.x - before.x, ego.y - before.y),
        s=ego.s,
        furthest=max(accumulator.furthest, ego.s)
        if abs(ego.offset) < HUGSIM_REACHED
        else accumulator.furthest,
        offset=ego.offset,
        off_road=accumulator.off_road or off_road,
        far_off_road=accumulator.far_off_road or beyond > NUPLAN_DRIVABLE_TOLERANCE,
        ttc=ttc,
        min_ttc=min(accumulator.min_ttc, ttc),
        comfort=comfort,
        comfort_with_history=accumulator.comfort_with_history.updated(ego.speed, ego.yaw, dt),
        backward=backward,
        oncoming=max(accumulator.oncoming, oncoming),
        lane_run=lane_run,
        left_lane=accumulator.left_lane or lane_run >= LANE_SECONDS - 1e-9,
        overspeed=accumulator.overspeed + (max(ego.speed - limit, 0.0) * dt if limit else 0.0),
        hugsim=accumulator.hugsim + _hugsim_step(instant, quarters / 4, ttc, comfort),
        infeasible=accumulator.infeasible or _infeasible(before, ego, dt),
        ego=ego,
    )


def _in_several_lanes(ego: EgoSample, context: ScoringContext) -> bool:
    """Whether the ego reaches out of its lane, whose middle is the route."""
    return abs(ego.offset) + context.ego_size[1] / 2 > context.lane


def _with_contacts(
    accumulator: MetricAccumulator, instant: Instant, off_lane: bool
) -> MetricAccumulator:
    secondary = accumulator.secondary + instant.secondary
    if not instant.contacts:
        return (
            accumulator
            if secondary == accumulator.secondary
            else replace(accumulator, secondary=secondary)
        )
    at_fault, contacts = dict(accumulator.at_fault), dict(accumulator.contacts)
    impulses, hit = dict(accumulator.impulses), set(accumulator.hit)
    first, position = accumulator.first_impact, accumulator.impact_position
    for record in instant.contacts:
        name = record.object_id or record.category
        jx, jy = impulses.get(name, (0.0, 0.0))
        impulses[name] = (jx + record.impulse[0], jy + record.impulse[1])
        if not record.begun:
            continue
        if first is None:
            first, position = record.relative_speed, (instant.ego.x, instant.ego.y)
        else:
            secondary += 1
        contacts[record.category] = contacts.get(record.category, 0) + 1
        # Each object counts once, however often it is touched (nuPlan).
        if name not in hit and ego_at_fault(record, off_lane):
            kind = fault_class(record.category)
            at_fault[kind] = at_fault.get(kind, 0) + 1
        hit.add(name)
    return replace(
        accumulator,
        at_fault=at_fault,
        contacts=contacts,
        impulses=impulses,
        hit=frozenset(hit),
        first_impact=first,
        impact_position=position,
        secondary=secondary,
    )


def ego_at_fault(record: ContactRecord, off_lane: bool) -> bool:
    """Whether the ego is at fault (nuPlan): it ran into something, or left its lane for it."""
    if record.side in {"front", "stopped_track"}:
        return True
    return record.side == "lateral" and off_lane


def fault_class(category: str) -> str:
    """``vru``, ``vehicle`` or ``object``."""
    if category in VRU:
        return "vru"
    return "vehicle" if category in VEHICLES else "object"


def _compared_plans(
    accumulator: MetricAccumulator, plan: PlannedTrajectory | None
) -> dict[str, Any]:
    """The newest plan, and how successive ones compare so far."""
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
    return drivable * (5 * safe + 2 * float(comfort.comfortable)) / 7


def _infeasible(before: EgoSample, ego: EgoSample, dt: float) -> bool:
    """Waymax: acceleration or curvature that no car has."""
    acceleration = (ego.speed - before.speed) / dt
    speed = max(abs(ego.speed), abs(before.speed))
    turn = math.remainder(ego.yaw - before.yaw, math.tau)
    curved = speed > SLOWEST_CURVATURE and abs(turn) > MAX_CURVATURE * speed * dt
    return abs(acceleration) > MAX_ACCELERATION or curved
