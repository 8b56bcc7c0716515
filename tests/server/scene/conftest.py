"""Small test scenes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import (
    Camera,
    CameraRig,
    GaussianCloud,
    Scene,
    SceneObject,
    Sky,
    Trajectory,
)
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

MakeCloud = Callable[..., GaussianCloud]


@pytest.fixture
def make_cloud() -> MakeCloud:
    def make(count: int = 50, *, degree: int = 1, seed: int = 0) -> GaussianCloud:
        random = torch.Generator().manual_seed(seed)
        quats = torch.randn(count, 4, generator=random)
        return GaussianCloud(
            means=torch.randn(count, 3, generator=random) * 10,
            quats=quats / quats.norm(dim=1, keepdim=True),
            scales=torch.rand(count, 3, generator=random) + 1e-3,
            opacities=torch.rand(count, generator=random),
            sh=torch.randn(count, (degree + 1) ** 2, 3, generator=random),
        )

    return make


@pytest.fixture
def scene(make_cloud: MakeCloud) -> Scene:
    times = np.arange(5, dtype=np.int64) * 100_000 + 7
    positions = np.stack([np.linspace(0, 1 / 3, 5), np.full(5, 0.1), np.full(5, -1e-17)], axis=1)
    path = Trajectory(times, positions, yaw_quaternion(np.linspace(0.1, 0.7, 5)))
    pose = T_VEHICLE_OPTICAL.copy()
    pose[:3, 3] = [1.6, 0.1, 1.4]
    k = np.array([[700.1, 0, 320], [0, 701.3, 213.5], [0, 0, 1]])
    objects = {
        name: SceneObject(name, "car", (4.5, 1.8, 1.5 + i), make_cloud(20 + i, seed=i + 1), path)
        for i, name in enumerate(["car_7", "car_3", "../../etc/passwd"])
    }
    faces = torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(9))
    return Scene(
        name="street",
        background=make_cloud(100, degree=2),
        objects=objects,
        sky=Sky(faces),
        rig=CameraRig((Camera("front", 640, 427, k, pose), Camera("rear", 320, 240, k, pose))),
        ego=path,
        frame_times_us=times[::2],
        provenance={"source": "test", "settings": {"voxel": 0.1, "names": ["a", "b"]}},
    )
