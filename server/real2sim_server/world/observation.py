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

from real2sim_proto.episode import ResetSpec

from .._records import made_quickly
from ..edit import ObjectState
from ..edit.tracks import sample
from ..scene import Scene
from ..scene.lane import Lane
from ..scene.lane_graph import LaneGraph
from .agents import Agents, Event, Lamps, agent_fields
from .boxes import REAR_OVERHANG, headings
from .collision.contact_state import StepContacts
from .collision.sweep import StepStart
from .common import cache_by_identity
from .ego_motion import Motion, logged_motion
from .episode import EpisodeClock
from .path import Command, Float, LoggedPath, LoopTransform, PathPoint
from .plan import PlannedTrajectory
from .scoring import EgoSample, ObjectSamples, ScoringContext
from .scoring.comfort import comfort_window
from .scoring.instant import VEHICLES
from .scoring.road import RoadMap
from .storyboard.program import ShownSignal

# --- Metric inputs --------------------------------------------------------------------------------


class PendingStep(NamedTuple):
    """A step after its motion and before its evaluation.

    Attributes:
        start: the world before the step.
        plan: new trajectory of the ego, or None.
        events: events of the move.
        contacts: contacts of its impacts; None without collision response.
        loop: loop reset before the move, or None.
    """

    start: StepStart
    plan: PlannedTrajectory | None
    events: tuple[Event, ...]
    contacts: StepContacts | None
    loop: LoopTransform | None = None


LANE_LENGTH = 5.0
"""Minimum distance that a recorded vehicle moves for its path to count as a lane [m]."""


def scoring_context(
    scene: Scene, spec: ResetSpec, clock: EpisodeClock, path: LoggedPath, start_s: float
) -> ScoringContext:
    """The constant context of an episode on ``scene``."""
    times = clock.start_us + clock.dt_us * np.arange(clock.horizon + 1)
    within = times[times <= scene.end_us]
    transforms, _ = sample(scene.ego, within)
    s, expert = start_s, list[float]()
    for x, y in transforms[:, :2, 3].tolist():
        s = path.nearest(x, y, near_s=s).s
        expert.append(s)
    expert += _expert_beyond_log(scene, spec, times[len(within) :])
    lanes = tuple(
        o.trajectory.positions[:, :2]
        for o in scene.objects.values()
        if o.category in VEHICLES and o.trajectory.extent > LANE_LENGTH
    )
    return ScoringContext(
        dt=clock.dt_us * 1e-6,
        horizon=clock.horizon,
        ego_size=scene.ego_size,
        rear_overhang=REAR_OVERHANG,
        ego_mass=spec.ego.vehicle.mass,
        route=path.positions[:, :2],
        lanes=lanes,
        corridor=spec.scoring.corridor,
        lane=spec.scoring.lane,
        speed_limit=spec.scoring.speed_limit,
        start_s=start_s,
        route_end_s=expert[-1],
        expert_s=tuple(expert),
        history=_history(scene, spec, clock),
        warmup_steps=spec.warmup_us // clock.dt_us,
        background=spec.contact.background,
        reactive=reactive(spec),
        road_map=RoadMap.of(scene.lanes),
    )


def _expert_beyond_log(scene: Scene, spec: ResetSpec, times: NDArray[np.int64]) -> list[float]:
    """Route positions [m] of the recorded drive at times after its end.

    A loop repeats the drive in each lap; otherwise it continues at its mean speed.
    """
    if not len(times):
        return []
    ego, path = scene.ego, LoggedPath(scene.ego)
    if spec.beyond_log != "loop":
        speed = path.length / (ego.end_us - ego.start_us)
        return [path.length + speed * (t - ego.end_us) for t in times.tolist()]
    s, places = 0.0, []
    for x, y in ego.positions[:, :2].tolist():
        s = max(path.nearest(x, y, near_s=s).s, s)
        places.append(s)
    laps, within = np.divmod(times - ego.start_us, ego.end_us - ego.start_us)
    found = laps * path.length + np.interp(within, ego.times_us - ego.start_us, places)
    return [float(s) for s in found]


def reactive(spec: ResetSpec) -> bool:
    """Whether any other road user may react to the ego."""
    agents = spec.agents
    blind = {"log", "constant_velocity"}
    kinds = {agents.default, *(driver.kind for driver in agents.drivers.values())}
    return agents.ego_off_log != "replay" or not kinds <= blind


def _history(scene: Scene, spec: ResetSpec, clock: EpisodeClock) -> tuple[tuple[float, float], ...]:
    """Speed and yaw of the log at the clock steps before the start."""
    window = comfort_window(clock.dt_us * 1e-6) - 1
    times = [clock.start_us - clock.dt_us * k for k in range(window, 0, -1)]
    motions = [logged_motion(scene.ego, t, spec.ego) for t in times if t >= scene.start_us]
    yaws = np.unwrap([m.yaw for m in motions]).tolist() if motions else []
    return tuple((m.speed, yaw) for m, yaw in zip(motions, yaws, strict=True))


def ego_sample(motion: Motion, near: PathPoint, z: float, *, laps: float = 0.0) -> EgoSample:
    """The ego for the scores; ``laps``: length of the completed laps of a loop [m]."""
    return EgoSample(
        x=motion.x,
        y=motion.y,
        yaw=motion.yaw,
        speed=motion.speed,
        lateral_speed=motion.lateral_speed,
        acceleration=motion.acceleration,
        yaw_rate=motion.yaw_rate,
        steering=motion.steering,
        s=near.s + laps,
        offset=near.offset,
        path_yaw=near.yaw,
        z=z,
    )


def object_samples(agents: Agents) -> ObjectSamples:
    """Objects for the scores."""
    ids, categories = _named(agents.objects)
    return ObjectSamples(
        ids=ids,
        categories=categories,
        centres=agents.positions,
        yaws=headings(agents.quaternions),
        sizes=agents.sizes,
        velocities=np.ascontiguousarray(agents.velocities[:, :2]),
    )


@cache_by_identity
def _named(objects: tuple[ObjectState, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Ids and categories, cached: many steps share the same tuple of objects."""
    return tuple([o.object_id for o in objects]), tuple([o.category for o in objects])


RADIUS = 60.0
"""Maximum distance of centre line points from the vehicle [m]."""
SPACING = 5.0
"""Maximum distance between points along a lane [m]."""
MAX_LANES, MAX_PLACES = 32, 32
"""Maximum numbers of lanes, and of points per lane; the nearest ones are used."""


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
    """Centre line points of all lanes, with a k-d tree.

    Points [P, 4] as in :class:`LanePiece`, lane indices [P], and the tree of the points.
    """

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
    # Sort by distance, then by index, so that ties have the same order everywhere.
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
        lamps: lit lamps of the objects.
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
    lamps: Lamps = field(default_factory=dict)

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
            "agents": agent_fields(self.agents, self.lamps) if self.agents is not None else [],
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
    """wxyz, w >= 0, of an upright vehicle: only one of the four cases, without arrays."""
    (xx, xy, xz, _), (yx, yy, yz, _), (zx, zy, zz, _), _ = T_world_vehicle.tolist()
    # With the z axis up, w^2 + z^2 is at least a half, so the larger of the two is a safe pivot.
    w, z = 1 + xx + yy + zz, 1 - xx - yy + zz
    q = (w, zy - yz, xz - zx, yx - xy) if w >= z else (yx - xy, xz + zx, yz + zy, z)
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0])
    # Avoids the negative zeros of a level body.
    return (
        q[0] / length + 0.0,
        q[1] / length + 0.0,
        q[2] / length + 0.0,
        q[3] / length + 0.0,
    )
