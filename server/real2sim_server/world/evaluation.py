"""Metric inputs taken from a world: the context of an episode and samples of an instant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import ResetSpec

from ..edit import ObjectState
from ..edit.tracks import sample
from ..scene import Scene
from .agents import Agents, Event
from .boxes import REAR_OVERHANG, headings
from .collision.contact_state import StepContacts
from .collision.sweep import StepStart
from .common import cache_by_identity
from .ego.motion import Motion, logged_motion
from .ego.plan import PlannedTrajectory
from .episode import EpisodeClock
from .path import LoggedPath, LoopTransform, PathPoint
from .scoring import EgoSample, ObjectSamples, ScoringContext
from .scoring.comfort import comfort_window
from .scoring.instant import VEHICLES
from .scoring.road import RoadMap


class PendingStep(NamedTuple):
    """A step that has moved and is not evaluated yet.

    Attributes:
        start: the world before the step.
        plan: new trajectory of the ego, or None.
        events: events of the move.
        contacts: contacts of its impacts; None without collision response.
        seam: loop reset before the move, or None.
    """

    start: StepStart
    plan: PlannedTrajectory | None
    events: tuple[Event, ...]
    contacts: StepContacts | None
    seam: LoopTransform | None = None


LANE_LENGTH = 5.0
"""Recorded vehicles that moved less than this show no lane [m]."""


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
