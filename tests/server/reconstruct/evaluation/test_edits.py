"""Edits of a true street, the region that they change, and their scores."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim_server.cli import app
from real2sim_server.logs import write_native_log
from real2sim_server.reconstruct import InitialiseOptions, ReconstructError, initialise_scene
from real2sim_server.reconstruct.evaluation import PSNR_CAP, EvaluateOptions, evaluate_scene
from real2sim_server.reconstruct.evaluation.edits import (
    CHANGED,
    apply_edit,
    choose_vehicles,
    compare_edit,
    edits_of,
    evaluate_edits,
    score_view,
)
from real2sim_server.scene.io import save_scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

from ..conftest import painted_log

FRAME = 2
AHEAD, PARKED = "car_0", "car_5"


@pytest.fixture(scope="module")
def street():
    config = SyntheticConfig(
        seed=5,
        frames=6,
        width=192,
        height=128,
        cameras=(CameraSpec("front"),),
        samples=1,
        moving_cars=1,
        parked_cars=6,
        lidar_columns=256,
    )
    return generate_log(config)


@pytest.fixture(scope="module")
def scene(street):
    options = InitialiseOptions(
        max_background=6_000,
        max_object=1_000,
        voxel=0.3,
        ground_spacing=0.5,
        sky_resolution=16,
        feature_images=0,
        stereo_images=0,
    )
    return initialise_scene(street, options=options)


@pytest.fixture
def view_of(street, scene):
    def view(object_id, name):
        edit = apply_edit(scene, street, object_id, edits_of(object_id)[name])
        return compare_edit(scene, edit, street.rig["front"], int(street.frame_times_us[FRAME]))

    return view


def index(log, object_id):
    return [track.object_id for track in log.tracks].index(object_id)


def place(log, object_id):
    camera, t_us = log.rig["front"], int(log.frame_times_us[FRAME])
    pose = camera.pose(log.ego.transform(t_us))
    _, _, instance = log.render(pose, camera.K, camera.width, camera.height, t_us)
    return instance == 1 + index(log, object_id)


@pytest.mark.parametrize("object_id", [AHEAD, PARKED])
def test_the_true_street_lacks_a_deleted_vehicle_and_its_shadow(street, view_of, object_id):
    view = view_of(object_id, "delete")
    assert not view.vehicle.any()
    assert (view.region & ~view.shadows == place(street, object_id)).all()
    brighter = (view.after.astype(int) - view.before).mean(axis=-1) > CHANGED
    assert (brighter & view.shadows).sum() > 20


def test_the_region_of_a_moved_vehicle_covers_both_places_and_their_shadows(street, scene, view_of):
    view = view_of(PARKED, "move_left")
    edit = apply_edit(scene, street, PARKED, edits_of(PARKED)["move_left"])
    old, new = (place(log, PARKED) for log in (street, edit.after))
    assert np.flatnonzero(new.any(axis=0)).mean() < np.flatnonzero(old.any(axis=0)).mean()
    assert min(old.sum(), new.sum()) > 100
    assert view.region[old | new].all()
    change = view.after.astype(int) - view.before
    assert view.region[np.abs(change).max(axis=-1) >= CHANGED].all()
    grey = change.mean(axis=-1)[view.shadows]
    assert (grey > CHANGED).sum() > 20, "the old shadow is gone"
    assert (grey < -CHANGED).sum() > 20, "the new shadow is there"
    assert view.region.mean() < 0.5


def test_the_truth_has_the_best_score(view_of):
    view = view_of(PARKED, "turn_90")
    exact = score_view(replace(view, rendered=view.after), "front", FRAME)
    assert (min(exact.psnr, PSNR_CAP), exact.ssim) == (PSNR_CAP, pytest.approx(1))
    assert exact.pixels == view.region.sum()
    unedited = score_view(replace(view, rendered=view.before), "front", FRAME)
    assert unedited.psnr < 25


def test_the_ground_that_a_deleted_car_hid_is_scored_alone(view_of):
    view = view_of(PARKED, "delete")
    assert 0 < view.hidden_ground.sum() < (view.region & ~view.shadows).sum()
    wrong = np.where(view.hidden_ground[..., None], view.after, 0).astype(np.uint8)
    score = score_view(replace(view, rendered=wrong), "front", FRAME)
    assert score.psnr_hidden_ground == float("inf")
    assert score.psnr < 20


def test_parts_of_few_pixels_are_not_scored(view_of):
    view = view_of(PARKED, "delete")
    few = np.zeros_like(view.hidden_ground)
    few[:7, :7] = True
    score = score_view(replace(view, hidden_ground=few), "front", FRAME)
    assert np.isnan(score.psnr_hidden_ground)
    assert np.isfinite(score.psnr_shadows)


def test_a_car_ahead_turned_around_shows_a_side_that_no_camera_saw(view_of):
    assert view_of(AHEAD, "turn_35").seen is True
    around = view_of(AHEAD, "turn_180")
    assert around.seen is False
    assert around.vehicle.sum() > 100
    assert np.isfinite(score_view(around, "front", FRAME).psnr_unseen)
    assert view_of(AHEAD, "delete").seen is None


def test_one_vehicle_of_each_kind_is_chosen_by_its_pixels(street, scene):
    pixels = np.zeros((2, len(street.tracks)), np.int64)
    for object_id, count in ((AHEAD, 900), (PARKED, 700), ("car_3", 600), ("van_0", 199)):
        pixels[:, index(street, object_id)] = count
    assert choose_vehicles(scene, street, pixels) == {"parked": PARKED, "followed": AHEAD}
    objects = {k: v for k, v in scene.objects.items() if k != PARKED}
    fewer = replace(scene, objects=objects)
    assert choose_vehicles(fewer, street, pixels)["parked"] == "car_3"


def test_every_edit_of_every_chosen_vehicle_is_scored(street, scene):
    done = []
    scores = evaluate_edits(
        scene,
        street,
        street,
        [(street.rig["front"], frame) for frame in (2, 3)],
        on_edit=lambda *progress: done.append(progress),
    )
    names = [(s.vehicle, s.edit) for s in scores]
    assert names == [(kind, name) for kind in ("parked", "followed") for name in edits_of("a")]
    assert done[-1] == (10, 10)
    for score in scores:
        assert 5 < score.psnr < 40
        assert score.pixels == sum(view.pixels for view in score.views) >= 200
        assert {view.frame for view in score.views} == {2, 3}


def test_edits_of_a_recorded_log_are_refused():
    log = painted_log(frames=3)
    options = InitialiseOptions(max_background=2_000, max_object=200, sky_resolution=16)
    scene = initialise_scene(log, options=options)
    with pytest.raises(ReconstructError, match="only its own images are known"):
        evaluate_scene(scene, log, options=EvaluateOptions(edits=True, shifts=(), repeats=1))


def test_the_command_prints_edits_and_writes_them_to_json_and_the_report(street, scene, tmp_path):
    write_native_log(street, tmp_path / "log")
    save_scene(scene, tmp_path / "scene.r2s")
    arguments = ["evaluate", "scene.r2s", "log", "--frames", "2", "--shifts", "none", "--edits"]
    arguments += ["--json", "figures.json", "--report", "report"]
    with contextlib.chdir(tmp_path):
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    scores = json.loads((tmp_path / "figures.json").read_text())["edits"]
    html = (tmp_path / "report" / "report.html").read_text()
    assert {score["edit"] for score in scores} == set(edits_of("a"))
    for score in scores:
        assert f"{score['psnr']:.2f}" in result.output
        assert f"<td>{score['psnr']:.2f}</td>" in html
    assert html.count("truth after the edit</figcaption>") == len(scores)
