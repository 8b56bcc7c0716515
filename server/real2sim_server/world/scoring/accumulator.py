"""Counts and extremes that the metrics are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..ego.reference import PlannedTrajectory
from ..path import Float
from .comfort import ComfortAccumulator
from .feasibility import Feasibility
from .hazard import NEVER
from .instant import EgoSample
from .traffic_lights import NO_LIGHTS, TrafficLights


@dataclass(frozen=True, eq=False)
class MetricAccumulator:
    """Counts and extremes of an episode so far; immutable. One way to make them serves both the
    running episode and a recording.

    Attributes:
        steps: made; those of the warm-up do not count, here and below.
        start_s: along the route where the scores begin [m].
        distance: driven [m].
        outside: part of it beside all lanes that go the ego's way [m].
        tail_first: way along the route that was made facing against it, in reverse gear [m].
        cut: way along the route that was left out by meeting it again elsewhere [m].
        s, furthest: along the route: now and at most; the latter less what was tail first or left
            out [m].
        offset: from the route now [m].
        at_fault: at-fault contacts of the ego, by kind: vehicle, vru, object.
        contacts: contacts begun, by category.
        off_road, far_off_road: whether a corner ever left the corridor; by more than 0.3 m.
        ttc: time to collision now [s].
        min_ttc: smallest so far [s].
        comfort, comfort_with_history: of the drive; with the log before the start prepended.
        backward: [n] float64, ways made against the route in the steps of the last second [m];
            empty while there were none.
        oncoming: longest way against the route within a second [m].
        lane_run: how long the offset has been too large [s].
        left_lane: whether it was so for 2 s.
        plan: the newest one.
        plans_compared, plans_disagree: successive plans compared; whether any two differ.
        overspeed: integral of speed above the limit [m].
        hugsim: sum of HUGSIM's score of the steps.
        feasibility: whether a car could have moved so.
        first_impact: ego speed relative to what it hit first, there [m/s]; None without contact.
        impact_position: of the ego at the first contact.
        pushes: impulse of the steps of the last 0.2 s [N s], of contacts that go on, by name.
        impulse: on the ego, lengths summed over objects and steps [N s].
        delta_v: greatest change of the ego's velocity by one impact [m/s].
        secondary: contacts begun after the first, of the ego or between objects.
        hit: objects in contact so far.
        lights: what traffic lights showed, and which were run.
        ego: at the newest instant.
        states: what single metrics accumulate themselves, by name; see :class:`.metric.Metric`.
    """

    steps: int = 0
    start_s: float = 0.0
    distance: float = 0.0
    outside: float = 0.0
    tail_first: float = 0.0
    cut: float = 0.0
    s: float = 0.0
    furthest: float = 0.0
    offset: float = 0.0
    at_fault: dict[str, int] = field(default_factory=dict)
    contacts: dict[str, int] = field(default_factory=dict)
    off_road: bool = False
    far_off_road: bool = False
    ttc: float = NEVER
    min_ttc: float = NEVER
    comfort: ComfortAccumulator = field(default_factory=ComfortAccumulator)
    comfort_with_history: ComfortAccumulator = field(default_factory=ComfortAccumulator)
    backward: Float = field(default_factory=lambda: np.zeros(0))
    oncoming: float = 0.0
    lane_run: float = 0.0
    left_lane: bool = False
    plan: PlannedTrajectory | None = None
    plans_compared: int = 0
    plans_disagree: bool = False
    overspeed: float = 0.0
    hugsim: float = 0.0
    feasibility: Feasibility = field(default_factory=Feasibility)
    first_impact: float | None = None
    impact_position: tuple[float, float] | None = None
    pushes: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    impulse: float = 0.0
    delta_v: float = 0.0
    secondary: int = 0
    hit: frozenset[str] = frozenset()
    lights: TrafficLights = NO_LIGHTS
    ego: EgoSample | None = None
    states: Mapping[str, Any] = field(default_factory=dict)

    @property
    def collisions(self) -> int:
        """Contacts of the ego begun so far."""
        return sum(self.contacts.values())
