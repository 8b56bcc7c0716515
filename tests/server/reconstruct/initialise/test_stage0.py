from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct import (
    InitialiseOptions,
    ReconstructError,
    evaluate_views,
    initialise_scene,
)
from real2sim_server.scene import CameraRig, Scene
from real2sim_server.scene.cloud import SH_C0

from ..conftest import BOX_COLOUR, BOX_SIZE, SKY_COLOUR, WALL_COLOUR, WALL_X, painted_log

SMALL = InitialiseOptions(
    max_background=80_000, max_object=6_000, ground_spacing=0.12, sky_resolution=64
)


@pytest.fixture(scope="module")
def synthetic_scene(synthetic_log: DrivingLog) -> Scene:
    return initialise_scene(synthetic_log, options=SMALL)


@pytest.fixture(scope="module")
def painted_scene() -> Scene:
    return initialise_scene(painted_log(), options=SMALL)


def colours_of(cloud) -> np.ndarray:
    return (cloud.sh[:, 0].numpy() * SH_C0 + 0.5) * 255


def test_every_track_becomes_an_object_with_its_box_and_trajectory(synthetic_log, synthetic_scene):
    assert list(synthetic_scene.objects) == [t.object_id for t in synthetic_log.tracks]
    for track in synthetic_log.tracks:
        item = synthetic_scene.object(track.object_id)
        assert item.size == track.size
        assert item.category == track.category
        assert item.trajectory is track.trajectory
        assert len(item.cloud) > 100


def test_gaussians_of_objects_lie_inside_their_enlarged_boxes(synthetic_scene):
    for item in synthetic_scene.objects.values():
        outside = np.abs(item.cloud.means.numpy()) - np.array(item.size) / 2
        assert outside.max() <= SMALL.box_margin + 1e-3, item.object_id


def test_the_background_excludes_moving_cars(synthetic_log, synthetic_scene):
    movers = [t for t in synthetic_log.tracks if np.ptp(t.trajectory.positions, axis=0).max() > 1]
    assert movers
    means = synthetic_scene.background.means.numpy()
    for track in movers:
        for t_us in synthetic_log.frame_times_us:
            if not track.trajectory.covers(int(t_us)):
                continue
            local = apply_transform(invert_transform(track.trajectory.transform(int(t_us))), means)
            half = np.array(track.size) / 2
            above_ground = local[:, 2] > -half[2] + 0.25
            assert not ((np.abs(local) < half).all(axis=1) & above_ground).any(), track.object_id


def test_scene_values_are_valid_for_a_bundle(synthetic_scene):
    synthetic_scene.background.check_values("background")
    for item in synthetic_scene.objects.values():
        item.cloud.check_values(item.object_id)
    assert torch.isfinite(synthetic_scene.sky.faces).all()


@pytest.mark.slow
def test_gaussian_budgets_are_respected(synthetic_log):
    options = replace(SMALL, max_background=5_000, max_object=500)
    scene = initialise_scene(synthetic_log, options=options)
    assert len(scene.background) <= 5_000
    # The generated body of a vehicle adds to its measured points.
    assert all(len(o.cloud) <= 500 + 6_000 for o in scene.objects.values())


def test_rendered_views_come_close_to_the_logged_images(synthetic_log, synthetic_scene):
    report = evaluate_views(synthetic_scene, synthetic_log, frames=[0, 3, 5])
    assert report.psnr_lidar > 15
    assert report.psnr > 13


def test_initialisation_is_reproducible(painted_scene):
    again = initialise_scene(painted_log(), options=SMALL)
    assert torch.equal(again.sky.faces, painted_scene.sky.faces)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        first = getattr(painted_scene.background, name)
        assert torch.equal(getattr(again.background, name), first), name
        first = getattr(painted_scene.object("other_1").cloud, name)
        assert torch.equal(getattr(again.object("other_1").cloud, name), first), name


def test_a_wall_behind_a_passing_box_keeps_its_own_colour(painted_scene):
    means = painted_scene.background.means.numpy()
    on_wall = (np.abs(means[:, 0] - WALL_X) < 0.05) & (means[:, 2] > 0.4) & (means[:, 2] < 3)
    passed = on_wall & (np.abs(means[:, 1]) < 3)
    assert passed.sum() > 500
    error = np.abs(colours_of(painted_scene.background)[passed] - WALL_COLOUR).max(axis=1)
    assert (error < 25).mean() > 0.99


def test_the_near_face_of_the_box_has_its_colour(painted_scene):
    cloud = painted_scene.object("other_1").cloud
    front = cloud.means[:, 0].numpy() < -BOX_SIZE[0] / 2 + 0.05
    inner = front & (np.abs(cloud.means[:, 1:].numpy()) < [0.85, 0.65]).all(axis=1)
    error = np.abs(colours_of(cloud)[inner] - BOX_COLOUR).max(axis=1)
    assert (error < 25).mean() > 0.97


def test_removing_the_box_reveals_the_wall(painted_scene):
    from real2sim_server.reconstruct.evaluation import render_logged_view

    log = painted_log()
    emptied = replace(painted_scene, objects={})
    without = render_logged_view(emptied, log.rig["front"], int(log.frame_times_us[4]))
    truth = painted_log(boxes=False).image("front", 4)
    hidden = (log.image("front", 4) == BOX_COLOUR).all(axis=-1)
    assert hidden.sum() > 500
    error = np.abs(without.astype(int) - truth)[hidden].mean()
    assert error < 20


def test_the_sky_has_the_colour_of_uncovered_pixels(painted_scene):
    up = torch.tensor([[1.0, 0.0, 0.38]])
    colour = painted_scene.sky.sample(up)[0].numpy() * 255
    np.testing.assert_allclose(colour, SKY_COLOUR, atol=12)


def test_a_log_without_boxes_becomes_a_scene_without_objects():
    scene = initialise_scene(painted_log(boxes=False), options=SMALL)
    assert not scene.objects
    assert len(scene.background) > 1000


def test_a_stationary_log_without_lidar_is_refused():
    with pytest.raises(ReconstructError, match="no usable LiDAR points, and its images"):
        initialise_scene(painted_log(lidar=False), options=SMALL)


def test_a_log_without_cameras_is_refused():
    with pytest.raises(ReconstructError, match="no camera"):
        initialise_scene(replace(painted_log(), rig=CameraRig(())), options=SMALL)


def test_progress_reports_every_stage_to_its_end():
    reported: list[tuple[str, int, int]] = []
    timing: dict[str, float] = {}
    initialise_scene(
        painted_log(frames=2),
        options=SMALL,
        on_progress=lambda *args: reported.append(args),
        timing_s=timing,
    )
    stages = ["accumulate", "features", "stereo", "shape", "walls", "colour", "sunlight", "fill"]
    assert list(timing) == stages
    for stage in timing:
        last = [(done, total) for name, done, total in reported if name == stage][-1]
        assert last[0] == last[1]


@pytest.mark.parametrize("name", ["voxel", "max_background", "sky_resolution", "max_range"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_options_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ReconstructError, match=name):
        InitialiseOptions(**{name: value})
