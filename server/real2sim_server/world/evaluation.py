"""What the scores are given of a world."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from real2sim_proto.episode import ResetSpec

from ..edit.tracks import sample
from ..scene import Scene
from .agents import Agents
from .collision.contact import REAR_OVERHANG
from .collision.contact_kernels import headings
from .collision.step_contacts import StepContacts
from .ego.reference import PlannedTrajectory
from .ego.vehicle import Motion, logged_motion
from .episode import Clock
from .events import Event
from .path import LoggedPath, PathPoint
from .scoring import EgoSample, Others, ScoringContext
from .scoring.comfort import window_of
from .scoring.instant import VEHICLES


class PendingStep(NamedTuple):
    """A step that has been made and not judged yet.

    Attributes:
        course: given to the ego; None where there was no new trajectory.
        events: that led to it.
        left: by its impacts; None where bodies pass through each other.
    """

    course: PlannedTrajectory | None
    events: tuple[Event, ...]
    left: StepContacts | None


LANE_WAY = 5.0
"""Recorded vehicles that moved less than this show no lane [m]."""


def scoring_context(
    scene: Scene, spec: ResetSpec, clock: Clock, path: LoggedPath, start_s: float
) -> ScoringContext:
    """What stays the same over an episode on ``scene``."""
    times = clock.start_us + clock.dt_us * np.arange(clock.horizon + 1)
    transforms, _ = sample(scene.ego, np.minimum(times, scene.end_us))
    near, expert = start_s, []
    for x, y in transforms[:, :2, 3].tolist():
        near = path.nearest(x, y, near_s=near).s
        expert.append(near)
    lanes = tuple(
        o.trajectory.positions[:, :2]
        for o in scene.objects.values()
        if o.category in VEHICLES and o.trajectory.extent > LANE_WAY
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
    )


def _history(scene: Scene, spec: ResetSpec, clock: Clock) -> tuple[tuple[float, float], ...]:
    """Speed and yaw of the log at the clock steps before the start, as far as it goes back."""
    window = window_of(clock.dt_us * 1e-6) - 1
    times = [clock.start_us - clock.dt_us * k for k in range(window, 0, -1)]
    motions = [logged_motion(scene.ego, t, spec.ego) for t in times if t >= scene.start_us]
    yaws = np.unwrap([m.yaw for m in motions]).tolist() if motions else []
    return tuple((m.speed, yaw) for m, yaw in zip(motions, yaws, strict=True))


def ego_sample(motion: Motion, near: PathPoint, z: float) -> EgoSample:
    """The ego for the scores."""
    return EgoSample(
        x=motion.x,
        y=motion.y,
        yaw=motion.yaw,
        speed=motion.speed,
        lateral_speed=motion.lateral_speed,
        acceleration=motion.acceleration,
        yaw_rate=motion.yaw_rate,
        steering=motion.steering,
        s=near.s,
        offset=near.offset,
        path_yaw=near.yaw,
        z=z,
    )


def others_of(agents: Agents) -> Others:
    """Objects for the scores."""
    return Others(
        ids=tuple([o.object_id for o in agents.objects]),
        categories=tuple([o.category for o in agents.objects]),
        centres=agents.positions,
        yaws=headings(agents.quaternions),
        sizes=agents.sizes,
        velocities=np.ascontiguousarray(agents.velocities[:, :2]),
    )
