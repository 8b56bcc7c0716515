"""What the scores need to know of one instant, and of the episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..path import Float

Side = Literal["front", "rear", "lateral", "stopped_ego", "stopped_track"]
"""How ego and object met, after nuPlan's collision types."""

VRU = frozenset({"pedestrian", "cyclist", "motorcycle", "bicycle", "person"})
VEHICLES = frozenset({"car", "vehicle", "van", "truck", "bus", "trailer", "tram"})

DENSITY = 0.25
"""Distance between points of the lines that corridors are made of [m]."""


class EgoSample(NamedTuple):
    """The ego at one instant: rear axle [m], [rad], velocities of it [m/s], [rad/s], [m/s^2]."""

    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    acceleration: float
    yaw_rate: float
    steering: float
    s: float
    offset: float
    path_yaw: float
    z: float


@dataclass(frozen=True, eq=False)
class Others:
    """Objects at one instant, K of them.

    Attributes:
        ids, categories: by row.
        centres: [K, 3] float64, of their boxes, world [m].
        yaws: [K] float64 [rad].
        sizes: [K, 3] float64, (length, width, height) [m].
        velocities: [K, 2] float64, world [m/s].
    """

    ids: tuple[str, ...]
    categories: tuple[str, ...]
    centres: Float
    yaws: Float
    sizes: Float
    velocities: Float


@dataclass(frozen=True)
class ContactNote:
    """A contact of the ego that began in this step, or went on with momentum.

    Attributes:
        object_id: None for the background.
        category: of the object; ``background``.
        side: how they met.
        relative_speed, ego_speed, object_speed: when they met [m/s].
        impulse: on the ego [N s]; zeros where no momentum is exchanged.
        begun: whether the contact began in this step.
    """

    object_id: str | None
    category: str
    side: Side
    relative_speed: float
    ego_speed: float
    object_speed: float
    impulse: tuple[float, float] = (0.0, 0.0)
    begun: bool = True


@dataclass(frozen=True, eq=False)
class PlanNote:
    """A trajectory that the planner sent: absolute times [us], poses x, y [m], yaw [rad], world."""

    times_us: tuple[int, ...]
    poses: tuple[tuple[float, float, float], ...]

    @cached_property
    def _curves(self) -> tuple[Float, Float]:
        """Times [N] [s] and poses [3, N], yaw continuous."""
        poses = np.array(self.poses).T
        turns = poses[2, 1:] - poses[2, :-1]
        if (np.abs(turns) > math.pi).any():
            poses[2] = np.unwrap(poses[2])
        return np.array(self.times_us) * 1e-6, poses

    def sampled(self, at: Float) -> Float:
        """x, y [m] and continuous yaw [rad] at times ``at`` [T] [s] within the plan, [3, T]."""
        times, poses = self._curves
        after = np.minimum(np.maximum(times.searchsorted(at), 1), len(times) - 1)
        before = after - 1
        share = (at - times[before]) / (times[after] - times[before])
        found: Float = poses[:, before] * (1 - share) + poses[:, after] * share
        return found


@dataclass(frozen=True, eq=False)
class Instant:
    """One committed instant.

    Attributes:
        step, t_us: which one.
        ego: the controlled vehicle.
        others: all objects.
        contacts: of the step that led here.
        secondary: contacts between objects that began in it.
        plan: that the step was made with; None where there was no new trajectory.
    """

    step: int
    t_us: int
    ego: EgoSample
    others: Others
    contacts: tuple[ContactNote, ...] = ()
    secondary: int = 0
    plan: PlanNote | None = None


@dataclass(frozen=True, eq=False)
class ScoringContext:
    """What stays the same over an episode.

    Attributes:
        dt: clock step [s].
        horizon: steps.
        ego_size: (length, width, height) [m].
        rear_overhang: rear axle to the rear end of the box [m].
        ego_mass: [kg].
        route: [R, 2] float64, the recorded way [m].
        lanes: polylines [N, 2] of recorded vehicles, whose strips are drivable too.
        corridor, lane: half widths along route and lanes [m].
        speed_limit: [m/s] or None.
        start_s, route_end_s: along the route at the start, and where the log is at the horizon.
        expert_s: where the log is along the route at each step [m]; ``horizon`` + 1 of them.
        history: (speed, yaw) of the log before the start, one a clock step, oldest first.
        no_action_impact: impact speed of a run in which the ego does not react [m/s]; None while
            it is not known, 0 where nothing is hit.
    """

    dt: float
    horizon: int
    ego_size: tuple[float, float, float]
    rear_overhang: float
    ego_mass: float
    route: Float
    lanes: tuple[Float, ...]
    corridor: float
    lane: float
    speed_limit: float | None
    start_s: float
    route_end_s: float
    expert_s: tuple[float, ...]
    history: tuple[tuple[float, float], ...]
    no_action_impact: float | None = None

    @property
    def centre_ahead(self) -> float:
        """Rear axle to the centre of the box [m]."""
        return self.ego_size[0] / 2 - self.rear_overhang

    @cached_property
    def route_tree(self) -> cKDTree:
        """Points of the route; straight on beyond both ends."""
        return cKDTree(_dense(_extended(self.route)))

    @cached_property
    def lane_tree(self) -> cKDTree | None:
        """Points of the lanes; None where there are none."""
        lines = [_dense(line) for line in self.lanes if len(line) > 1]
        return cKDTree(np.vstack(lines)) if lines else None

    def outside(self, points: Float) -> Float:
        """How far points [N, 2] [m] are out of the corridor, [N] [m]; 0 and less within it."""
        beyond: Float = self.route_tree.query(points)[0] - self.corridor
        if self.lane_tree is not None and beyond.max() > 0:
            beyond = np.minimum(beyond, self.lane_tree.query(points)[0] - self.lane)
        return beyond

    def fields(self) -> dict[str, Any]:
        """Plain values, for a recording."""
        plain = {k: getattr(self, k) for k in self.__dataclass_fields__}
        return plain | {
            "route": self.route,
            "lanes": list(self.lanes),
            "expert_s": list(self.expert_s),
            "history": [list(h) for h in self.history],
            "ego_size": list(self.ego_size),
        }

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> ScoringContext:
        """The context that :meth:`fields` gave."""
        return cls(
            **fields
            | {
                "lanes": tuple(np.asarray(line) for line in fields["lanes"]),
                "route": np.asarray(fields["route"]),
                "expert_s": tuple(fields["expert_s"]),
                "history": tuple((v, yaw) for v, yaw in fields["history"]),
                "ego_size": tuple(fields["ego_size"]),
            }
        )


def _extended(line: Float, *, back: float = 10.0, on: float = 60.0) -> Float:
    first = (line[0] - line[1]) / np.linalg.norm(line[0] - line[1])
    last = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return np.vstack([line[0] + back * first, line, line[-1] + on * last])


def _dense(line: Float) -> Float:
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, s[-1], DENSITY), s[-1])
    points: Sequence[Float] = [np.interp(at, s, line[:, k]) for k in (0, 1)]
    return np.stack(points, axis=1)
