"""The observation of one committed instant, apart from images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .._records import made_quickly
from .agents import Agents, agent_fields
from .ego.motion import Motion
from .ego.route import Command
from .events import Event
from .lanes_around import LanePiece
from .path import Float
from .storyboard.shown_signal import ShownSignal


@made_quickly
@dataclass(frozen=True, eq=False)
class Observation:
    """The world at one instant, as the policy gets it.

    Attributes:
        step, t_us, revision: instant, and number of edits so far.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, its body, which carries the cameras.
        ego_size: (length, width, height) of the ego box [m].
        command: which way the recorded drive turns next.
        route: [20, 2] float64, the recorded way ahead in the vehicle frame [m].
        agents: all objects, or None where the episode is not privileged.
        events: of the step that led here.
        metrics: see :func:`~.scoring.running_metrics`.
        terminated, truncated, reason: how the episode ended, if it did.
        warming_up: whether the ego still moves as recorded.
        lap: times that the ego has been put back to the start of the route.
        drawn: what the seed has drawn in the step, by name.
        truth: of an ego whose ``motion`` and ``T_world_vehicle`` are an estimate with errors; None
            where they are the truth, or the episode is not privileged.
        signals: traffic signals of the storyboard.
        lanes: of the map near the ego, of privileged episodes.
    """

    step: int
    t_us: int
    revision: int
    motion: Motion
    T_world_vehicle: Float
    ego_size: tuple[float, float, float]
    command: Command
    route: Float
    agents: Agents | None
    events: tuple[Event, ...]
    metrics: dict[str, float]
    terminated: bool
    truncated: bool
    reason: str | None
    warming_up: bool = False
    lap: int = 0
    drawn: Mapping[str, float] = field(default_factory=dict)
    truth: tuple[Motion, Float] | None = None
    signals: tuple[ShownSignal, ...] = ()
    lanes: tuple[LanePiece, ...] = ()

    def ego_fields(self) -> dict[str, Any]:
        """The wire's EgoState as a plain map."""
        return ego_fields(self.motion, self.T_world_vehicle, self.ego_size)

    def truth_fields(self) -> dict[str, Any]:
        """The wire's EgoState of the ego where it is, as a plain map; there has to be a truth."""
        assert self.truth is not None
        return ego_fields(*self.truth, self.ego_size)

    def obs_fields(self) -> dict[str, Any]:
        """The wire's Obs as a plain map, without ``frames`` and ``timing``; what few episodes have
        is there where it is more than its default."""
        extra: dict[str, Any] = {}
        if self.lap:
            extra["lap"] = self.lap
        if self.drawn:
            extra["drawn"] = dict(self.drawn)
        if self.truth is not None:
            extra["ego_truth"] = self.truth_fields()
        if self.signals:
            extra["signals"] = [_signal_fields(signal) for signal in self.signals]
        if self.lanes:
            extra["lanes"] = [piece.fields() for piece in self.lanes]
        return {
            "step": self.step,
            "t_us": self.t_us,
            "revision": self.revision,
            "ego": self.ego_fields(),
            "command": self.command,
            "route": self.route,
            "agents": agent_fields(self.agents) if self.agents is not None else [],
            "events": [event.fields() for event in self.events],
            "metrics": dict(self.metrics),
            "terminated": self.terminated,
            "truncated": self.truncated,
            "reason": self.reason,
            "warming_up": self.warming_up,
            **extra,
        }


def _signal_fields(signal: ShownSignal) -> dict[str, Any]:
    return {
        "signal_id": signal.signal_id,
        "state": signal.state,
        "stop_line": signal.stop_line,
    }


def ego_fields(
    motion: Motion, T_world_vehicle: Float, size: tuple[float, float, float]
) -> dict[str, Any]:
    """The wire's EgoState as a plain map; ``size`` of the ego's box [m]."""
    gear = {"gear": "reverse"} if motion.reversing else {}
    return {
        "position": T_world_vehicle[:3, 3].tolist(),
        "quaternion": _quaternion(T_world_vehicle),
        "yaw": math.remainder(motion.yaw, math.tau),
        "speed": motion.speed,
        "lateral_speed": motion.lateral_speed,
        "acceleration": motion.acceleration,
        "steering": motion.steering,
        "yaw_rate": motion.yaw_rate,
        "size": size,
        **gear,
    }


def _quaternion(T_world_vehicle: Float) -> tuple[float, float, float, float]:
    """wxyz, w >= 0, of a vehicle that stands upright: one case of four, and no arrays."""
    (xx, xy, xz, _), (yx, yy, yz, _), (zx, zy, zz, _), _ = T_world_vehicle.tolist()
    # With the z axis up, w^2 + z^2 is at least a half, so the larger of the two is a safe pivot.
    w, z = 1 + xx + yy + zz, 1 - xx - yy + zz
    q = (w, zy - yz, xz - zx, yx - xy) if w >= z else (yx - xy, xz + zx, yz + zy, z)
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0])
    # A body that stands level would have minus zeros.
    return (
        q[0] / length + 0.0,
        q[1] / length + 0.0,
        q[2] / length + 0.0,
        q[3] / length + 0.0,
    )
