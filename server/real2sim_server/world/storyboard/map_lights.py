"""Phases of a map's traffic lights: one signal controller for each junction.

Lights of a junction are green in turns. Two lights are green together only if their traffic comes
from the same or the opposite direction, and the map does not control them separately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

from real2sim_proto.storyboard import (
    MapSignals,
    Phase,
    SignalController,
    SignalHead,
    Storyboard,
)
from real2sim_proto.storyboard_actions import WorldPosition

from ...scene.lane import Signal
from ...scene.lane_graph import LaneGraph

NEAR_M = 50.0
"""Maximum distance between stop lines of a junction that the map does not name."""

PARALLEL = math.radians(30.0)
"""Maximum angle between approaches that are green together, either way."""


def with_map_signals(board: Storyboard, cycle: MapSignals, graph: LaneGraph) -> Storyboard:
    """The storyboard with signals and controllers for the map's lights that it does not name.

    Args:
        board: storyboard with parameter values.
        cycle: durations of the phases.
        graph: the map of the scene.
    """
    lights = [s for s in graph.signals.values() if s.kind == "traffic_light"]
    named = {head.signal_id for head in board.signals}
    named |= {s for c in board.controllers for phase in c.phases for s in phase.states}
    approaches = [_approach(s, graph) for s in lights if s.signal_id not in named]
    junctions = _joined(approaches, _share_junction)
    heads = [
        SignalHead(
            signal_id=a.light.signal_id,
            stop_line=_stop_line(a, board) if graph.stops[a.light.signal_id] else None,
            state="red",
        )
        for a in approaches
    ]
    controllers = [
        SignalController(name=f"map_signals_{k}", phases=_phases(_groups(junction), cycle))
        for k, junction in enumerate(junctions, start=1)
    ]
    # Maps may hold more lights than a storyboard may list.
    update = {
        "signals": [*board.signals, *heads],
        "controllers": [*board.controllers, *controllers],
    }
    return board.model_copy(update=update)


@dataclass(frozen=True)
class _Approach:
    """A traffic light and the traffic that it controls.

    Attributes:
        light: the light.
        lanes: the lanes on which its traffic waits.
        junctions: the junctions that they lead to.
        x, y, heading: its stop line, or the light without one [m, rad].
    """

    light: Signal
    lanes: frozenset[str]
    junctions: frozenset[str]
    x: float
    y: float
    heading: float

    def is_parallel(self, other: _Approach) -> bool:
        return abs(math.remainder(self.heading - other.heading, math.pi)) <= PARALLEL


def _approach(light: Signal, graph: LaneGraph) -> _Approach:
    waiting, junctions = list[str](), set[str]()
    for name in light.lanes:
        inside = graph.lanes[name].junction
        before = graph.predecessors[name] if inside is not None else ()
        waiting += before or [name]
        onward = [name, *graph.lanes[name].successors]
        onward += [n for lane in onward[1:] for n in graph.lanes[lane].successors]
        ahead = inside or next((j for n in onward if (j := graph.lanes[n].junction)), None)
        junctions |= {ahead} if ahead is not None else set()
    stops = graph.stops[light.signal_id]
    # Without lanes and stop line, traffic approaches the front of the light.
    x, y, heading = stops[0][:3] if stops else (*light.position[:2], light.heading + math.pi)
    return _Approach(light, frozenset(waiting), frozenset(junctions), x, y, heading)


T = TypeVar("T")


def _joined(parts: Iterable[T], belong: Callable[[T, T], bool]) -> list[list[T]]:
    """Sets of parts that belong together, directly or through others, in order."""
    found = list[list[T]]()
    for part in parts:
        near = [known for known in found if any(belong(part, other) for other in known)]
        if not near:
            found.append([part])
            continue
        near[0] += [*(p for known in near[1:] for p in known), part]
        found = [known for known in found if not any(known is gone for gone in near[1:])]
    return found


def _share_junction(a: _Approach, b: _Approach) -> bool:
    if a.junctions & b.junctions or a.lanes & b.lanes:
        return True
    if a.light.group is not None and a.light.group == b.light.group:
        return True
    is_named = a.junctions and b.junctions
    return not is_named and math.hypot(a.x - b.x, a.y - b.y) <= NEAR_M


def _groups(junction: list[_Approach]) -> list[list[_Approach]]:
    """The lights of a junction that are green together."""
    found = list[list[_Approach]]()
    # Lights of the same lane show the same: a lane has one state.
    for unit in _joined(junction, lambda a, b: bool(a.lanes & b.lanes) and a.is_parallel(b)):
        group = next((known for known in found if _may_share(unit, known)), None)
        if group is None:
            found.append(unit)
        else:
            group += unit
    return found


def _may_share(unit: list[_Approach], group: list[_Approach]) -> bool:
    ours, theirs = ({a.light.group for a in part} - {None} for part in (unit, group))
    is_apart = ours and theirs and not ours & theirs
    return not is_apart and all(a.is_parallel(b) for a in unit for b in group)


def _phases(groups: list[list[_Approach]], cycle: MapSignals) -> list[Phase]:
    red = {a.light.signal_id: "red" for group in groups for a in group}
    times = {"green": cycle.green, "yellow": cycle.yellow, "clearance": cycle.clearance}
    return [
        Phase.model_construct(
            name=f"{name}_{k}",
            duration=duration,
            states=red | ({} if name == "clearance" else {a.light.signal_id: name for a in group}),
        )
        for k, group in enumerate(groups, start=1)
        for name, duration in times.items()
    ]


def _stop_line(approach: _Approach, board: Storyboard) -> WorldPosition:
    """The stop line in the frame of the storyboard's world positions."""
    x0, y0, turn = board.origin
    dx, dy = approach.x - x0, approach.y - y0
    cos, sin = math.cos(turn), math.sin(turn)
    heading = math.remainder(approach.heading - turn, math.tau)
    return WorldPosition(x=dx * cos + dy * sin, y=dy * cos - dx * sin, h=heading)
