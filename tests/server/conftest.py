"""A scene small enough for every test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

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
from real2sim_server.scene.io import save_scene

END_US = 2_000_000
IDENTITY = (1.0, 0.0, 0.0, 0.0)
DRAW = ("datasets", "demo", "learning", "policies", "reconstruct", "render", "scenarios", "sweeps",
        "synthetic")  # fmt: skip
KERNELS_OF_PACKAGES = dict.fromkeys(DRAW, ("worker_kernels",))
KERNELS_OF_PACKAGES |= dict.fromkeys(("device", "world"), ("worker_kernels", "solver_kernels"))
KERNELS_OF_PACKAGES |= dict.fromkeys(("physics", "simulation"), ("solver_kernels",))


def box_cloud(count: int, size: tuple[float, float, float], rgb, *, seed: int) -> GaussianCloud:
    """Gaussians spread over a box centred on the origin, of one colour."""
    generator = torch.Generator().manual_seed(seed)
    colour = (torch.tensor(rgb, dtype=torch.float32) - 0.5) / 0.28209479177387814
    return GaussianCloud(
        means=(torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor(size),
        quats=torch.tensor(IDENTITY).repeat(count, 1),
        scales=torch.full((count, 3), 0.2),
        opacities=torch.full((count,), 0.9),
        sh=colour.expand(count, 1, 3).clone(),
    )


def standing(x: float, y: float, z: float) -> Trajectory:
    times = np.array([0, END_US])
    return Trajectory(times, np.array([[x, y, z]] * 2), np.array([IDENTITY] * 2))


def driving(start, end) -> Trajectory:
    """Straight on at constant speed, with a pose every 0.1 s."""
    times = np.arange(0, END_US + 1, 100_000)
    fraction = (times / END_US)[:, None]
    positions = (1 - fraction) * np.array(start, float) + fraction * np.array(end, float)
    return Trajectory(times, positions, np.tile(IDENTITY, (len(times), 1)))


def look(name: str, yaw: float) -> Camera:
    """A 96x64 camera 1.5 m above the rear axle, turned by ``yaw`` about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.array([[c, -s, 0, 1.0], [s, c, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]])
    K = np.array([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]])
    return Camera(name, 96, 64, K, pose @ T_VEHICLE_OPTICAL)


def make_tiny_scene(name: str = "tiny") -> Scene:
    """A 30 m street: red car parked ahead, blue car driving away, green post; ego at 5 m/s."""
    road = box_cloud(300, (40.0, 8.0, 0.1), (0.4, 0.4, 0.4), seed=1)
    red = box_cloud(60, (4.0, 1.8, 1.5), (0.9, 0.1, 0.1), seed=2)
    blue = box_cloud(60, (4.2, 1.8, 1.5), (0.1, 0.1, 0.9), seed=3)
    post = box_cloud(20, (0.4, 0.4, 2.0), (0.1, 0.8, 0.1), seed=4)
    objects = (
        SceneObject("car_red", "car", (4.0, 1.8, 1.5), red, standing(14.0, -3.0, 0.75)),
        SceneObject("car_blue", "car", (4.2, 1.8, 1.5), blue, driving((8, 0, 0.75), (28, 0, 0.75))),
        SceneObject("post", "pole", (0.4, 0.4, 2.0), post, standing(10.0, 3.5, 1.0)),
    )
    return Scene(
        name=name,
        background=road.moved(
            np.array([[1, 0, 0, 15], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        ),
        objects={o.object_id: o for o in objects},
        sky=Sky.uniform((0.5, 0.7, 0.9)),
        rig=CameraRig((look("front", 0.0), look("left", np.pi / 2))),
        ego=driving((0, 0, 0), (10, 0, 0)),
        frame_times_us=np.arange(0, END_US + 1, 100_000),
        provenance={"source": "made for tests"},
    )


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    """Two cameras (front, left), three objects, 2 s; see :func:`make_tiny_scene`."""
    return make_tiny_scene()


@pytest.fixture
def scenes_dir(tmp_path: Path, tiny_scene: Scene) -> Path:
    """A scene folder that holds ``tiny``."""
    folder = tmp_path / "scenes"
    save_scene(tiny_scene, folder / "tiny.r2s")
    return folder


@pytest.fixture(autouse=True)
def kernels_of_package(request: pytest.FixtureRequest) -> None:
    """Compiled kernels for the packages whose tests would otherwise compile many of them."""
    package = request.path.relative_to(Path(__file__).parent).parts[0]
    for name in KERNELS_OF_PACKAGES.get(package, ()):
        request.getfixturevalue(name)


@pytest.fixture
def one_torch_thread():
    """Small tensors gain nothing from threads and lose much when others compute."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
