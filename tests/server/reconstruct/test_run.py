from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.logs import LogSelection, open_log, select_from_log, write_native_log
from real2sim_server.reconstruct import (
    InitialiseOptions,
    ReconstructError,
    ReconstructOptions,
    evaluate_views,
    initialise_scene,
    reconstruct,
)
from real2sim_server.reconstruct.evaluation import lidar_mask, psnr, render_logged_view
from real2sim_server.reconstruct.training import TrainOptions
from real2sim_server.scene import Trajectory
from real2sim_server.scene.io import load_scene

from .conftest import painted_log

SMALL = InitialiseOptions(
    max_background=60_000, max_object=4_000, ground_spacing=0.12, sky_resolution=64
)


def test_a_log_on_disk_becomes_a_bundle_with_a_preview(tmp_path):
    write_native_log(painted_log(frames=3), tmp_path / "log")
    options = ReconstructOptions(initialise=SMALL, lidar_steps=2)
    report = reconstruct(tmp_path / "log", tmp_path / "out.r2s", options)
    scene = load_scene(tmp_path / "out.r2s")
    assert list(scene.lidar.objects) == ["other_1"]
    assert scene.gaussian_count == report.gaussians
    assert list(scene.objects) == ["other_1"]
    assert report.gaussians_by_object == {"other_1": len(scene.object("other_1").cloud)}
    assert report.psnr_lidar_db > 20
    assert (tmp_path / "out.r2s.preview.png").stat().st_size > 1000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "out.r2s", "out.r2s.preview.png"]


def test_training_writes_bundle_previews_metrics_and_checkpoint(tmp_path):
    write_native_log(painted_log(frames=7), tmp_path / "log")
    training = TrainOptions(
        iterations=6, sky_resolution=16, log_every=2, checkpoint_every=3, preview_every=4
    )
    options = ReconstructOptions(initialise=SMALL, training=training, lidar_steps=2)
    report = reconstruct(tmp_path / "log", tmp_path / "out.r2s", options)
    assert report.training.steps == 6
    assert report.training.held_out_frames == report.evaluated_frames == [2]
    assert report.training.psnr > 15
    assert report.timing_s["uncertainty"] > 0
    made = load_scene(tmp_path / "out.r2s")
    assert made.has_uncertainties
    assert made.lidar is not None
    provenance = made.provenance["reconstruction"]
    assert (provenance["iterations"], provenance["held_out_frames"]) == (6, [2])
    folder = tmp_path / "out.r2s.training"
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 3
    assert (folder / "previews" / "000004.png").stat().st_size > 1000
    again = reconstruct(
        tmp_path / "log", tmp_path / "out.r2s", options, resume=True, overwrite=True
    )
    assert again.training.steps == 0
    assert again.training.psnr == pytest.approx(report.training.psnr)
    part = select_from_log(open_log(tmp_path / "log"), LogSelection(first=1))
    with pytest.raises(ReconstructError, match=r"begun on the whole log, not on frames 1:7:1"):
        reconstruct(part, tmp_path / "out.r2s", options, resume=True, overwrite=True)


def test_resuming_without_training_is_refused(tmp_path):
    with pytest.raises(ReconstructError, match="nothing to resume without training"):
        reconstruct(tmp_path, tmp_path / "out.r2s", resume=True)


def test_psnr_of_a_constant_error_matches_the_formula():
    black = np.zeros((4, 5, 3), np.uint8)
    assert psnr(black + np.uint8(51), black) == pytest.approx(20 * np.log10(5))
    assert psnr(black, black) == float("inf")
    assert np.isnan(psnr(black, black, np.zeros((4, 5), bool)))


def test_lidar_mask_covers_projected_points_but_not_the_sky():
    log = painted_log(frames=2)
    mask = lidar_mask(log, log.rig["front"], 0)
    assert not mask[:20].any()
    assert mask[60:].mean() > 0.6


def test_evaluation_needs_a_frame():
    log = painted_log(frames=2)
    scene = initialise_scene(log, options=SMALL)
    with pytest.raises(ReconstructError, match="at least one"):
        evaluate_views(scene, log, frames=[])


def shortened(log, frames: int):
    """The first ``frames`` frames of a log."""
    times = log.frame_times_us[:frames]
    ego = Trajectory.from_transforms(times, [log.ego.transform(int(t)) for t in times])
    return replace(log, frame_times_us=times, ego=ego)


@pytest.fixture(scope="module")
def jam(test_data):
    folder = test_data / "kitti_jam"
    if not folder.is_dir():
        pytest.skip(f"no real log at {folder}")
    log = shortened(open_log(folder), 6)
    options = InitialiseOptions(max_background=200_000, max_object=15_000, sky_resolution=256)
    return log, initialise_scene(log, options=options)


def test_a_real_street_is_recognisable_where_lidar_saw_it(jam):
    log, scene = jam
    report = evaluate_views(scene, log, frames=[0, 3, 5])
    assert report.psnr_lidar >= 15


def test_lead_car_truck_and_tanker_are_objects(jam):
    _, scene = jam
    assert {"car_0", "truck_2", "truck_3"} <= set(scene.objects)
    assert all(len(scene.object(k).cloud) > 3000 for k in ("car_0", "truck_2", "truck_3"))


@pytest.mark.slow
def test_removing_the_lead_car_reveals_road(jam):
    log, scene = jam
    camera, t_us = log.rig["image_02"], int(log.frame_times_us[3])
    others = {k: o for k, o in scene.objects.items() if k != "car_0"}
    empty = render_logged_view(replace(scene, objects=others), camera, t_us).astype(float)
    with_car = render_logged_view(scene, camera, t_us).astype(float)
    # The lower rear of the lead car: bumper and number plate, or road without the car.
    rear = (slice(230, 290), slice(590, 680))
    lane = np.median(empty[230:290, 480:540].reshape(-1, 3), axis=0)
    assert np.abs(with_car[rear] - empty[rear]).mean() > 25
    assert np.abs(np.median(empty[rear].reshape(-1, 3), axis=0) - lane).max() < 60
    # The road is grey, without the red of the lamps or the blue of the plate.
    assert np.ptp(empty[rear], axis=-1).mean() < 25
