"""What an episode has come to so far, from instant to instant."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..ego.reference import PlannedTrajectory
from ..path import Float
from .comfort import Ride, plans_agree
from .comfort_kernels import summed
from .hazard import NEVER, time_to_collision
from .instant import VEHICLES, VRU, ContactNote, EgoSample, Instant, ScoringContext

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
        at_fault: contacts that the ego is to blame for, by kind: vehicle, vru, object.
        contacts: contacts begun, by category.
        off_road, far_off_road: whether a corner ever left the corridor; by more than 0.3 m.
        ttc: time to collision now [s].
        min_ttc: smallest so far [s].
        ride, ride_with_history: comfort; with the log before the start prepended.
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
        impact_place: of the ego at the first contact.
        blows: impulse on the ego by object, summed [N s].
        secondary: contacts begun after the first, of the ego or between objects.
        hit: objects in contact so far.
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
    ride: Ride = field(default_factory=Ride)
    ride_with_history: Ride = field(default_factory=Ride)
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
    impact_place: tuple[float, float] | None = None
    blows: dict[str, tuple[float, float]] = field(default_factory=dict)
    secondary: int = 0
    hit: frozenset[str] = frozenset()
    ego: EgoSample | None = None

    @property
    def collisions(self) -> int:
        """Contacts of the ego begun so far."""
        return sum(self.contacts.values())


def begin(instant: Instant, context: ScoringContext) -> MetricAccumulator:
    """The tally at step 0."""
    with_history = Ride()
    turns = round((instant.ego.yaw - context.history[-1][1]) / math.tau) if context.history else 0
    for speed, yaw in context.history:
        with_history = with_history.after(speed, yaw + turns * math.tau, context.dt)
    ego = instant.ego
    tally = MetricAccumulator(s=ego.s, furthest=ego.s, offset=ego.offset, ego=ego)
    return replace(
        tally,
        ride=Ride().after(ego.speed, ego.yaw, context.dt),
        ride_with_history=with_history.after(ego.speed, ego.yaw, context.dt),
    )


def after(tally: MetricAccumulator, instant: Instant, context: ScoringContext) -> MetricAccumulator:
    """The tally one step later."""
    ego, dt = instant.ego, context.dt
    assert tally.ego is not None
    before = tally.ego
    beyond, quarters = context.off_road(ego)
    off_road = beyond > 0
    off_lane = off_road or bool(_in_several_lanes(ego, context))
    tally = _with_contacts(tally, instant, off_lane)
    ttc = time_to_collision(instant, context, off_lane=off_lane, hit=tally.hit)
    ride = tally.ride.after(ego.speed, ego.yaw, dt)
    backward, oncoming = summed(
        tally.backward, max(before.s - ego.s, 0.0), max(round(ONCOMING_WINDOW_S / dt), 1)
    )
    lane_run = tally.lane_run + dt if abs(ego.offset) > LANE_OFFSET else 0.0
    limit = context.speed_limit
    return replace(
        tally,
        **_of_plans(tally, instant.plan),
        steps=tally.steps + 1,
        distance=tally.distance + math.hypot(ego.x - before.x, ego.y - before.y),
        s=ego.s,
        furthest=max(tally.furthest, ego.s) if abs(ego.offset) < HUGSIM_REACHED else tally.furthest,
        offset=ego.offset,
        off_road=tally.off_road or off_road,
        far_off_road=tally.far_off_road or beyond > NUPLAN_DRIVABLE_TOLERANCE,
        ttc=ttc,
        min_ttc=min(tally.min_ttc, ttc),
        ride=ride,
        ride_with_history=tally.ride_with_history.after(ego.speed, ego.yaw, dt),
        backward=backward,
        oncoming=max(tally.oncoming, oncoming),
        lane_run=lane_run,
        left_lane=tally.left_lane or lane_run >= LANE_SECONDS - 1e-9,
        overspeed=tally.overspeed + (max(ego.speed - limit, 0.0) * dt if limit else 0.0),
        hugsim=tally.hugsim + _hugsim_step(instant, quarters / 4, ttc, ride),
        infeasible=tally.infeasible or _infeasible(before, ego, dt),
        ego=ego,
    )


def _in_several_lanes(ego: EgoSample, context: ScoringContext) -> bool:
    """Whether the ego reaches out of its lane, whose middle is the route."""
    return abs(ego.offset) + context.ego_size[1] / 2 > context.lane


def _with_contacts(tally: MetricAccumulator, instant: Instant, off_lane: bool) -> MetricAccumulator:
    secondary = tally.secondary + instant.secondary
    if not instant.contacts:
        return tally if secondary == tally.secondary else replace(tally, secondary=secondary)
    at_fault, contacts = dict(tally.at_fault), dict(tally.contacts)
    blows, hit = dict(tally.blows), set(tally.hit)
    first, place = tally.first_impact, tally.impact_place
    for note in instant.contacts:
        name = note.object_id or note.category
        jx, jy = blows.get(name, (0.0, 0.0))
        blows[name] = (jx + note.impulse[0], jy + note.impulse[1])
        if not note.begun:
            continue
        if first is None:
            first, place = note.relative_speed, (instant.ego.x, instant.ego.y)
        else:
            secondary += 1
        contacts[note.category] = contacts.get(note.category, 0) + 1
        # Each object counts once, however often it is touched (nuPlan).
        if name not in hit and blamed(note, off_lane):
            kind = kind_of(note.category)
            at_fault[kind] = at_fault.get(kind, 0) + 1
        hit.add(name)
    return replace(
        tally,
        at_fault=at_fault,
        contacts=contacts,
        blows=blows,
        hit=frozenset(hit),
        first_impact=first,
        impact_place=place,
        secondary=secondary,
    )


def blamed(note: ContactNote, off_lane: bool) -> bool:
    """Whether the ego is at fault (nuPlan): it ran into something, or left its lane for it."""
    if note.side in {"front", "stopped_track"}:
        return True
    return note.side == "lateral" and off_lane


def kind_of(category: str) -> str:
    """``vru``, ``vehicle`` or ``object``."""
    if category in VRU:
        return "vru"
    return "vehicle" if category in VEHICLES else "object"


def _of_plans(tally: MetricAccumulator, plan: PlannedTrajectory | None) -> dict[str, Any]:
    """The newest plan, and how successive ones compare so far."""
    compared, disagree = tally.plans_compared, tally.plans_disagree
    if plan is not None and tally.plan is not None:
        agree = plans_agree(tally.plan, plan)
        compared += agree is not None
        disagree = disagree or agree is False
    newest = plan if plan is not None else tally.plan
    return {"plan": newest, "plans_compared": compared, "plans_disagree": disagree}


def _hugsim_step(instant: Instant, share: float, ttc: float, ride: Ride) -> float:
    """HUGSIM's score of one step: NC DAC (5 TTC + 2 C) / 7; ``share`` of the ego is on the road."""
    if instant.contacts:
        return 0.0
    drivable = 0.0 if share < 0.3 else 0.5 if share < 0.5 else 1.0
    safe = float(ttc > HUGSIM_TTC + 1e-9)
    return drivable * (5 * safe + 2 * float(ride.comfortable)) / 7


def _infeasible(before: EgoSample, ego: EgoSample, dt: float) -> bool:
    """Waymax: acceleration or curvature that no car has."""
    acceleration = (ego.speed - before.speed) / dt
    speed = max(abs(ego.speed), abs(before.speed))
    turn = math.remainder(ego.yaw - before.yaw, math.tau)
    curved = speed > SLOWEST_CURVATURE and abs(turn) > MAX_CURVATURE * speed * dt
    return abs(acceleration) > MAX_ACCELERATION or curved
