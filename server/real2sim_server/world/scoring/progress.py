"""How far the ego came, against the recorded drive in the same time."""

from __future__ import annotations

from .accumulator import MetricAccumulator
from .instant import ScoringContext

SHORT_ROUTE = 5.0
"""Ways up to this are no measure of progress to NAVSIM and AlpaSim [m]."""

LEAST_ROUTE = 1.0
"""A recorded drive that gets no farther stands still [m]; one that does is measured against here,
also where it is short: standing still where somebody drove is no progress."""


def expert_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Way of the recorded drive along the route in the same time [m]."""
    last = len(context.expert_s) - 1
    begin = min(context.warmup_steps, last)
    step = min(begin + accumulator.steps, last)
    return context.expert_s[step] - context.expert_s[begin]


def progress_along_route(accumulator: MetricAccumulator) -> float:
    """Way along the route [m]; not what was driven tail first, which is no way to drive there, nor
    what was left out by a short cut."""
    driven = accumulator.s - accumulator.tail_first - accumulator.cut
    return max(driven - accumulator.start_s, 0.0)


def relative_progress(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Fraction of the recorded way, at most 1; 1 where the recorded drive stands still."""
    expert = expert_progress(accumulator, context)
    if expert < LEAST_ROUTE:
        return 1.0
    return min(progress_along_route(accumulator) / expert, 1.0)


def whole_route(accumulator: MetricAccumulator, context: ScoringContext) -> float:
    """Way of the recorded drive along the route up to the horizon [m]."""
    return context.route_end_s - accumulator.start_s


def route_completion(
    accumulator: MetricAccumulator, context: ScoringContext, fraction: float = 1.0
) -> float:
    """How much of a ``fraction`` of the recorded way up to the horizon was reached; 1 where the
    recorded drive stands still."""
    whole = whole_route(accumulator, context)
    if whole < LEAST_ROUTE:
        return 1.0
    return min(max(accumulator.furthest - accumulator.start_s, 0.0) / (fraction * whole), 1.0)


def assumed_progress(accumulator: MetricAccumulator, context: ScoringContext) -> tuple[str, ...]:
    """What is taken for granted where the recorded drive is short; nothing where it is not."""
    expert = expert_progress(accumulator, context)
    if expert < LEAST_ROUTE:
        return (f"progress 1: the recorded drive stands still ({expert:.1f} m)",)
    if expert <= SHORT_ROUTE:
        return (
            f"progress is measured though the recorded drive is short ({expert:.1f} m); NAVSIM and "
            "AlpaSim take it as 1",
        )
    return ()


def assumed_route(accumulator: MetricAccumulator, context: ScoringContext) -> tuple[str, ...]:
    """What is taken for granted where the recorded drive up to the horizon stands still."""
    whole = whole_route(accumulator, context)
    if whole >= LEAST_ROUTE:
        return ()
    return (f"route completed: the recorded drive stands still ({whole:.1f} m)",)
