"""Traffic lights of a drive: which stop lines the ego crossed while their signal was red."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from ...scene import LaneGraph, Signal
from ..storyboard.shown_signal import ShownSignal
from .instant import EgoSample, Instant, ScoringContext

ALONG = 0.5
"""Cosine of the greatest angle between an ego and the direction that a stop line is for."""

LAMPS = {"on", "off", "flashing", "counting"}
"""Words of states that list lamps from the first, red one on, as ``off;off;on``."""


class StopLineAt(NamedTuple):
    """Where vehicles stop: middle, world [m], their heading there [rad], half its width [m]."""

    x: float
    y: float
    heading: float
    half: float


@dataclass(frozen=True)
class TrafficLights:
    """What traffic lights showed an ego, and which it ran; immutable.

    Attributes:
        shown: at the newest instant.
        ran: signals whose stop line the ego's front crossed while they were red.
        placed, unplaced: signals so far whose stop line is known, and others.
    """

    shown: tuple[ShownSignal, ...] = ()
    ran: frozenset[str] = frozenset()
    placed: frozenset[str] = frozenset()
    unplaced: frozenset[str] = frozenset()

    @property
    def seen(self) -> bool:
        """Whether there were any."""
        return bool(self.placed or self.unplaced)

    def updated(
        self, before: EgoSample | None, instant: Instant, context: ScoringContext
    ) -> TrafficLights:
        """One instant later.

        A line counts as run where the signal was red at both ends of the step: what it showed
        between them is not known.

        Args:
            before: the ego at the instant before; None at the first.
            instant, context: as of all scores.
        """
        if not instant.signals and not self.shown:
            return self
        red = {signal.signal_id for signal in self.shown if shows_red(signal.state)}
        ran, placed, unplaced = set(self.ran), set(self.placed), set(self.unplaced)
        for signal in instant.signals:
            name = signal.signal_id
            if name in placed or name in unplaced:
                lines = None
            else:
                lines = tuple(stop_lines(signal, context))
                (placed if lines else unplaced).add(name)
            if before is None or name not in red or not shows_red(signal.state):
                continue
            for line in stop_lines(signal, context) if lines is None else lines:
                if _crossed(line, before, instant.ego, context):
                    ran.add(name)
        sets = (frozenset(ran), frozenset(placed), frozenset(unplaced))
        return TrafficLights(instant.signals, *sets)


NO_LIGHTS = TrafficLights()


def shows_red(state: str) -> bool:
    """Whether a state bids vehicles stop: ``red``, also beside others (``red;amber``), ``stop``, or
    lamps of which the first is on (``on;off;off``, red first as in OpenDRIVE)."""
    words = re.findall(r"[a-z]+", state.lower())
    if words and set(words) <= LAMPS:
        return len(words) > 1 and words[0] == "on"
    return "red" in words or "stop" in words


def stop_lines(signal: ShownSignal, context: ScoringContext) -> Iterator[StopLineAt]:
    """Where vehicles stop for a signal: as the storyboard says, as wide as a lane, else as the map
    does: at its stop line, or at the ends of its lanes. None where neither knows."""
    graph = None if context.road_map is None else context.road_map.graph
    if signal.stop_line is not None:
        x, y, heading = signal.stop_line
        found = None if graph is None else graph.nearest(x, y, heading, within=5.0)
        half = context.lane
        if graph is not None and found is not None:
            half = graph.lanes[found.lane_id].width(found.s) / 2
        yield StopLineAt(x, y, heading, half)
    elif graph is not None and (mapped := graph.signals.get(signal.signal_id)) is not None:
        yield from _of_map(mapped, graph)


def _of_map(signal: Signal, graph: LaneGraph) -> Iterator[StopLineAt]:
    lanes = [graph.lanes[name] for name in signal.lanes]
    if signal.stop_line is None:
        for lane in lanes:
            x, y, _, heading = lane.at(lane.length)
            yield StopLineAt(x, y, heading, lane.width(lane.length) / 2)
        return
    line = graph.stop_lines[signal.stop_line]
    first, last = line.points[0, :2], line.points[-1, :2]
    across = math.atan2(last[1] - first[1], last[0] - first[0])
    x, y = ((first + last) / 2).tolist()
    ruled = lanes or [graph.lanes[name] for name in line.lanes]
    # Without lanes: traffic comes towards the face of the signal.
    way = float(ruled[0].headings[-1]) if ruled else signal.heading + math.pi
    turned = across + math.pi / 2
    heading = turned if math.cos(turned - way) > 0 else turned + math.pi
    yield StopLineAt(x, y, heading, math.hypot(*(last - first)) / 2)


def _crossed(line: StopLineAt, before: EgoSample, now: EgoSample, context: ScoringContext) -> bool:
    """Whether the middle of the ego's front crossed a line in its direction within a step."""
    if math.cos(now.yaw - line.heading) <= ALONG:
        return False
    (s0, d0), (s1, d1) = (_front(line, ego, context) for ego in (before, now))
    if not s0 <= 0.0 < s1:
        return False
    return abs(d0 + (d1 - d0) * s0 / (s0 - s1)) <= line.half


def _front(line: StopLineAt, ego: EgoSample, context: ScoringContext) -> tuple[float, float]:
    """The middle of the ego's front: beyond the line, and to the left of its middle [m]."""
    ahead = context.ego_size[0] - context.rear_overhang
    x = ego.x + ahead * math.cos(ego.yaw) - line.x
    y = ego.y + ahead * math.sin(ego.yaw) - line.y
    cos, sin = math.cos(line.heading), math.sin(line.heading)
    return x * cos + y * sin, y * cos - x * sin
