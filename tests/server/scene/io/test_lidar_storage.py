"""LiDAR surfaces in bundles."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.scene import (
    BundleError,
    LidarSurfaces,
    Reflector,
    RingResponse,
    SceneError,
)
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.scene.lidar_surfaces import RANGE_STEPS


@pytest.fixture
def surfaces(make_cloud):
    def reflector(count: int) -> Reflector:
        cloud = make_cloud(count, degree=0)
        cloud = replace(cloud, uncertainties=torch.linspace(0, 0.25, count))
        return Reflector(cloud, torch.linspace(0, 1, 2 * count).reshape(count, 2))

    return LidarSurfaces(reflector(7), {"car_3": reflector(3)})


def test_surfaces_round_trip(scene, surfaces, tmp_path):
    save_scene(replace(scene, lidar=surfaces), tmp_path / "a.r2s")
    read = load_scene(tmp_path / "a.r2s").lidar
    assert read is not None
    pairs = [
        (surfaces.background, read.background),
        (surfaces.objects["car_3"], read.objects["car_3"]),
    ]
    for written, back in pairs:
        assert torch.equal(written.attributes, back.attributes)
        for name in ("means", "quats", "scales", "opacities", "uncertainties"):
            assert torch.equal(getattr(written.cloud, name), getattr(back.cloud, name))


def test_surfaces_without_uncertainties_round_trip(scene, surfaces, tmp_path):
    cloud = replace(surfaces.background.cloud, uncertainties=None)
    older = LidarSurfaces(Reflector(cloud, surfaces.background.attributes))
    save_scene(replace(scene, lidar=older), tmp_path / "a.r2s")
    read = load_scene(tmp_path / "a.r2s").lidar
    assert read is not None
    assert read.background.cloud.uncertainties is None


def test_incidence_and_ring_response_round_trip(scene, surfaces, tmp_path):
    steps = len(RANGE_STEPS) - 1
    gain = np.linspace(0.5, 1.5, 2 * steps, dtype=np.float32).reshape(2, steps)
    response = RingResponse(np.array([0.1, -0.2], np.float32), gain, gain - 1)
    made = replace(surfaces, incidence=0.4, response=response)
    save_scene(replace(scene, lidar=made), tmp_path / "a.r2s")
    read = load_scene(tmp_path / "a.r2s").lidar
    assert read is not None
    assert read.incidence == 0.4
    for name in ("elevation", "gain", "offset"):
        assert np.array_equal(getattr(read.response, name), getattr(response, name))


def test_a_scene_without_surfaces_is_written_without_them(scene, tmp_path):
    save_scene(scene, tmp_path / "a.r2s")
    document = json.loads((tmp_path / "a.r2s" / "scene.json").read_text())
    assert "lidar" not in document["content"]
    assert not (tmp_path / "a.r2s" / "lidar.safetensors").exists()
    assert load_scene(tmp_path / "a.r2s").lidar is None


def test_changed_attributes_are_detected(scene, surfaces, tmp_path):
    save_scene(replace(scene, lidar=surfaces), tmp_path / "a.r2s")
    file = tmp_path / "a.r2s" / "lidar.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))
    with pytest.raises(BundleError, match=r"lidar\.safetensors"):
        load_scene(tmp_path / "a.r2s")


def test_attributes_with_a_wrong_count_are_refused(make_cloud):
    with pytest.raises(SceneError, match=r"must be \(4, 2\) float32"):
        Reflector(make_cloud(4), torch.zeros(3, 2))


def test_attributes_out_of_range_are_refused(make_cloud, scene, tmp_path):
    bad = LidarSurfaces(Reflector(make_cloud(4), torch.full((4, 2), 5.0)))
    with pytest.raises(SceneError, match=r"8 attributes are outside \[0, 4\]"):
        save_scene(replace(scene, lidar=bad), tmp_path / "a.r2s")
