"""The observation of one committed instant, without images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .._records import made_quickly
from ..scene.lane import Lane
from ..scene.lane_graph import LaneGraph
from .agents import Agents, Event, agent_fields
from .ego.motion import Motion
from .path import Command, Float
from .storyboard.program import ShownSignal

RADIUS = 60.0
"""Maximum distance of centre line points from the vehicle [m]."""
SPACING = 5.0
"""Between places along a lane, at most [m]."""
MAX_LANES, MAX_PLACES = 32, 32
"""The nearest lanes, and of each the places nearest to its own nearest one."""


class LanePiece(NamedTuple):
    """A piece of a lane.

    Attributes:
        lane: lane of the map.
        places: [K, 4] float64, x, y [m], heading [rad] of the centre line, world frame, and lane
            width [m].
    """

    lane: Lane
    places: Float

    def fields(self) -> dict[str, Any]:
        """The wire's LaneShown as a plain map."""
        lane = self.lane
        return {
            "lane_id": lane.lane_id,
            "kind": lane.kind,
            "places": self.places,
            "speed_limit": lane.speed_limit,
            "successors": list(lane.successors),
            "left": lane.left,
            "right": lane.right,
            "opposite": lane.opposite,
            "may_change_left": lane.may_change_left,
            "may_change_right": lane.may_change_right,
            "junction": lane.junction,
        }


@dataclass(frozen=True, eq=False)
class _Places:
    """Centre line points of all lanes [P, 4] as in :class:`LanePiece`, lane indices [P], and a
    k-d tree of the points."""

    values: Float
    lane: NDArray[np.int64]
    tree: cKDTree


_KNOWN: WeakKeyDictionary[LaneGraph, _Places] = WeakKeyDictionary()


def lanes_around(graph: LaneGraph, x: float, y: float) -> tuple[LanePiece, ...]:
    """Pieces of the lanes near a place [m], the nearest lane first."""
    if graph not in _KNOWN:
        _KNOWN[graph] = _places_of(graph)
    known = _KNOWN[graph]
    near = np.array(sorted(known.tree.query_ball_point((x, y), RADIUS)), dtype=np.int64)
    if not len(near):
        return ()
    distances = np.hypot(*(known.values[near, :2] - (x, y)).T)
    # By distance, then by number, so that ties fall alike everywhere.
    order = near[np.lexsort((near, distances))]
    _, first = np.unique(known.lane[order], return_index=True)
    lanes = list(graph.lanes.values())
    inside = set(near.tolist())
    return tuple(
        LanePiece(lanes[known.lane[k]], known.values[_run(int(k), known.lane, inside)])
        for k in order[np.sort(first)[:MAX_LANES]]
    )


def _run(nearest: int, lane: NDArray[np.int64], inside: set[int]) -> slice:
    """Range of points around the nearest one, in its lane and within reach."""

    def reaches(k: int) -> bool:
        return 0 <= k < len(lane) and lane[k] == lane[nearest] and k in inside

    low = high = nearest
    while high - low + 1 < MAX_PLACES and (reaches(low - 1) or reaches(high + 1)):
        low -= reaches(low - 1)
        if high - low + 1 < MAX_PLACES:
            high += reaches(high + 1)
    return slice(low, high + 1)


def _places_of(graph: LaneGraph) -> _Places:
    parts = [_sampled(lane) for lane in graph.lanes.values()]
    values = np.concatenate(parts) if parts else np.zeros((0, 4))
    lane = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return _Places(values, lane, cKDTree(values[:, :2]))


def _sampled(lane: Lane) -> Float:
    s = np.linspace(0.0, lane.length, int(np.ceil(lane.length / SPACING)) + 1)
    columns = (lane.centre[:, 0], lane.centre[:, 1], lane.headings, lane.widths)
    return np.column_stack([np.interp(s, lane.s, column) for column in columns])


@made_quickly
@dataclass(frozen=True, eq=False)
class Observation:
    """The world at one instant, as observed by the policy.

    Attributes:
        step, t_us, revision: clock step, time [us], and number of edits.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, pose of the ego's body, which carries the cameras.
        ego_size: (length, width, height) of the ego box [m].
        command: next turn direction of the recorded drive.
        route: [20, 2] float64, recorded path ahead, vehicle frame [m].
        agents: all objects; None if the episode is not privileged.
        events: events of the last step.
        metrics: see :func:`~.scoring.running_metrics`.
        terminated, truncated, reason: how the episode ended, if it did.
        warming_up: whether the ego is still replaying the recording.
        lap: number of times the ego has been reset to the start of the route.
        drawn: values sampled in the step, by name.
        truth: true ego state, if ``motion`` and ``T_world_vehicle`` are an estimate with errors and
            the episode is privileged; else None.
        signals: traffic signals of the storyboard.
        lanes: map lanes near the ego; privileged episodes only.
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
        """The wire's EgoState of ``truth`` as a plain map; ``truth`` must not be None."""
        assert self.truth is not None
        return ego_fields(*self.truth, self.ego_size)

    def obs_fields(self) -> dict[str, Any]:
        """The wire's Obs as a plain map, without ``frames`` and ``timing``.

        Optional fields are only included if they differ from their defaults.
        """
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
    """wxyz, w >= 0, of an upright vehicle: one case of four, and no arrays."""
    (xx, xy, xz, _), (yx, yy, yz, _), (zx, zy, zz, _), _ = T_world_vehicle.tolist()
    # With the z axis up, w^2 + z^2 is at least a half, so the larger of the two is a safe pivot.
    w, z = 1 + xx + yy + zz, 1 - xx - yy + zz
    q = (w, zy - yz, xz - zx, yx - xy) if w >= z else (yx - xy, xz + zx, yz + zy, z)
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0])
    # A level body would have negative zeros.
    return (
        q[0] / length + 0.0,
        q[1] / length + 0.0,
        q[2] / length + 0.0,
        q[3] / length + 0.0,
    )
