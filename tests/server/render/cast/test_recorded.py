"""Sweeps through recorded scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.base import Pose
from real2sim_proto.operations import Delete, EraseRegion
from real2sim_server.edit.apply import apply_operations
from real2sim_server.edit.compose import sweep_of
from real2sim_server.edit.state import ScenarioState
from real2sim_server.render.cast import cast, detect, recorded_sweep, sensor_poses
from real2sim_server.render.cast.call import transforms_at
from real2sim_server.render.cast.files import ply_bytes, sweep_picture, write_sweep
from real2sim_server.scene import (
    Beams,
    CameraRig,
    GaussianCloud,
    Lidar,
    LidarSurfaces,
    Reflector,
    Scene,
    SceneObject,
    Trajectory,
)

TIMES = np.array([0, 1_000_000])


def slab(x: float) -> GaussianCloud:
    """An opaque sheet across the x axis."""
    return GaussianCloud(
        torch.tensor([[x, 0.0, 0.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[1e-3, 3.0, 3.0]]),
        torch.tensor([0.99]),
        torch.zeros(1, 1, 3),
    )


def path(start: float, speed: float) -> Trajectory:
    positions = np.array([[start, 0, 0], [start + speed, 0, 0]])
    return Trajectory(TIMES, positions, np.array([[1.0, 0, 0, 0]] * 2))


@pytest.fixture
def scene() -> Scene:
    """A sheet ahead that moves away at 10 m/s, in front of a wall. The ego follows at 5 m/s."""
    car = SceneObject("car_0", "car", (1, 6, 6), slab(0.0), path(12.0, 10.0))
    return Scene(
        name="made",
        background=slab(60.0),
        objects={"car_0": car},
        sky=None,
        rig=CameraRig(()),
        ego=path(0.0, 5.0),
        frame_times_us=TIMES,
    )


LIDAR = Lidar("any", Beams.spinning([0.0], columns=64), max_range=100.0)
AHEAD = int(np.abs(LIDAR.beams.azimuth[0]).argmin())


def test_ego_and_objects_are_posed_at_the_time_of_each_ray(scene: Scene) -> None:
    echo = recorded_sweep(scene, LIDAR, 500_000)
    seconds = 0.5 + LIDAR.beams.time_us[0, AHEAD] * 1e-6
    expected = (12 + 10 * seconds - 5 * seconds) / np.cos(LIDAR.beams.azimuth[0, AHEAD])
    assert echo.range[0, AHEAD] == pytest.approx(expected, abs=1e-3)
    assert echo.instance[0, AHEAD] == 1


def test_edits_change_the_sweep(scene: Scene) -> None:
    state = ScenarioState.of(scene)
    deleted = apply_operations(state, [Delete(object_id="car_0")]).state
    region = EraseRegion(
        region_id="r", pose=Pose(position=(60, 0, 0), quaternion=(1, 0, 0, 0)), size=(4, 4, 4)
    )
    erased = apply_operations(deleted, [region]).state
    hits = []
    for edited in (state, deleted, erased):
        met = sweep_of(scene, edited, LIDAR, 500_000)
        poses = sensor_poses(scene.ego, LIDAR, 500_000)
        hits.append(cast(met.instances, LIDAR, poses, object_poses=met.poses).range[0, AHEAD])
    assert hits[0] < 20
    assert 50 < hits[1] < 60
    assert hits[2] == 0


def test_lidar_surfaces_replace_the_gaussians(scene: Scene) -> None:
    def reflector(x: float, reflectivity: float) -> Reflector:
        return Reflector(slab(x), torch.tensor([[reflectivity, 0.0]]))

    surfaces = LidarSurfaces(reflector(61.0, 0.4), {"car_0": reflector(0.5, 0.25)})
    echo = recorded_sweep(replace(scene, lidar=surfaces), LIDAR, 500_000)
    plain = recorded_sweep(scene, LIDAR, 500_000)
    assert echo.range[0, AHEAD] - plain.range[0, AHEAD] == pytest.approx(0.5, abs=1e-2)
    assert echo.intensity[0, AHEAD] == pytest.approx(0.25, abs=0.01)


def test_a_path_extends_straight_beyond_its_ends() -> None:
    poses = transforms_at(path(3.0, 10.0), np.array([-50_000.0, 500_000.0, 1_050_000.0]))
    assert np.allclose(poses[:, 0, 3], [2.5, 8.0, 13.5])


def test_a_sweep_is_written_as_ply_npz_and_png(scene: Scene, tmp_path) -> None:  # type: ignore[no-untyped-def]
    sweep = detect(recorded_sweep(scene, LIDAR, 500_000), LIDAR)
    count = int(sweep.hit.sum())
    head, _, body = ply_bytes(sweep).partition(b"end_header\n")
    assert f"element vertex {count}".encode() in head
    assert len(body) == count * 26
    for suffix in (".ply", ".npz", ".png"):
        write_sweep(sweep, LIDAR, tmp_path / f"sweep{suffix}")
    with np.load(tmp_path / "sweep.npz") as arrays:
        assert np.array_equal(arrays["range"], sweep.range)
    assert sweep_picture(sweep, LIDAR).shape[1:] == (1600, 3)
    with pytest.raises(ValueError, match="a sweep is written as"):
        write_sweep(sweep, LIDAR, tmp_path / "sweep.pcd")
