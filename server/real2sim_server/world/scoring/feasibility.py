"""Whether a car could have moved so: Waymax's kinematic infeasibility, and what it cannot tell.

Waymax looks at the change of speed and at the curvature of a step. A vehicle that is put to its
places can hop sideways, jump or spin without either, so its way is compared with its speed as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..._records import made_quickly
from .instant import EgoSample, Instant, ScoringContext
from .window import Window

MAX_ACCELERATION, MAX_CURVATURE = 10.4, 0.3
"""Waymax, kinematic infeasibility, for steps of 0.1 s [m/s^2], [1/m]."""

STEP_S = 0.1
"""Shorter clock steps are looked at together: noise of places would be acceleration."""

SLOWEST_CURVATURE = 0.5
"""Below this speed curvature is noise [m/s]."""

PLACE_NOISE = 0.03
"""Of recorded places [m]."""

SLIP = 0.05
"""Way sideways per way ahead that nobody minds, beside what the vehicle model says: the rear axle
is rarely known better."""

SPIN_S, SPIN_NOISE = 1.0, 0.1
"""Turning on the spot: time over which it is looked at [s], noise of headings in it [rad]."""

FASTEST_BACKWARDS = 8.0
"""More than the reverse gear of a car gives [m/s]."""

SETTLED = 0.2
"""Speed across below which a vehicle that was pushed rolls again [m/s]."""


Samples = Window[tuple[EgoSample, float]]


@made_quickly
@dataclass(frozen=True, eq=False)
class Feasibility:
    """The motion of the ego so far.

    Attributes:
        samples: of the last second, newest last, each with the way driven until then [m].
        pushed: whether an impact moved the ego and it slides still; nobody can blame it then.
        steps: that no car could have made.
        first: number of the first of them; None without.
    """

    samples: Samples = field(default_factory=Window)
    pushed: bool = False
    steps: int = 0
    first: int | None = None

    def updated(self, instant: Instant, way: float, context: ScoringContext) -> Feasibility:
        """After one more clock step; ``way``: driven so far [m]."""
        ego = instant.ego
        pushed = bool(instant.contacts) and any(c.impulse != (0.0, 0.0) for c in instant.contacts)
        if pushed or (self.pushed and not _settled(ego)):
            return Feasibility(Window((ego, way)), True, self.steps, self.first)
        kept = max(round(SPIN_S / context.dt), 1) + 1
        samples = self.samples.pushed((ego, way), kept)
        if _is_feasible(samples, context.dt):
            return Feasibility(samples, False, self.steps, self.first)
        first = instant.step if self.first is None else self.first
        return Feasibility(samples, False, self.steps + 1, first)


def _settled(ego: EgoSample) -> bool:
    rolling = abs(ego.yaw_rate) <= MAX_CURVATURE * abs(ego.speed) + SPIN_NOISE
    return abs(ego.lateral_speed) < SETTLED and rolling


def _is_feasible(samples: Samples, dt: float) -> bool:
    stride = max(round(STEP_S / dt), 1)
    now, way = samples.newest()
    if len(samples) > stride:
        before, _ = samples.newest(stride)
        if not _follows(before, now, stride * dt):
            return False
    turns = max(round(SPIN_S / dt), 1)
    if len(samples) <= turns:
        return True
    before, driven = samples.newest(turns)
    return abs(now.yaw - before.yaw) <= MAX_CURVATURE * (way - driven) + SPIN_NOISE


def _follows(before: EgoSample, now: EgoSample, h: float) -> bool:
    """Whether a car gets from one sample to another ``h`` seconds later."""
    if abs(now.speed - before.speed) > MAX_ACCELERATION * h * (1 + 1e-9):
        return False
    if now.speed < -FASTEST_BACKWARDS and now.speed < before.speed:
        return False
    speed = max(
        math.hypot(before.speed, before.lateral_speed), math.hypot(now.speed, now.lateral_speed)
    )
    turn = math.remainder(now.yaw - before.yaw, math.tau)
    if speed > SLOWEST_CURVATURE and abs(turn) > MAX_CURVATURE * speed * h:
        return False
    cos, sin = math.cos(before.yaw + turn / 2), math.sin(before.yaw + turn / 2)
    dx, dy = now.x - before.x, now.y - before.y
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    reach = MAX_ACCELERATION * h * h
    sideways = (before.lateral_speed + now.lateral_speed) / 2 * h
    if abs(aside - sideways) > reach / 4 + SLIP * abs(ahead) + PLACE_NOISE:
        return False
    # A vehicle that is put to its places has the speed of the step before.
    return abs(ahead - before.speed * h) <= reach + PLACE_NOISE
