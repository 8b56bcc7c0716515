"""From instant to instant: the accumulator of a running episode and of a recording alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ..ego.reference import PlannedTrajectory
from .accumulator import MetricAccumulator
from .comfort import ComfortAccumulator, plans_agree
from .comfort_kernels import windowed_sum
from .fault import ego_at_fault, fault_class
from .hazard import time_to_collision
from .instant import EgoSample, Instant, ScoringContext
from .metric import METRICS
from .put_back import put_back

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
        states={m.name: m.begin(instant, context) for m in METRICS.values() if m.begin},
        comfort=ComfortAccumulator().updated(ego.speed, ego.yaw, context.dt),
        comfort_with_history=with_history.updated(ego.speed, ego.yaw, context.dt),
    )


def update_accumulator(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> MetricAccumulator:
    """The accumulator one step later."""
    if instant.seam is not None:
        accumulator = put_back(accumulator, instant.seam)
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
        states=_updated_states(accumulator, instant, context),
    )


def _updated_states(
    accumulator: MetricAccumulator, instant: Instant, context: ScoringContext
) -> Mapping[str, Any]:
    """What single metrics accumulate themselves."""
    states = accumulator.states
    if not states:
        return states
    updates = {name: METRICS[name].update for name in states}
    return {n: update(states[n], instant, context) for n, update in updates.items() if update}


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
