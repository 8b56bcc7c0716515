"""Evaluation of a whole scene on a small street, and of its log on disk."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim_server.cli import app
from real2sim_server.logs import open_log, write_native_log
from real2sim_server.reconstruct import InitialiseOptions, ReconstructError, initialise_scene
from real2sim_server.reconstruct.evaluation import EvaluateOptions, evaluate_scene
from real2sim_server.reconstruct.evaluation.images import find_truth
from real2sim_server.reconstruct.evaluation.rendering import select_frames
from real2sim_server.reconstruct.evaluation.scores import box_error, logged_mask
from real2sim_server.reconstruct.evaluation.shifted import evaluate_shifts, true_view
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

from ..conftest import painted_log

SMALL = InitialiseOptions(
    max_background=30_000,
    max_object=3_000,
    voxel=0.15,
    ground_spacing=0.2,
    sky_resolution=32,
)
ONCE = EvaluateOptions(repeats=1, shifts=())


@pytest.fixture(scope="module")
def street():
    config = SyntheticConfig(
        seed=5,
        frames=6,
        width=96,
        height=64,
        cameras=(CameraSpec("front"),),
        samples=1,
        moving_cars=2,
        parked_cars=2,
        lidar_columns=512,
    )
    return generate_log(config)


@pytest.fixture(scope="module")
def street_scene(street):
    return initialise_scene(street, options=SMALL)


@pytest.fixture(scope="module")
def on_disk(street, street_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluation")
    write_native_log(street, folder / "log")
    save_scene(street_scene, folder / "scene.r2s")
    return folder


def with_provenance(scene, **reconstruction):
    return replace(scene, provenance={**scene.provenance, "reconstruction": reconstruction})


def test_held_out_frames_are_evaluated_as_held_out(street, street_scene):
    trained = with_provenance(street_scene, stage=1, held_out_frames=[1, 4])
    assert select_frames(trained, street, "held-out") == select_frames(trained, street, [4, 1])
    assert select_frames(trained, street, "held-out").frames == (1, 4)
    assert select_frames(trained, street, "held-out").held_out
    assert not select_frames(trained, street, [1, 2]).held_out


def test_untrained_scenes_are_evaluated_on_every_fourth_frame(street, street_scene):
    chosen = select_frames(street_scene, street, "held-out")
    assert (chosen.frames, chosen.held_out) == ((2,), False)
    assert select_frames(street_scene, street, "all").frames == tuple(range(6))


def test_an_invalid_frame_selection_is_refused(street, street_scene):
    with pytest.raises(ReconstructError, match=r"frame 6: .* has frames 0 to 5"):
        select_frames(street_scene, street, [2, 6])
    with pytest.raises(ReconstructError, match="'held-out', 'all' or numbers, not 'some'"):
        select_frames(street_scene, street, "some")


def test_a_scene_of_another_rig_is_refused(street, street_scene):
    log = painted_log(frames=3)
    other = replace(log, rig=replace(log.rig, cameras=(replace(log.rig["front"], name="rear"),)))
    with pytest.raises(ReconstructError, match=r"lacks \['rear'\]"):
        evaluate_scene(street_scene, other, options=ONCE)


def test_a_scene_of_a_flat_wall_and_box_has_small_depth_errors():
    log = painted_log(frames=5)
    options = InitialiseOptions(
        max_background=60_000, max_object=4_000, ground_spacing=0.12, sky_resolution=32
    )
    result = evaluate_scene(initialise_scene(log, options=options), log, options=ONCE)
    assert result.depth_error_m < 0.1
    assert result.depth_error_m <= result.depth_error_p90_m < 0.5
    assert result.psnr > 20
    assert result.psnr_objects > 15
    assert result.views[0].lidar_missed < 0.05
    assert result.views[0].object_pixels == logged_mask(log, log.rig["front"], 2).sum()


def test_object_pixels_have_their_own_psnr(street, street_scene):
    without = replace(street_scene, objects={})
    whole = evaluate_scene(street_scene, street, options=ONCE)
    bare = evaluate_scene(without, street, options=ONCE)
    assert whole.views[0].object_pixels == bare.views[0].object_pixels > 0
    assert bare.psnr_objects < whole.psnr_objects - 1


def test_ground_truth_is_regenerated_from_a_log_on_disk(street, on_disk):
    truth = find_truth(open_log(on_disk / "log"))
    assert truth.log is not None
    camera, t_us = street.rig["front"], int(street.frame_times_us[3])
    expected, depth, _ = true_view(street, camera, t_us, 1.5)
    again, depth_again, _ = true_view(truth.log, camera, t_us, 1.5)
    np.testing.assert_array_equal(again, expected)
    np.testing.assert_array_equal(depth_again, depth)


def test_a_log_that_does_not_match_its_config_has_no_ground_truth(street, on_disk):
    log = open_log(on_disk / "log")
    config = {**log.provenance["config"], "seed": 6}
    truth = find_truth(replace(log, provenance={**log.provenance, "config": config}))
    assert truth.log is None
    assert "another street" in truth.missing


def test_a_recorded_log_has_no_ground_truth():
    log = painted_log(frames=3)
    truth = find_truth(log)
    assert truth.log is None
    assert "only its own images are known" in truth.missing


def test_a_positive_shift_moves_the_camera_left(street):
    t_us = int(street.frame_times_us[2])
    camera = street.rig["front"]
    _, _, here = true_view(street, camera, t_us, 0.0)
    _, _, there = true_view(street, camera, t_us, 2.0)
    # The camera's x axis points right.
    np.testing.assert_allclose(np.linalg.inv(here) @ there @ [0, 0, 0, 1], [-2, 0, 0, 1], atol=1e-9)


def test_shifted_views_are_evaluated_on_both_sides(street, street_scene):
    times = [int(street.frame_times_us[2])]
    near, far = evaluate_shifts(street_scene, street, list(street.rig), times, [0.5, 3.0])
    assert near.views + near.views_in_objects == far.views + far.views_in_objects == 2
    assert 10 < near.psnr < 40
    assert near.depth_error_m < 0.5


def test_the_command_writes_json_and_a_self_contained_report(on_disk):
    figures, page = on_disk / "figures.json", on_disk / "report" / "report.html"
    arguments = ["evaluate", on_disk / "scene.r2s", on_disk / "log", "--json", figures]
    arguments += ["--frames", "2,3", "--shifts", "1", "--report", page.parent]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    values = json.loads(figures.read_text())
    for key in ("psnr", "ssim", "psnr_objects", "depth_error_m", "frames_per_second"):
        assert values[key] > 0, key
    assert values["depth_error_p90_m"] >= values["depth_error_m"]
    assert "depth_error_p90_m" in result.output
    assert values["depth_error_mean_m"] >= values["depth_error_m"]
    assert [v["frame"] for v in values["views"]] == values["frames"] == [2, 3]
    assert [s["shift_m"] for s in values["shifted"]] == [1.0]
    assert "no_shifted" not in values
    assert [s["shift_m"] for s in values["lane_band"]] == [1.0]
    assert "road at 1 m offset" in result.output
    html = page.read_text()
    assert html.count("data:image/jpeg;base64,") >= 8
    assert not re.search(r"https?://|<script|<link", html)
    assert f"{values['psnr']:.2f}" in html
    assert html.count("90th percentile [m]") == 2
    assert f"<td>{values['depth_error_p90_m']:.3f}</td>" in html


@pytest.mark.slow
def test_a_scene_of_part_of_a_log_is_evaluated_on_that_part(on_disk, tmp_path):
    scene, figures = tmp_path / "part.r2s", tmp_path / "figures.json"
    part = ["--frames", "2:5", "--cameras", "front"]
    commands = [
        ["reconstruct", on_disk / "log", "--out", scene, *part],
        ["evaluate", scene, on_disk / "log", "--frames", "all", "--shifts", "none",
         "--json", figures],
    ]  # fmt: skip
    for arguments in commands:
        result = CliRunner().invoke(app, [str(a) for a in arguments])
        assert result.exit_code == 0, result.output
    made, log = load_scene(scene), open_log(on_disk / "log")
    assert made.frame_times_us.tolist() == log.frame_times_us[2:5].tolist()
    assert made.provenance["selection"] == {"frames": [2, 5, 1], "cameras": ["front"]}
    assert json.loads(figures.read_text())["frames"] == [0, 1, 2]


@pytest.mark.parametrize("frames", ["5", "a:b", "-1:3"])
def test_an_invalid_frame_range_is_refused(on_disk, tmp_path, frames):
    arguments = ["reconstruct", on_disk / "log", "--out", tmp_path / "x.r2s", "--frames", frames]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 1
    assert "first:stop such as 50:100" in result.output


def test_the_command_lists_the_allowed_frame_values(on_disk):
    arguments = ["evaluate", str(on_disk / "scene.r2s"), str(on_disk / "log"), "--frames", "2-5"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert "held-out, all, or numbers" in result.output


def test_results_without_ground_truth_explain_missing_shifted_views():
    log = painted_log(frames=3, boxes=False)
    scene = initialise_scene(log, options=SMALL)
    result = evaluate_scene(scene, log, options=replace(ONCE, shifts=(1.0,)))
    values = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert "shifted" not in values
    assert "no ground truth exists" in values["no_shifted"]
    assert values["psnr_objects"] is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 4}, "width must be"),
        ({"shifts": (0.0,)}, "shifts must be"),
        ({"repeats": 0}, "repeats must be"),
    ],
)
def test_options_out_of_range_are_refused(changes, message):
    with pytest.raises(ReconstructError, match=message):
        EvaluateOptions(**changes)


def test_boxes_of_the_log_itself_have_no_error(street, street_scene):
    assert box_error(street_scene, street) == pytest.approx(0, abs=1e-9)


def test_the_box_error_is_the_distance_between_centres(street, street_scene):
    shift = np.eye(4)
    shift[:2, 3] = 0.3, 0.4
    objects = {
        key: replace(item, trajectory=item.trajectory.moved(shift))
        for key, item in street_scene.objects.items()
    }
    moved = replace(street_scene, objects=objects, content_hash="")
    assert box_error(moved, street) == pytest.approx(0.5, abs=1e-6)


def test_a_scene_without_the_objects_of_the_log_has_no_box_error(street, street_scene):
    bare = replace(street_scene, objects={}, content_hash="")
    assert np.isnan(box_error(bare, street))
