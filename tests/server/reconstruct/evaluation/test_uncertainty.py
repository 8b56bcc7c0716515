"""Rendered uncertainty against errors of held-out images, and its metrics."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim_server.cli import app
from real2sim_server.logs import write_native_log
from real2sim_server.reconstruct import InitialiseOptions, ReconstructError, initialise_scene
from real2sim_server.reconstruct.evaluation.uncertainty import (
    evaluate_uncertainty,
    fit_uncertainties,
    rank_correlation,
    sparsification,
)
from real2sim_server.reconstruct.training import training_log
from real2sim_server.scene import UNSEEN
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

SMALL = InitialiseOptions(
    max_background=8_000, max_object=800, voxel=0.3, ground_spacing=0.3, sky_resolution=16
)
HELD_OUT = [2]


@pytest.fixture(scope="module")
def street():
    config = SyntheticConfig(
        seed=5,
        frames=5,
        width=72,
        height=48,
        cameras=(CameraSpec("front"),),
        samples=1,
        moving_cars=2,
        parked_cars=2,
        lidar_columns=256,
    )
    return generate_log(config)


@pytest.fixture(scope="module")
def scene(street):
    """A scene built without frame 2."""
    made = initialise_scene(training_log(street, 4), options=SMALL)
    provenance = made.provenance | {"reconstruction": {"held_out_frames": HELD_OUT}}
    return replace(made, provenance=provenance, frame_times_us=street.frame_times_us)


@pytest.fixture(scope="module")
def fitted(scene, street):
    return fit_uncertainties(scene, street, backend="cpu")


def test_uncertainty_ranks_the_errors_of_held_out_images(fitted, street):
    made, report = fitted
    assert report.views == 4
    views = [(street.rig["front"], frame) for frame in HELD_OUT]
    score = evaluate_uncertainty(made, street, views, backend="cpu")
    assert score.spearman > 0.6
    assert score.spearman_regions > 0.8
    assert score.sparsification < 0.35
    assert score.uncertainty == pytest.approx(score.error, rel=0.35)


def test_gaussians_without_training_rays_have_the_unseen_uncertainty(fitted, scene, street):
    made, report = fitted
    values = made.background.uncertainties
    behind = (made.background.means[:, 0] < -15).nonzero()[:, 0]
    assert len(behind)
    assert (values[behind] - UNSEEN).abs().max() < 1e-6
    below = made.sky.uncertainties[5]
    assert float((below - UNSEEN).abs().max()) < 1e-6
    assert 0 < report.seen < 1
    assert evaluate_uncertainty(scene, street, [(street.rig["front"], 2)]) is None


def test_fitting_is_reproducible(fitted, scene, street):
    again, _ = fit_uncertainties(scene, street, backend="cpu")
    first = fitted[0]
    assert again.background.uncertainties.equal(first.background.uncertainties)
    assert again.sky.uncertainties.equal(first.sky.uncertainties)


def test_fitting_without_training_images_is_refused(scene, street):
    everything = replace(scene, provenance={"reconstruction": {"held_out_frames": list(range(5))}})
    with pytest.raises(ReconstructError, match="no image of a pinhole camera"):
        fit_uncertainties(everything, street)


@pytest.mark.slow
def test_the_commands_fit_evaluate_and_render_uncertainty(scene, street, tmp_path):
    write_native_log(street, tmp_path / "log")
    save_scene(scene, tmp_path / "a.r2s")
    for arguments in (
        ["fit-uncertainty", "a.r2s", "log", "--json", "fitted.json"],
        [
            "evaluate",
            "a.r2s",
            "log",
            "--shifts",
            "none",
            "--json",
            "judged.json",
            "--report",
            "page.d",
        ],
        ["render", "a.r2s", "--modality", "uncertainty", "--out", "a.png"],
    ):
        given = [str(tmp_path / a) if "." in a or a == "log" else a for a in arguments]
        result = CliRunner().invoke(app, given)
        assert result.exit_code == 0, result.output
    assert load_scene(tmp_path / "a.r2s").has_uncertainties
    assert json.loads((tmp_path / "fitted.json").read_text())["views"] == 4
    assert "Uncertainty against error" in (tmp_path / "page.d" / "report.html").read_text()
    assert json.loads((tmp_path / "judged.json").read_text())["uncertainty"]["spearman"] > 0.6


def test_rank_correlation_uses_ranks_and_is_0_for_a_constant():
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert rank_correlation(values, np.exp(values)) == pytest.approx(1)
    assert rank_correlation(values, -values) == pytest.approx(-1)
    assert rank_correlation(values, np.zeros_like(values)) == 0


def test_sparsification_is_0_for_the_true_order_and_1_for_a_random_one():
    error = np.random.default_rng(1).random(20_000).astype(np.float32)
    chance = np.random.default_rng(2).random(20_000).astype(np.float32)
    assert sparsification(error**3, error) == pytest.approx(0, abs=1e-6)
    assert sparsification(chance, error) == pytest.approx(1, abs=0.05)
    assert sparsification(-error, error) > 1.5
