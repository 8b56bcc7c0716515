"""The observation of one committed instant, apart from images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from .agents import Agents, agent_fields
from .ego.motion import Motion
from .ego.route import Command
from .events import Event
from .path import Float


@dataclass(frozen=True, eq=False)
class Observation:
    """The world at one instant, as the policy gets it.

    Attributes:
        step, t_us, revision: instant, and number of edits so far.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, standing on the ground.
        ego_size: (length, width, height) of the ego box [m].
        command: which way the recorded drive turns next.
        route: [20, 2] float64, the recorded way ahead in the vehicle frame [m].
        agents: all objects, or None where the episode is not privileged.
        events: of the step that led here.
        metrics: see :func:`~.scoring.running_metrics`.
        terminated, truncated, reason: how the episode ended, if it did.
        warming_up: whether the ego still moves as recorded.
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

    def ego_fields(self) -> dict[str, Any]:
        """The wire's EgoState as a plain map."""
        motion = self.motion
        return {
            "position": self.T_world_vehicle[:3, 3].tolist(),
            "quaternion": _quaternion(self.T_world_vehicle),
            "yaw": math.remainder(motion.yaw, math.tau),
            "speed": motion.speed,
            "lateral_speed": motion.lateral_speed,
            "acceleration": motion.acceleration,
            "steering": motion.steering,
            "yaw_rate": motion.yaw_rate,
            "size": self.ego_size,
        }

    def obs_fields(self) -> dict[str, Any]:
        """The wire's Obs as a plain map, without ``frames`` and ``timing``."""
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
        }


def _quaternion(T_world_vehicle: Float) -> tuple[float, float, float, float]:
    """wxyz, w >= 0, of a vehicle that stands upright: one case of four, and no arrays."""
    (xx, xy, xz, _), (yx, yy, yz, _), (zx, zy, zz, _), _ = T_world_vehicle.tolist()
    # With the z axis up, w^2 + z^2 is at least a half, so the larger of the two is a safe pivot.
    w, z = 1 + xx + yy + zz, 1 - xx - yy + zz
    q = (w, zy - yz, xz - zx, yx - xy) if w >= z else (yx - xy, xz + zx, yz + zy, z)
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0])
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
