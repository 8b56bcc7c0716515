"""From instant to instant: the accumulator of a running episode and of a recording alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..common import copy_with
from ..ego.reference import PlannedTrajectory
from ..path import Float, LoopTransform
from .comfort import ComfortAccumulator, Feasibility, RowWindow, Window, plans_agree, windowed_sum
from .hazard import NO_LIGHTS, ego_at_fault, fault_class, time_to_collision
from .instant import ContactRecord, EgoSample, Instant, ScoringContext
from .metric import METRICS, MetricAccumulator


def put_back(accumulator: MetricAccumulator, seam: LoopTransform) -> MetricAccumulator:
    """The accumulator beyond the seam, so that no step is longer or turns more than it was driven.

    Distances along the route go on and need nothing; the plan before the seam is not compared with
    the next one, for the route bends differently there.
    """
    assert accumulator.ego is not None
    position, found = accumulator.impact_position, accumulator.feasibility
    samples = found.samples.mapped(lambda sample: (_moved(sample[0], seam), sample[1]))
    return replace(
        accumulator,
        ego=_moved(accumulator.ego, seam),
        impact_position=None if position is None else seam.place(*position),
        comfort=_turned(accumulator.comfort, seam),
        comfort_with_history=_turned(accumulator.comfort_with_history, seam),
        feasibility=replace(found, samples=samples),
        plan=None,
    )


def _moved(ego: EgoSample, seam: LoopTransform) -> EgoSample:
    x, y = seam.place(ego.x, ego.y)
    return ego._replace(x=x, y=y, yaw=ego.yaw + seam.turn, path_yaw=ego.path_yaw + seam.turn)


def _turned(comfort: ComfortAccumulator, seam: LoopTransform) -> ComfortAccumulator:
    return replace(comfort, window=RowWindow(comfort.samples + np.array([0.0, seam.turn])))


NUPLAN_DRIVABLE_TOLERANCE = 0.3
ONCOMING_WINDOW_S = 1.0
LANE_OFFSET, LANE_SECONDS = 0.5, 2.0
CRASH_S = 0.2
"""Crashes change velocities within this time (crash pulses of cars last 0.1 to 0.15 s) [s]."""
HUGSIM_TTC = 1.0
"""Longest shift of the plan in HUGSIM's time to collision [s]."""
HUGSIM_REACHED = 3.0
"""Distance from the route within which a point of it counts as reached [m]."""

NONE_AGAINST = np.zeros(0)

BEND, SHORT_CUT = 3.0, 10.0
"""Inside a bend way along the route is at most this many times the way driven; jumps of the nearest
point at a corner are shorter than this [m]."""


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
    """The accumulator at the instant from which on steps count."""
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
    """The accumulator one step later; steps of the warm-up leave nothing but comfort's history."""
    if instant.seam is not None:
        accumulator = put_back(accumulator, instant.seam)
    if instant.step <= context.warmup_steps:
        return _begun(instant, context, accumulator.comfort_with_history.begun_anew())
    ego, dt = instant.ego, context.dt
    assert accumulator.ego is not None
    before = accumulator.ego
    beyond, quarters = context.off_road(ego)
    off_road = beyond > 0
    off_lane = off_road or bool(_in_several_lanes(ego, context))
    accumulator = _with_contacts(_with_pushes(accumulator, instant, context), instant, context)
    ttc = time_to_collision(instant, context, off_lane=off_lane, hit=accumulator.hit)
    comfort, comfort_with_history = accumulator.comfort.updated_beside(
        accumulator.comfort_with_history, ego.speed, ego.yaw, dt
    )
    way = math.hypot(ego.x - before.x, ego.y - before.y)
    left_out = _left_out(ego.s - before.s, way)
    gain, cut = ego.s - before.s - left_out, accumulator.cut + left_out
    backward, oncoming = _against_route(
        accumulator.backward, context.way_against(ego, way, gain), dt
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
    """Ways made against the route within a second, one more of which is ``way``, and their sum [m].
    Nothing is kept while there is none: what lies before the first adds nothing."""
    if not way and not len(backward):
        return backward, 0.0
    backward, total = windowed_sum(backward, way, max(round(ONCOMING_WINDOW_S / dt), 1))
    return (backward, total) if total else (NONE_AGAINST, 0.0)


def _left_out(gain: float, way: float) -> float:
    """What of a step's gain along the route [m] was not driven, but left out by a short cut; below
    0 where the ego has come back over one."""
    return gain - math.copysign(way, gain) if abs(gain) > BEND * way + SHORT_CUT else 0.0


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
        # Each object counts once, however often it is touched (nuPlan).
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
    """With what impacts do to the ego's velocity: impulse by mass, within the time of a crash. A
    contact that lasts, in which an engine may push against a wall, adds no more."""
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
    soft = comfort.newest is None or comfort.newest.comfortable_to_hugsim
    return drivable * (5 * safe + 2 * float(soft)) / 7
