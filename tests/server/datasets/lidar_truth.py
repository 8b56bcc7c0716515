"""LiDAR point labels of a synthetic street compared with its rays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.labels import boxes_at, lidar_points
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.render.cast import select_caster
from real2sim_server.scene import Lidar, Scene
from real2sim_server.synthetic import SyntheticLog

EDGE_M = 0.3
"""Nearer to a border between objects a point is not judged."""
IN_BOX = 0.1
"""True points of a vehicle are in its box, enlarged by this [m]."""


def judged_share(
    scene: Scene, log: SyntheticLog, lidar: Lidar, frames: Sequence[int]
) -> tuple[float, int]:
    """Share of points with the correct object, and how many were judged.

    A point counts if the true ray around it hits one object only: no neighbouring ray within
    EDGE_M of it sees another.
    """
    drive = ScenarioDrive(scene, ScenarioState.of(scene))
    names = {o.object_id: o.instance_id for o in drive.state.tracks.at(0).objects}
    right = judged = 0
    for frame in frames:
        t_us = int(scene.frame_times_us[frame])
        moment = drive.at(t_us)
        found = lidar_points(
            drive, moment, boxes_at(moment.placed), lidar, seed=0, caster=select_caster()
        )
        truth, clear = _truth(log, lidar, t_us, names)
        row, column = _places(found, lidar)
        kept = clear[row, column]
        right += int((truth[row, column] == found.instance)[kept].sum())
        judged += int(kept.sum())
    return right / judged, judged


def _places(found, lidar: Lidar):
    times = lidar.beams.time_us[0]
    column = np.argmin(np.abs(times[None] - found.time_us[:, None]), axis=1)
    order = np.argsort(lidar.beams.elevation.mean(axis=1), kind="stable")
    return order[found.beam], column


def _truth(log: SyntheticLog, lidar: Lidar, t_us: int, names: dict[str, int]):
    """Object of each ray [B, C], and rays away from edges."""
    ranges, _ = log.sweep(lidar, t_us)
    times = lidar.beams.time_us[0]
    poses = np.stack([log.ego.transform(t_us + t) for t in times]) @ lidar.T_vehicle_lidar
    local = lidar.beams.directions * ranges[..., None]
    points = np.einsum("cij,bcj->bci", poses[:, :3, :3], local) + poses[:, :3, 3]
    instance = np.zeros(ranges.shape, int)
    for track in log.tracks:
        if not track.trajectory.covers(t_us):
            continue
        for k, t in enumerate(times):
            pose = track.trajectory.transform(int(t_us + t))
            inside = apply_transform(invert_transform(pose), points[:, k])
            half = np.array(track.size) / 2
            own = (np.abs(inside) <= half + IN_BOX).all(axis=1) & (inside[:, 2] > -half[2] + 0.05)
            instance[own & (ranges[:, k] > 0), k] = names[track.object_id]
    return instance, (ranges > 0) & _away(points, instance, lidar)


def _away(points, instance, lidar: Lidar):
    """Rays with no other object within EDGE_M beside them."""
    clear = np.ones(instance.shape, bool)
    reach = 6
    for down in range(-reach, reach + 1):
        for along in range(-reach, reach + 1):
            other = np.roll(np.roll(instance, down, 0), along, 1)
            away = np.roll(np.roll(points, down, 0), along, 1) - points
            flat = np.linalg.norm(away, axis=-1)
            direct = np.hypot(down, along) <= 1.5
            clear &= (other == instance) | ((flat > EDGE_M) & (not direct))
    return clear
