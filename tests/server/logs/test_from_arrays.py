"""The example "From arrays to a log" of ``docs/log_format.md``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.logs import DrivingLog, open_log
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene

PAGE = Path(__file__).resolve().parents[3] / "docs" / "log_format.md"
COARSE = InitialiseOptions(
    max_background=5_000, max_object=200, voxel=0.5, ground_spacing=0.5, object_voxel=0.1,
    sky_resolution=16, feature_images=0, stereo_images=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of the log, and the variables of the example."""
    section = PAGE.read_text(encoding="utf-8").split("## From arrays to a log")[1].split("\n## ")[0]
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("arrays"))
        for block in re.findall(r"```python\n(.*?)```", section, re.S):
            exec(block, names)
        return Path("my_drive").resolve(), names


@pytest.fixture
def log(example: tuple[Path, dict[str, Any]]) -> DrivingLog:
    return open_log(example[0])


def test_the_log_has_no_problems_and_no_questions(example: tuple[Path, Any]) -> None:
    told = CliRunner().invoke(build_app(), ["log-info", str(example[0]), "--check"])
    assert told.exit_code == 0
    assert "5 images and 5 sweeps read\nno problems found" in told.output
    assert "question" not in told.output


def test_points_measured_while_moving_lie_on_the_wall(
    example: tuple[Path, dict[str, Any]], log: DrivingLog
) -> None:
    """The wall is 8 m left of the street, and its points span a LiDAR revolution."""
    _, names = example
    T_street_map = invert_transform(names["T_map_street"])
    at = names["point_us"][3]
    seen = apply_transform(
        T_street_map @ names["along"](at) @ names["T_vehicle_lidar"], names["points"][3][:, None]
    )[:, 0]
    world = apply_transform(log.ego.transform(int(log.frame_times_us[3])), log.lidar(3).points)
    T_street_world = T_street_map @ invert_transform(names["T_world_map"])
    np.testing.assert_allclose(apply_transform(T_street_world, world), seen, atol=1e-3)
    np.testing.assert_allclose(world[:3000, 1], 8.0, atol=1e-3)


def test_the_reconstruction_has_the_wall_and_the_car(log: DrivingLog) -> None:
    scene = initialise_scene(log, options=COARSE)
    background = scene.background.means.numpy()
    walls = background[background[:, 2] > 0.8]
    assert len(walls) > 50
    assert np.abs(walls[:, 1] - 8.0).max() < 0.3
    car = scene.objects["car_0"]
    np.testing.assert_allclose(car.trajectory.positions[0], [12.0, 3.0, 0.75], atol=0.05)
    # The rear was seen in five revolutions of 0.1 s, during each of which the car moves 0.8 m.
    x, y, z = car.cloud.means.numpy().T
    rear = x[(np.abs(y) < 0.85) & (np.abs(z) < 0.6) & (x < -1.9)]
    assert len(rear) > 10
    np.testing.assert_allclose(rear, -2.15, rtol=0, atol=0.015)
