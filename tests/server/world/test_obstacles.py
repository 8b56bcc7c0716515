"""Episodes and simulations use the same occupied background cells."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.scene import GaussianCloud, Ground, Trajectory
from real2sim_server.scene.ground import RecordedPath, occupied_cells
from real2sim_server.world.path import LoggedPath


def drive(*places) -> Trajectory:
    places = np.array(places, dtype=np.float64)
    times = np.arange(len(places)) * 100_000
    turn = np.array([np.cos(0.2), 0.0, 0.0, np.sin(0.2)])
    return Trajectory(times, places, np.tile(turn, (len(places), 1)))


def cloud(points) -> GaussianCloud:
    means = torch.tensor(np.asarray(points), dtype=torch.float32)
    n = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return GaussianCloud(
        means, quats, torch.full((n, 3), 0.1), torch.ones(n), torch.zeros((n, 1, 3))
    )


@pytest.mark.parametrize(
    "ego",
    [
        drive((0, 0, 0), (0.01, 0, 0), (3, 0.5, 0), (3.02, 0.5, 0), (9, 2, 0)),
        drive((1, 2, 0), (1, 2, 0)),
    ],
    ids=["driven", "standing"],
)
def test_both_path_types_clear_the_same_cells(ego):
    around = np.random.default_rng(0).uniform((-5, -5, 0.5), (15, 8, 1.5), (20_000, 3))
    cells = [
        occupied_cells(cloud(around), Ground.level(0.0), way)
        for way in (LoggedPath(ego), RecordedPath.of(ego))
    ]
    np.testing.assert_array_equal(cells[0].occupied, cells[1].occupied)
    assert cells[0].occupied.any()


def test_haze_floaters_road_and_canopies_are_not_obstacles():
    spread = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    solid, road, canopy, haze = (
        spread + place for place in ((12.0, 6.0, 1.0), (20.0, 6.0, 0.1), (8, 9, 3), (25, 6, 1))
    )
    floater = np.array([[16.0, 6.0, 1.0]])
    background = cloud(np.concatenate([solid, road, canopy, floater, haze]))
    background.opacities[-3:] = 0.3
    way = RecordedPath.of(drive((0, 0, 0), (10, 0, 0)))
    cells = occupied_cells(background, Ground.level(0.0), way)
    assert len(cells.points) == 3
    assert cells.points[:, 0] == pytest.approx(12.0, abs=0.1)
