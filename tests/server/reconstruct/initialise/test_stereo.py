from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct import InitialiseOptions, ReconstructError, initialise_scene
from real2sim_server.reconstruct.initialise.triangulate import sweep_planes

from ..conftest import sweep_of
from .test_triangulate import BOX_X, FRAMES, WALL_X, textured_log


def swept(log: DrivingLog, images: int = FRAMES) -> np.ndarray:
    return sweep_planes(log, max_images=images, on_image=lambda done, total: None)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return swept(textured_log())


def test_a_textured_wall_is_reconstructed_densely(points):
    assert len(points) > 20_000
    # Planes are 0.5 m apart at this depth.
    error = np.abs(points[:, 0] - WALL_X)
    assert np.median(error) < 0.4
    assert np.quantile(error, 0.9) < 0.8


def test_moving_boxes_give_no_points(points):
    with_box = swept(textured_log(box=True))
    assert (np.abs(with_box[:, 0] - BOX_X) < 1.5).mean() < 0.005
    assert len(with_box) < len(points)


def test_fewer_than_two_images_give_no_points():
    assert swept(textured_log(), images=0).shape == (0, 3)
    assert len(swept(textured_log(), images=1)) == 0


def test_points_lie_above_the_highest_lidar_returns(points):
    log = textured_log()
    y, z = np.meshgrid(np.linspace(-5, 5, 60), np.linspace(0.2, 1.6, 20))
    low = np.stack([np.full(y.size, WALL_X), y.ravel(), z.ravel()], 1)

    class Below:
        def image(self, camera, frame):
            return log.source.image(camera, frame)

        def lidar(self, frame):
            place = log.ego.transform(int(log.frame_times_us[frame]))[:3, 3]
            return sweep_of(low - place)

    above = swept(replace(log, source=Below()))
    assert 0.3 * len(points) < len(above) < 0.7 * len(points)
    assert above[:, 2].min() > 1.0


def test_a_log_without_lidar_is_initialised_from_stereo_points():
    options = InitialiseOptions(max_background=8_000, feature_images=0)
    means = initialise_scene(textured_log(), options=options).background.means
    assert int(((means[:, 0] - WALL_X).abs() < 0.5).sum()) > 500
    with pytest.raises(ReconstructError, match="tell a depth"):
        initialise_scene(textured_log(), options=replace(options, stereo_images=0))
