"""Standard metrics: NAVSIM, nuPlan, HUGSIM, NeuroNCAP, CARLA, AlpaSim, Waymax."""

from __future__ import annotations

import math

from .instant import ScoringContext, fault_class
from .metric import (
    METRICS,
    MIN_ROUTE,
    Aspect,
    MetricAccumulator,
    MetricValue,
    expert_progress,
    metric,
)

SHORT_ROUTE = 5.0
"""Maximum length of a drive that is too short to measure progress, for NAVSIM and AlpaSim [m]."""

TTC_BOUND = 0.95
"""Bound of nuPlan [s]; NAVSIM's projections at 0, 0.3, 0.6 and 0.9 s are equivalent on a grid of
0.1 s."""

NAVSIM_ASPECTS: tuple[Aspect, ...] = ("progress", "comfort", "near_misses", "road", "fault")
CARLA_PENALTIES = {"vru": 0.5, "vehicle": 0.6, "object": 0.65}
NO_MAP = "no map: corridor and lanes come from the recorded drive"


def progress_along_route(accumulator: MetricAccumulator) -> float:
    """Progress along the route [m], excluding reverse driving and short cuts."""
    driven = accumulator.s - accumulator.tail_first - accumulator.cut
    return max(driven - accumulator.start_s, 0.0)


def relative_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Progress as a fraction of the recorded drive, at most 1; 1 if that drive is stationary."""
    expert = expert_progress(accumulator, context)
    if expert < MIN_ROUTE:
        return 1.0
    return min(progress_along_route(accumulator) / expert, 1.0)


def whole_route(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Route progress of the recorded drive up to the horizon [m]."""
    return context.route_end_s - accumulator.start_s


def route_completion(
    accumulator: MetricAccumulator, context: ScoringContext, fraction: float = 1.0
) -> float:
    """Progress relative to ``fraction`` of the recorded drive up to the horizon.

    1 if the recorded drive is stationary.
    """
    whole = whole_route(accumulator, context)
    if whole < MIN_ROUTE:
        return 1.0
    return min(max(accumulator.furthest - accumulator.start_s, 0.0) / (fraction * whole), 1.0)


def assumed_progress(accumulator: MetricAccumulator, context: ScoringContext) -> tuple[str, ...]:
    """Assumption made if the recorded drive is too short to measure progress."""
    expert = expert_progress(accumulator, context)
    if expert < MIN_ROUTE:
        return (f"progress 1: the recorded ego does not move ({expert:.1f} m)",)
    if expert <= SHORT_ROUTE:
        return (
            f"progress is measured though the recorded drive is short ({expert:.1f} m); NAVSIM and "
            "AlpaSim take it as 1",
        )
    return ()


def assumed_route(accumulator: MetricAccumulator, context: ScoringContext) -> tuple[str, ...]:
    """Assumption made if the recorded drive up to the horizon is stationary."""
    whole = whole_route(accumulator, context)
    if whole >= MIN_ROUTE:
        return ()
    return (f"route completed: the recorded ego does not move ({whole:.1f} m)",)


def roads(context: ScoringContext) -> tuple[str, ...]:
    """Assumption on the road: the scene's map or the driven area."""
    if context.road_map is None:
        return (NO_MAP,)
    graph = context.road_map.graph
    accuracy = "" if graph.accuracy is None else f", within {graph.accuracy:g} m"
    return (f"map: drivable area, lanes and directions of {graph.source}{accuracy}",)


def driven_lanes(context: ScoringContext) -> tuple[str, ...]:
    """Assumption on lanes."""
    if context.road_map is None:
        return ("lanes are the driven lanes of the recording",)
    return roads(context)


def lights(accumulator: MetricAccumulator, context: ScoringContext) -> str:
    """Assumption on traffic lights: positions come from the map, states from the storyboard."""
    seen = accumulator.lights
    signals = () if context.road_map is None else context.road_map.graph.signals.values()
    mapped = {signal.signal_id for signal in signals if signal.kind == "traffic_light"}
    if not seen.seen:
        phases = "the map's traffic lights show no phases" if mapped else "no traffic lights"
        return f"TLC: {phases}"
    told = f"TLC: stop lines of {len(seen.placed)} signals of the storyboard"
    if seen.unplaced:
        told += f"; {len(seen.unplaced)} others have no known stop line"
    if mapped - seen.placed - seen.unplaced:
        told += "; others of the map show no phases"
    return told


# --- terms ------------------------------------------------------------------------------------


def no_collision(accumulator: MetricAccumulator) -> float:
    """NC of NAVSIM: 0 for an at-fault hit on a vehicle or road user, 0.5 on an object, else 1."""
    if accumulator.at_fault.get("vru") or accumulator.at_fault.get("vehicle"):
        return 0.0
    return 0.5 if accumulator.at_fault.get("object") else 1.0


def nuplan_no_collision(accumulator: MetricAccumulator) -> float:
    """NC of nuPlan: product of max(0, 1 - n/(m + 1)) with m = 0 for road users and vehicles, 1
    for objects."""
    if not accumulator.at_fault:
        return 1.0
    allowed = {"vru": 0, "vehicle": 0, "object": 1}
    return math.prod(
        max(0.0, 1 - accumulator.at_fault.get(kind, 0) / (m + 1)) for kind, m in allowed.items()
    )


def light_compliance(accumulator: MetricAccumulator) -> float:
    """TLC of NAVSIM v2: 0 once the ego's front has crossed a stop line at red, else 1.

    1 if no signals have phases.
    """
    return float(not accumulator.lights.ran)


def direction(accumulator: MetricAccumulator) -> float:
    """DDC: 1 for less than 2 m against the route within a second, 0.5 for less than 6 m, else 0."""
    return 1.0 if accumulator.oncoming < 2.0 else 0.5 if accumulator.oncoming < 6.0 else 0.0


def navsim_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """EP of NAVSIM with the recorded drive in place of PDM-Closed."""
    way, expert = progress_along_route(accumulator), expert_progress(accumulator, context)
    if expert < MIN_ROUTE:
        return 1.0
    clear = no_collision(accumulator) * float(not accumulator.off_road)
    return min(way / max(way * clear, expert), 1.0)


def nuplan_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """EP of nuPlan."""
    way, expert = progress_along_route(accumulator), expert_progress(accumulator, context)
    return min(1.0, max(way, 0.1) / max(expert, 0.1))


def speed_limits(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """SL of nuPlan; 1 if no limit is known."""
    if not context.has_speed_limits:
        return 1.0
    seconds = max(accumulator.steps * context.dt, context.dt)
    return max(0.0, 1 - accumulator.overspeed / (2.23 * seconds))


def feasible(accumulator: MetricAccumulator) -> float:
    """1 if the motion so far is kinematically feasible, else 0; a factor of all scores."""
    return float(not accumulator.feasibility.steps)


def hugsim_mean(accumulator: MetricAccumulator) -> float:
    """Mean of HUGSIM's step scores."""
    return accumulator.hugsim / accumulator.steps if accumulator.steps else 1.0


def lane_share(accumulator: MetricAccumulator) -> float:
    """Fraction of the distance driven in lanes of the ego's direction (CARLA leaderboard)."""
    if accumulator.distance <= 0:
        return 1.0
    return max(1 - accumulator.outside / accumulator.distance, 0.0)


def infractions(accumulator: MetricAccumulator) -> dict[str, int]:
    """Number of contacts, by kind (CARLA leaderboard)."""
    counts = {"vru": 0, "vehicle": 0, "object": 0}
    for category, n in accumulator.contacts.items():
        counts[fault_class(category)] += n
    return counts


def carla_penalty(accumulator: MetricAccumulator) -> float:
    """Product of the penalties and the fraction of the distance in lanes."""
    lanes = lane_share(accumulator)
    if not accumulator.contacts:
        return lanes
    counts = infractions(accumulator)
    return lanes * math.prod([CARLA_PENALTIES[kind] ** n for kind, n in counts.items()])


def ttc_within_bound(accumulator: MetricAccumulator) -> float:
    """1 if the time to collision has always been above 0.95 s, else 0."""
    return float(accumulator.min_ttc > TTC_BOUND)


# --- scores -----------------------------------------------------------------------------------


def pdms_so_far(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """The value of :func:`pdms`."""
    weighted = 5 * navsim_progress(accumulator, context) + 5 * ttc_within_bound(accumulator)
    weighted += 2 * float(accumulator.comfort.comfortable)
    possible = feasible(accumulator) * no_collision(accumulator) * float(not accumulator.off_road)
    return possible * weighted / 12


@metric("pdms", version="5", running=pdms_so_far, sees=NAVSIM_ASPECTS)
def pdms(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F NC DAC (5 EP + 5 TTC + 2 C) / 12 (Dauner et al. 2024, NAVSIM v1), on the executed drive.

    F is :func:`feasible`, as in all scores below.
    """
    terms = {
        "feasible": feasible(accumulator),
        "NC": no_collision(accumulator),
        "DAC": float(not accumulator.off_road),
        "EP": navsim_progress(accumulator, context),
        "TTC": ttc_within_bound(accumulator),
        "C": float(accumulator.comfort.comfortable),
    }
    value = pdms_so_far(accumulator, context)
    return MetricValue(
        value, terms, assumed=(*roads(context), *assumed_progress(accumulator, context))
    )


@metric("epdms", version="5", sees={*NAVSIM_ASPECTS, "lane", "direction", "lights"})
def epdms(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F NC DAC DDC TLC (5 EP + 5 TTC + 2 LK + 2 HC + 2 EC) / 16 (Cao et al. 2025, NAVSIM v2),
    without the penalty filter by the human drive."""
    if not accumulator.plans_compared:
        return MetricValue(None, {}, missing=("successive trajectory plans (EC)",))
    terms = {
        "feasible": feasible(accumulator),
        "NC": no_collision(accumulator),
        "DAC": float(not accumulator.off_road),
        "DDC": direction(accumulator),
        "TLC": light_compliance(accumulator),
        "EP": navsim_progress(accumulator, context),
        "TTC": ttc_within_bound(accumulator),
        "LK": float(not accumulator.left_lane),
        "HC": float(accumulator.comfort_with_history.comfortable),
        "EC": float(not accumulator.plans_disagree),
    }
    weighted = 5 * (terms["EP"] + terms["TTC"]) + 2 * (terms["LK"] + terms["HC"] + terms["EC"])
    multipliers = (terms[name] for name in ("feasible", "NC", "DAC", "DDC", "TLC"))
    assumed = (
        lights(accumulator, context),
        *roads(context),
        *assumed_progress(accumulator, context),
    )
    return MetricValue(math.prod(multipliers) * weighted / 16, terms, assumed=assumed)


def nuplan_so_far(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """The value of :func:`nuplan`."""
    progress, limits = nuplan_progress(accumulator, context), speed_limits(accumulator, context)
    weighted = 5 * (progress + ttc_within_bound(accumulator)) + 4 * limits
    weighted += 2 * float(accumulator.comfort.comfortable)
    possible = feasible(accumulator) * nuplan_no_collision(accumulator)
    possible *= float(not accumulator.far_off_road)
    possible *= direction(accumulator)
    return possible * float(progress >= 0.2) * weighted / 16


@metric(
    "nuplan_cls",
    version="5",
    running=nuplan_so_far,
    sees={*NAVSIM_ASPECTS, "direction", "speed_limit"},
)
def nuplan(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F NC DAC DDC [EP >= 0.2] (5 EP + 5 TTC + 4 SL + 2 C) / 16 (Karnchanachari et al. 2024)."""
    expert = expert_progress(accumulator, context)
    terms = {
        "feasible": feasible(accumulator),
        "NC": nuplan_no_collision(accumulator),
        "DAC": float(not accumulator.far_off_road),
        "DDC": direction(accumulator),
        "EP": nuplan_progress(accumulator, context),
        "TTC": ttc_within_bound(accumulator),
        "SL": speed_limits(accumulator, context),
        "C": float(accumulator.comfort.comfortable),
    }
    value = nuplan_so_far(accumulator, context)
    road = roads(context)
    assumed = road if context.has_speed_limits else ("SL: no speed limit known", *road)
    if expert < MIN_ROUTE:
        assumed = (*assumed, *assumed_progress(accumulator, context))
    return MetricValue(value, terms, assumed=assumed)


def hugsim_so_far(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """The value of :func:`hugsim`."""
    route, mean = route_completion(accumulator, context, 0.9), hugsim_mean(accumulator)
    return feasible(accumulator) * route * mean


@metric(
    "hugsim_hd",
    version="5",
    running=hugsim_so_far,
    sees=("progress", "comfort", "near_misses", "road"),
)
def hugsim(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F RC mean_t[NC DAC (5 TTC + 2 C) / 7] (Zhou et al. 2024, HUGSIM), on the executed drive."""
    terms = {
        "feasible": feasible(accumulator),
        "RC": route_completion(accumulator, context, 0.9),
        "mean": hugsim_mean(accumulator),
    }
    assumed = (*roads(context), *assumed_route(accumulator, context))
    return MetricValue(hugsim_so_far(accumulator, context), terms, assumed=assumed)


@metric("neuroncap", version="3", sees=())
def neuroncap(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F times 5 without collision, else 4 max(0, 1 - v_i/v_r) (Ljungbergh et al. 2024, NeuroNCAP).

    v_i is the relative speed at first contact, v_r the same in a run in which the ego follows the
    recorded drive without reacting.
    """
    possible = feasible(accumulator)
    if accumulator.first_impact is None:
        return MetricValue(5.0 * possible, {"feasible": possible})
    reference = context.no_action_impact
    if reference is None:
        return MetricValue(None, {"v_i": accumulator.first_impact}, missing=("v_r",))
    ratio = accumulator.first_impact / reference if reference > 0 else math.inf
    terms = {"feasible": possible, "v_i": accumulator.first_impact, "v_r": reference}
    return MetricValue(4 * possible * max(0.0, 1 - ratio), terms)


def carla_so_far(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """The value of :func:`carla`."""
    completion = route_completion(accumulator, context)
    return 100 * feasible(accumulator) * completion * carla_penalty(accumulator)


@metric("carla_ds", version="4", running=carla_so_far, sees=("progress", "lane"))
def carla(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """F times route completion in percent times the product of penalties (CARLA leaderboard).

    Only infractions that need no map: pedestrian 0.5, vehicle 0.6, static 0.65, and the fraction
    of the distance in lanes.
    """
    counts = infractions(accumulator)
    terms = {
        "feasible": feasible(accumulator),
        "RC": route_completion(accumulator, context),
        "P": carla_penalty(accumulator),
        "in_lanes": lane_share(accumulator),
    }
    terms |= {k: float(n) for k, n in counts.items()}
    if accumulator.distance > 0:
        terms["infractions_per_km"] = sum(counts.values()) / (accumulator.distance * 1e-3)
    assumed = (
        "no red lights, stop signs, yielding, timeouts",
        *driven_lanes(context),
        *assumed_route(accumulator, context),
    )
    return MetricValue(carla_so_far(accumulator, context), terms, assumed=assumed)


@metric("alpasim", version="5", sees=("progress", "road", "fault"))
def alpasim(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """0 if at fault, off the road or infeasible, else min(progress / 0.8, 1) (AlpaSim)."""
    progress, possible = relative_progress(accumulator, context), feasible(accumulator)
    clear = not accumulator.at_fault and not accumulator.off_road
    value = possible * min(progress / 0.8, 1.0) if clear else 0.0
    assumed = (*roads(context), *assumed_progress(accumulator, context))
    return MetricValue(value, {"feasible": possible, "progress": progress}, assumed=assumed)


def feasible_so_far(accumulator: MetricAccumulator, _context: ScoringContext) -> float:
    """The value of :func:`feasible_drive`."""
    return feasible(accumulator)


@metric("feasible", version="2", running=feasible_so_far, sees=())
def feasible_drive(accumulator: MetricAccumulator, context: ScoringContext) -> MetricValue:
    """1 if every step is kinematically feasible, else 0; a factor of every other score.

    Limits: acceleration and curvature as in Waymax, displacement consistent with speed and
    heading, and reverse speed within that of a reverse gear.
    """
    found = accumulator.feasibility
    terms = {"infeasible_steps": float(found.steps)}
    if found.first is not None:
        terms["first_s"] = found.first * context.dt
    return MetricValue(feasible(accumulator), terms)


@metric("kinematic_infeasibility", version="3", sees=())
def kinematic_infeasibility(
    accumulator: MetricAccumulator, _context: ScoringContext
) -> MetricValue:
    """1 if any step is infeasible, else 0.

    A step is infeasible if |a| > 10.4 m/s^2 or |curvature| > 0.3 1/m (Waymax), or if its
    displacement contradicts its speed and heading.
    """
    return MetricValue(1.0 - feasible(accumulator), {})


@metric("delta_v", version="2", sees=())
def delta_v(accumulator: MetricAccumulator, _context: ScoringContext) -> MetricValue:
    """Largest velocity change of the ego by one impact [m/s], with other impact figures."""
    terms = {
        "feasible": feasible(accumulator),
        "impulse": accumulator.impulse,
        "secondary_collisions": float(accumulator.secondary),
    }
    if accumulator.impact_position is not None and accumulator.ego is not None:
        x, y = accumulator.impact_position
        terms["post_impact_displacement"] = math.hypot(accumulator.ego.x - x, accumulator.ego.y - y)
    return MetricValue(accumulator.delta_v, terms)


# --- streamed ---------------------------------------------------------------------------------


def running_metrics(accumulator: MetricAccumulator, context: ScoringContext) -> dict[str, float]:
    """Values of all streamed metrics, part of every observation; all finite."""
    found = {
        "distance": accumulator.distance,
        "route_progress": accumulator.s - accumulator.cut - accumulator.start_s,
        "lateral_offset": accumulator.offset,
        "collisions": float(accumulator.collisions),
        "at_fault_collisions": float(sum(accumulator.at_fault.values())),
        "on_road": float(not accumulator.off_road),
        "comfortable": float(accumulator.comfort.comfortable),
        "route_completion": route_completion(accumulator, context),
    }
    if math.isfinite(accumulator.ttc):
        found["ttc"] = accumulator.ttc
    for name, each in METRICS.items():
        if each.running is not None and (value := each.running(accumulator, context)) is not None:
            found[name] = value
    return found
