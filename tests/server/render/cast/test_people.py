"""LiDAR returns of walking people, against rays cast at the skinned body mesh."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.body import joint_transforms, skin
from real2sim_server.body.gait import plan_gait
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.render import Instance
from real2sim_server.render.cast import cast
from real2sim_server.scene import Beams, Lidar, Trajectory
from real2sim_server.scene.asset import person_asset


def surface(asset, trajectory, t_us):
    """Vertices [V, 3] in the world frame, and the triangles."""
    figure = asset.figure
    times = (trajectory.times_us - trajectory.start_us) * 1e-6
    ground = trajectory.positions - [0.0, 0.0, figure.middle]
    gait = plan_gait(figure.body, times, ground, 0 * times, figure.style)
    transforms = joint_transforms(figure.body, gait.pose([t_us * 1e-6]))
    vertices = skin(figure.body, transforms)[0]
    place = trajectory.transform(t_us)[:3, 3] - [0.0, 0.0, figure.middle]
    return vertices + place, figure.body.model.triangles[figure.body.model.triangles_of(())]


def met(vertices, triangles, directions):
    """Ranges [R] of rays from the origin, 0 for misses (Moeller and Trumbore 1997)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    found = np.zeros(len(directions))
    for k, direction in enumerate(directions):
        across = np.cross(direction, c - a)
        det = ((b - a) * across).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -(a * across).sum(axis=1) / det
            turned = np.cross(-a, b - a)
            v = turned @ direction / det
            t = ((c - a) * turned).sum(axis=1) / det
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if inside.any():
            found[k] = t[inside].min()
    return found


@pytest.mark.parametrize("distance", [6.0, 20.0])
@pytest.mark.parametrize("build", ["woman", "boy"])
@pytest.mark.slow
def test_ranges_of_people_match_their_meshes(build, distance):
    asset = person_asset("somebody", build)
    seconds = np.linspace(0, 3, 31)
    way = np.column_stack([0 * seconds + distance, 1.3 * (seconds - 1.5), 0 * seconds])
    trajectory = Trajectory(
        (seconds * 1e6).astype(np.int64),
        way - [0.0, 0.0, 1.7 - asset.figure.middle],
        yaw_quaternion(np.zeros(31)),
    )
    half, below, step = 1.2 / distance, 1.75 / distance, 0.05 / distance
    azimuth, elevation = np.meshgrid(np.arange(-half, half, step), np.arange(-below, 0.1, step))
    beams = Beams(azimuth.ravel(), elevation.ravel(), np.zeros(azimuth.size))
    t_us = 1_450_000
    cloud = asset.figure.posed(asset.cloud, trajectory, t_us)
    person = Instance(cloud, trajectory.transform(t_us), 1)
    echo = cast([person], Lidar("table", beams), np.eye(4))
    truth = met(*surface(asset, trajectory, t_us), beams.directions)
    both = (truth > 0) & echo.hit
    assert both.sum() > 100
    assert np.median(np.abs(echo.range - truth)[both]) < 0.01
    assert np.mean(echo.hit == (truth > 0)) > 0.97
