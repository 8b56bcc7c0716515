"""Traffic signals: what they show, by the phases of their controllers and by actions."""

from __future__ import annotations

import math
from collections.abc import Mapping

from real2sim_proto.storyboard import SignalController, Storyboard


def shown_at(
    board: Storyboard,
    elapsed: float,
    starts: Mapping[str, float],
    overrides: Mapping[str, str],
) -> tuple[dict[str, str], dict[str, str]]:
    """State of each signal, and phase of each controller.

    Args:
        board: has them.
        elapsed: since the episode began [s].
        starts: when the cycle of a controller began that an action has set [s].
        overrides: states that actions have set.
    """
    states = {head.signal_id: head.state for head in board.signals}
    phases = {}
    known = {c.name: c for c in board.controllers}
    for controller in board.controllers:
        start = starts.get(controller.name)
        since = elapsed - (_delay(controller, known) if start is None else start)
        if since < -1e-9:
            continue
        phase = controller.phases[_phase_at(controller, since)]
        phases[controller.name] = phase.name
        states |= phase.states
    return states | dict(overrides), phases


def phase_start(controller: SignalController, phase: str, elapsed: float) -> float:
    """When the cycle would have begun of a controller that begins a phase now [s]."""
    before = 0.0
    for each in controller.phases:
        if each.name == phase:
            break
        before += float(each.duration)
    return elapsed - before


def _delay(controller: SignalController, known: Mapping[str, SignalController]) -> float:
    delay, seen = float(controller.delay), {controller.name}
    while controller.reference is not None and controller.reference in known:
        controller = known[controller.reference]
        if controller.name in seen:
            break
        seen.add(controller.name)
        delay += float(controller.delay)
    return delay


def _phase_at(controller: SignalController, since: float) -> int:
    lengths = [float(p.duration) for p in controller.phases]
    cycle = sum(lengths)
    left = math.fmod(max(since, 0.0) + 1e-9, cycle) if cycle > 0 and math.isfinite(cycle) else since
    for number, length in enumerate(lengths):
        if left < length:
            return number
        left -= length
    return len(lengths) - 1
