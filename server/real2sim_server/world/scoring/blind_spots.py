"""What a score cannot see in an episode, in one sentence."""

from __future__ import annotations

from typing import Literal

from .accumulator import MetricAccumulator
from .comfort import WINDOW_S
from .instant import ScoringContext
from .progress import LEAST_ROUTE, expert_progress

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
"""What a score may look at, beside contact and whether a car can move so."""

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
"""In the order in which a reader misses them."""

LONG_STEP = 0.1
"""TTC is looked at once a clock step; longer ones leave something out [s]."""

NOT_NOTICED = 2.0
"""Ways up to this are not mentioned [m]."""


def cannot_see(
    sees: frozenset[Aspect], accumulator: MetricAccumulator, context: ScoringContext
) -> str:
    """One sentence: what a score that looks at ``sees`` does not see in an episode like this, and
    what it left uncounted of what happened."""
    blind = [phrase for aspect, phrase in UNSEEN.items() if aspect not in sees]
    blind += _seen_in_part(sees, accumulator, context)
    seconds, most = accumulator.steps * context.dt, context.horizon * context.dt
    if not accumulator.contacts and seconds + context.warmup_steps * context.dt < most - 1e-9:
        blind.append(f"what comes after {seconds:g} s (the episode may last {most:g} s)")
    seen = "lights" in sees and bool(accumulator.lights.placed)
    blind.append(f"{'signs' if seen else 'traffic lights, signs'} and right of way (no map)")
    if not context.background:
        blind.append("walls and poles (contact.background is off)")
    if not context.reactive:
        blind.append("how others would react (they repeat what was recorded)")
    sentence = f"Cannot see {_listed(blind)}"
    uncounted = _uncounted(sees, accumulator, context)
    return f"{sentence}; uncounted here: {_listed(uncounted)}." if uncounted else f"{sentence}."


def _seen_in_part(
    sees: frozenset[Aspect], accumulator: MetricAccumulator, context: ScoringContext
) -> list[str]:
    """Of what the score looks at, what this episode does not show."""
    found = []
    if "progress" in sees and expert_progress(accumulator, context) < LEAST_ROUTE:
        found.append("progress (the recorded drive stands still)")
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
        found.append("lanes that nobody drove in the recording")
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
    """What happened in the episode and does not change the score."""
    found = []
    if "progress" not in sees and accumulator.distance < NOT_NOTICED:
        recorded = expert_progress(accumulator, context)
        if recorded > NOT_NOTICED:
            found.append(f"standing still where the recorded drive goes {recorded:.0f} m")
    if "direction" not in sees and accumulator.oncoming >= NOT_NOTICED:
        found.append(f"up to {accumulator.oncoming:.0f} m in a second against the route")
    if "progress" not in sees and accumulator.tail_first >= NOT_NOTICED:
        found.append(f"{accumulator.tail_first:.0f} m of the route driven tail first")
    if "progress" not in sees and accumulator.cut >= NOT_NOTICED:
        found.append(f"{accumulator.cut:.0f} m of the route left out by a short cut")
    if "lane" not in sees and accumulator.outside >= NOT_NOTICED:
        found.append(f"{accumulator.outside:.0f} m beside all lanes that were driven")
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
