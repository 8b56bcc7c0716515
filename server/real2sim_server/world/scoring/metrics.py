"""Scores of an episode. Each has a version; a change of its formula changes that."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from .accumulator import MetricAccumulator, fault_class
from .instant import ScoringContext

TTC_BOUND = 0.95
"""nuPlan; NAVSIM's projections at 0, 0.3, 0.6, 0.9 s ask the same on a grid of 0.1 s [s]."""

SHORT_ROUTE = 5.0
"""Ways up to this are no measure of progress (NAVSIM) [m]."""

CARLA_PENALTIES = {"vru": 0.5, "vehicle": 0.6, "object": 0.65}
NO_MAP = "no map: corridor and lanes come from the recorded drive"


class Score(NamedTuple):
    """One score; the fields of the wire's Score."""

    name: str
    version: str
    value: float | None
    terms: dict[str, float]
    assumed: tuple[str, ...]
    missing: tuple[str, ...]

    def fields(self) -> dict[str, Any]:
        """As a plain map."""
        return {
            "name": self.name,
            "version": self.version,
            "value": self.value,
            "terms": dict(self.terms),
            "assumed": list(self.assumed),
            "missing": list(self.missing),
        }


def scores_of(accumulator: MetricAccumulator, context: ScoringContext) -> list[Score]:
    """All scores of an episode so far."""
    return [metric(accumulator, context) for metric in METRICS]


def metrics_version() -> str:
    """Versions of all scores in one string; published to clients and in recordings."""
    return " ".join(f"{name}@{version}" for name, version in VERSIONS.items())


# --- terms ------------------------------------------------------------------------------------


def no_collision(accumulator: MetricAccumulator) -> float:
    """NC of NAVSIM: 0 for an at-fault hit on a vehicle or road user, 0.5 on an object, else 1."""
    if accumulator.at_fault.get("vru") or accumulator.at_fault.get("vehicle"):
        return 0.0
    return 0.5 if accumulator.at_fault.get("object") else 1.0


def nuplan_no_collision(accumulator: MetricAccumulator) -> float:
    """NC of nuPlan: product of max(0, 1 - n/(m + 1)) with m = 0 for road users and vehicles, 1
    for objects."""
    allowed = {"vru": 0, "vehicle": 0, "object": 1}
    return math.prod(
        max(0.0, 1 - accumulator.at_fault.get(kind, 0) / (m + 1)) for kind, m in allowed.items()
    )


def direction(accumulator: MetricAccumulator) -> float:
    """DDC: 1 below 2 m of way against the route within a second, 0.5 below 6 m, else 0."""
    return 1.0 if accumulator.oncoming < 2.0 else 0.5 if accumulator.oncoming < 6.0 else 0.0


def expert_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Way of the recorded drive along the route in the same time [m]."""
    step = min(accumulator.steps, len(context.expert_s) - 1)
    return context.expert_s[step] - context.start_s


def progress_along_route(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Way along the route [m]."""
    return max(accumulator.s - context.start_s, 0.0)


def navsim_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """EP of NAVSIM with the recorded drive in place of PDM-Closed."""
    way, expert = progress_along_route(accumulator, context), expert_progress(accumulator, context)
    clear = no_collision(accumulator) * float(not accumulator.off_road)
    most = max(way * clear, expert)
    return 1.0 if most <= SHORT_ROUTE else min(way / most, 1.0)


def route_completion(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Fraction of the recorded way up to the horizon that was reached."""
    whole = context.route_end_s - context.start_s
    return 1.0 if whole <= 0 else min(max(accumulator.furthest - context.start_s, 0.0) / whole, 1.0)


def ttc_within_bound(accumulator: MetricAccumulator) -> float:
    """1 while no time to collision was 0.95 s or less."""
    return float(accumulator.min_ttc > TTC_BOUND)


# --- scores -----------------------------------------------------------------------------------


def pdms(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """NC DAC (5 EP + 5 TTC + 2 C) / 12 (Dauner et al. 2024, NAVSIM v1), on the drive as driven."""
    terms = {
        "NC": no_collision(accumulator),
        "DAC": float(not accumulator.off_road),
        "EP": navsim_progress(accumulator, context),
        "TTC": ttc_within_bound(accumulator),
        "C": float(accumulator.comfort.comfortable),
    }
    weighted = 5 * terms["EP"] + 5 * terms["TTC"] + 2 * terms["C"]
    value = terms["NC"] * terms["DAC"] * weighted / 12
    return _score("pdms", value, terms, assumed=(NO_MAP,))


def epdms(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """NC DAC DDC TLC (5 EP + 5 TTC + 2 LK + 2 HC + 2 EC) / 16 (Cao et al. 2025, NAVSIM v2),
    without the penalty filter by the human drive."""
    if not accumulator.plans_compared:
        return _score("epdms", None, {}, missing=("successive trajectory plans (EC)",))
    terms = {
        "NC": no_collision(accumulator),
        "DAC": float(not accumulator.off_road),
        "DDC": direction(accumulator),
        "TLC": 1.0,
        "EP": navsim_progress(accumulator, context),
        "TTC": ttc_within_bound(accumulator),
        "LK": float(not accumulator.left_lane),
        "HC": float(accumulator.comfort_with_history.comfortable),
        "EC": float(not accumulator.plans_disagree),
    }
    weighted = 5 * (terms["EP"] + terms["TTC"]) + 2 * (terms["LK"] + terms["HC"] + terms["EC"])
    value = terms["NC"] * terms["DAC"] * terms["DDC"] * terms["TLC"] * weighted / 16
    return _score("epdms", value, terms, assumed=("TLC: no traffic lights", NO_MAP))


def nuplan(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """NC DAC DDC [EP >= 0.2] (5 EP + 5 TTC + 4 SL + 2 C) / 16 (Karnchanachari et al. 2024)."""
    way, expert = progress_along_route(accumulator, context), expert_progress(accumulator, context)
    limit, seconds = context.speed_limit, max(accumulator.steps * context.dt, context.dt)
    terms = {
        "NC": nuplan_no_collision(accumulator),
        "DAC": float(not accumulator.far_off_road),
        "DDC": direction(accumulator),
        "EP": min(1.0, max(way, 0.1) / max(expert, 0.1)),
        "TTC": ttc_within_bound(accumulator),
        "SL": 1.0 if limit is None else max(0.0, 1 - accumulator.overspeed / (2.23 * seconds)),
        "C": float(accumulator.comfort.comfortable),
    }
    weighted = 5 * (terms["EP"] + terms["TTC"]) + 4 * terms["SL"] + 2 * terms["C"]
    makes_progress = float(terms["EP"] >= 0.2)
    value = terms["NC"] * terms["DAC"] * terms["DDC"] * makes_progress * weighted / 16
    assumed = (NO_MAP,) if limit is not None else ("SL: no speed limit known", NO_MAP)
    return _score("nuplan_cls", value, terms, assumed=assumed)


def hugsim(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """RC mean_t[NC DAC (5 TTC + 2 C) / 7] (Zhou et al. 2024, HUGSIM), on the drive as driven."""
    whole = context.route_end_s - context.start_s
    reached = max(accumulator.furthest - context.start_s, 0.0)
    route = 1.0 if whole <= 0 else min(reached / (0.9 * whole), 1.0)
    mean = accumulator.hugsim / accumulator.steps if accumulator.steps else 1.0
    return _score("hugsim_hd", route * mean, {"RC": route, "mean": mean}, assumed=(NO_MAP,))


def neuroncap(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """5 without collision, else 4 max(0, 1 - v_i/v_r) (Ljungbergh et al. 2024, NeuroNCAP).

    v_i is the relative speed at first contact, v_r that of a run in which the ego keeps to the
    recorded drive whatever happens.
    """
    if accumulator.first_impact is None:
        return _score("neuroncap", 5.0, {})
    reference = context.no_action_impact
    if reference is None:
        return _score("neuroncap", None, {"v_i": accumulator.first_impact}, missing=("v_r",))
    ratio = accumulator.first_impact / reference if reference > 0 else math.inf
    terms = {"v_i": accumulator.first_impact, "v_r": reference}
    return _score("neuroncap", 4 * max(0.0, 1 - ratio), terms)


def carla(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """Route completion in percent times the product of penalties (CARLA leaderboard), with those
    infractions that need no map: pedestrian 0.5, vehicle 0.6, static 0.65."""
    counts = {"vru": 0, "vehicle": 0, "object": 0}
    for category, n in accumulator.contacts.items():
        counts[fault_class(category)] += n
    penalty = math.prod([CARLA_PENALTIES[kind] ** n for kind, n in counts.items()])
    completion = route_completion(accumulator, context)
    terms = {"RC": completion, "P": penalty} | {k: float(n) for k, n in counts.items()}
    if accumulator.distance > 0:
        terms["infractions_per_km"] = sum(counts.values()) / (accumulator.distance * 1e-3)
    assumed = ("no red lights, stop signs, yielding, timeouts",)
    return _score("carla_ds", 100 * completion * penalty, terms, assumed=assumed)


def alpasim(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """0 if at fault or off the road, else min(progress / 0.8, 1) (AlpaSim scene score)."""
    way, expert = progress_along_route(accumulator, context), expert_progress(accumulator, context)
    progress = 1.0 if expert < SHORT_ROUTE else min(way / expert, 1.0)
    clear = not accumulator.at_fault and not accumulator.off_road
    value = min(progress / 0.8, 1.0) if clear else 0.0
    return _score("alpasim", value, {"progress": progress}, assumed=(NO_MAP,))


def feasible(accumulator: MetricAccumulator, _context: ScoringContext) -> Score:
    """1 if any step has |a| > 10.4 m/s^2 or |curvature| > 0.3 1/m, else 0 (Waymax)."""
    return _score("kinematic_infeasibility", float(accumulator.infeasible), {})


def crash(accumulator: MetricAccumulator, context: ScoringContext) -> Score:
    """Greatest change of the ego's velocity by one object [m/s], with what else physics says."""
    strongest = max((math.hypot(*j) for j in accumulator.impulses.values()), default=0.0)
    terms = {
        "impulse": sum(math.hypot(*j) for j in accumulator.impulses.values()),
        "secondary_collisions": float(accumulator.secondary),
    }
    if accumulator.impact_position is not None and accumulator.ego is not None:
        x, y = accumulator.impact_position
        terms["post_impact_displacement"] = math.hypot(accumulator.ego.x - x, accumulator.ego.y - y)
    return _score("delta_v", strongest / context.ego_mass, terms)


METRICS: tuple[Callable[[MetricAccumulator, ScoringContext], Score], ...] = (
    pdms,
    epdms,
    nuplan,
    hugsim,
    neuroncap,
    carla,
    alpasim,
    feasible,
    crash,
)

VERSIONS = {
    "pdms": "2",
    "epdms": "2",
    "nuplan_cls": "2",
    "hugsim_hd": "2",
    "neuroncap": "1",
    "carla_ds": "1",
    "alpasim": "2",
    "kinematic_infeasibility": "1",
    "delta_v": "1",
}
"""Version of each metric; raised when a value may change for the same episode."""


def _score(
    name: str,
    value: float | None,
    terms: dict[str, float],
    *,
    assumed: tuple[str, ...] = (),
    missing: tuple[str, ...] = (),
) -> Score:
    return Score(name, VERSIONS[name], value, terms, assumed, missing)


def running_metrics(accumulator: MetricAccumulator, context: ScoringContext) -> dict[str, float]:
    """What is streamed with every observation; all finite."""
    found = {
        "distance": accumulator.distance,
        "route_progress": accumulator.s - context.start_s,
        "lateral_offset": accumulator.offset,
        "collisions": float(accumulator.collisions),
        "at_fault_collisions": float(sum(accumulator.at_fault.values())),
        "on_road": float(not accumulator.off_road),
        "comfortable": float(accumulator.comfort.comfortable),
        "route_completion": route_completion(accumulator, context),
    }
    if math.isfinite(accumulator.ttc):
        found["ttc"] = accumulator.ttc
    for metric in (pdms, nuplan, hugsim, carla):
        score = metric(accumulator, context)
        if score.value is not None:
            found[score.name] = score.value
    return found


__all__ = ["METRICS", "VERSIONS", "Score", "metrics_version", "running_metrics", "scores_of"]
