"""A recorded drive as JSON: everything of every instant that a page shows beside the pictures."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from real2sim_proto import decode
from real2sim_proto.plans import PLAN

from ...datasets.drive import EpisodeDrive
from ...geometry.rotation import matrix_to_quaternion
from ...world import World, plan_in_world
from ...world.ego.plan import PlannedTrajectory
from ...world.recording.recording import Recording


def playback_of(recording: Recording, drive: EpisodeDrive, *, reason: str | None) -> dict[str, Any]:
    """Times, poses, scores, plans and events by instant.

    ``tracks``, ``ego`` and ``times_us`` are as those of a physics rollout (`rollouts.describe`);
    ``metrics`` has a list for each score, ``plans`` poses (x [m], y [m], yaw [rad], world) that
    were planned from each instant, ``speeds`` is of the ego [m/s];
    ``reason`` says why the episode is over.
    """
    worlds = drive.worlds
    seen = [world.observe() for world in worlds]
    names = list(dict.fromkeys(name for one in seen for name in one.metrics))
    return {
        "kind": "drive",
        "scene": recording.scene,
        "scenario_id": recording.scenario_id,
        "scenario_revision": recording.scenario_revision,
        "start_us": worlds[0].t_us,
        "end_us": worlds[-1].t_us,
        "times_us": [world.t_us for world in worlds],
        "steps": [world.steps for world in worlds],
        "reason": reason,
        "ego": _ego(worlds),
        "speeds": [round(float(np.hypot(*world.motion.velocity)), 4) for world in worlds],
        "tracks": _tracks(worlds),
        "metrics": {name: [_number(one.metrics.get(name)) for one in seen] for name in names},
        "scores": list(recording.scores),
        "events": [event.fields() for one in seen for event in one.events],
        "plans": _plans(recording, worlds),
    }


def _ego(worlds: tuple[World, ...]) -> dict[str, Any]:
    poses = np.stack([np.asarray(world.T_world_body) for world in worlds])
    return {
        "times_us": [world.t_us for world in worlds],
        "positions": _rounded(poses[:, :3, 3]),
        "quaternions": _rounded(matrix_to_quaternion(poses[:, :3, :3])),
        "size": list(worlds[0].scene.ego_size),
    }


def _tracks(worlds: tuple[World, ...]) -> dict[str, Any]:
    tracks: dict[str, Any] = {}
    rows = defaultdict[str, list[tuple[int, Any, Any]]](list)
    for world in worlds:
        agents = world.agents
        for k, subject in enumerate(agents.objects):
            kept = {"category": subject.category, "size": list(subject.size)}
            tracks.setdefault(subject.object_id, kept)
            rows[subject.object_id].append((world.t_us, agents.positions[k], agents.quaternions[k]))
    for object_id, found in rows.items():
        times, positions, quaternions = zip(*found, strict=True)
        tracks[object_id] |= {
            "times_us": list(times),
            "positions": _rounded(positions),
            "quaternions": _rounded(quaternions),
        }
    return tracks


def _plans(recording: Recording, worlds: tuple[World, ...]) -> list[Any]:
    """What was planned from each instant; none where a plan was kept, or is no trajectory."""
    by_step = {world.steps: world for world in worlds}
    plans = dict[int, Any]()
    for entry in recording.entries:
        fields = decode(entry.payload) if entry.kind == "action" else {}
        world = by_step.get(entry.step)
        if fields.get("plan") is None or world is None:
            continue
        plan = plan_in_world(PLAN.validate_python(fields["plan"]), world.motion)
        if isinstance(plan, PlannedTrajectory):
            plans[entry.step] = _rounded(plan.poses)
    return [plans.get(world.steps, []) for world in worlds]


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 5)


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), 4).tolist()
