"""What moves an entity sideways: each gives its offset from its way a short time later."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from real2sim_proto.storyboard_actions import LateralDistanceAction, Shape

from .dynamics import progress
from .entity_state import EntityState, Shifted
from .view import View, across

DONE = 1e-9

AT_PLACE = 0.01
"""A distance sideways is reached within this [m]."""


@dataclass(frozen=True)
class OffsetChange:
    """From one offset to another in a form of time, or of the way."""

    token: int
    shape: Shape
    start: float
    end: float
    extent: float
    by_way: bool = False
    done: float = 0.0

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """``h`` seconds and ``way`` metres on."""
        done = self.done + (abs(way) if self.by_way else h)
        u = done / self.extent
        offset = self.start + (self.end - self.start) * progress(self.shape, u)
        return Shifted(offset, None if u >= 1.0 - DONE else replace(self, done=done))


@dataclass(frozen=True)
class FollowOffset:
    """Goes on being so far beside where another is in its lane."""

    token: int
    other: str
    value: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """``h`` seconds and ``way`` metres on."""
        return Shifted(self.value + lane_offset(view.entities[self.other], view), self)


@dataclass(frozen=True)
class HoldOffset:
    """Goes on being so far beside the middle of its lane."""

    token: int
    value: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """``h`` seconds and ``way`` metres on."""
        return Shifted(self.value, self)


@dataclass(frozen=True)
class KeepAside:
    """Keeps a distance sideways from another, within limits of speed and acceleration."""

    token: int
    action: LateralDistanceAction
    side: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """``h`` seconds and ``way`` metres on."""
        other, limits = view.entities[self.action.entity], self.action.limits
        distance = float(self.action.distance)
        if self.action.freespace:
            distance += (actor.size[1] + other.size[1]) / 2
        yaw = actor.h if actor.way is None else actor.way.path.at(actor.s)[3]
        now = across(yaw, actor.x - other.x, actor.y - other.y)
        error = self.side * distance - now
        speed = math.inf if limits.speed is None else float(limits.speed)
        if limits.acceleration is not None:
            # What can still be braked away before it is there, and what can be gained by now.
            gain = float(limits.acceleration)
            speed = min(speed, math.sqrt(2.0 * gain * abs(error)), abs(actor.drift) + gain * h)
        step = min(max(error, -speed * h), speed * h)
        there = abs(error - step) < AT_PLACE
        return Shifted(actor.offset + step, None if there and not self.action.continuous else self)


def lane_offset(actor: EntityState, view: View) -> float:
    """How far an entity is to the left of the middle of its lane, as it drives [m]."""
    if actor.way is not None and actor.way.lane:
        return actor.offset
    on_lane = actor.on_lane(view.network)
    return on_lane.offset
