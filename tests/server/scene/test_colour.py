from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.scene import SceneError, TimeColour
from real2sim_server.scene.cloud import colour_basis
from real2sim_server.scene.io import load_scene, save_scene


def test_the_cosine_basis_has_half_periods():
    np.testing.assert_allclose(colour_basis(0.0, 3, "cosine"), [1, 1, 1])
    np.testing.assert_allclose(colour_basis(1.0, 3, "cosine"), [-1, 1, -1])
    np.testing.assert_allclose(colour_basis(0.5, 2, "cosine"), [0, -1], atol=1e-7)


def test_the_real_dft_basis_has_whole_periods():
    expected = [np.sin(0.4 * np.pi), np.cos(0.4 * np.pi), np.sin(0.8 * np.pi)]
    np.testing.assert_allclose(colour_basis(0.2, 3, "real_dft"), expected, rtol=1e-6)
    np.testing.assert_allclose(
        colour_basis(1.0, 4, "real_dft"), colour_basis(0.0, 4, "real_dft"), atol=1e-6
    )


def test_the_basis_is_clamped_outside_its_span():
    np.testing.assert_array_equal(colour_basis(1.7, 3, "cosine"), colour_basis(1.0, 3, "cosine"))


def test_only_the_constant_colour_changes(make_cloud):
    cloud = make_cloud(4)
    colour = TimeColour(torch.ones(4, 1, 3) * 0.5, "cosine", 100, 300)
    np.testing.assert_allclose(colour.at(cloud, 100).sh[:, 0], cloud.sh[:, 0] + 0.5)
    np.testing.assert_allclose(colour.at(cloud, 200).sh[:, 0], cloud.sh[:, 0], atol=1e-6)
    assert torch.equal(colour.at(cloud, 100).sh[:, 1:], cloud.sh[:, 1:])


def test_a_colour_with_a_wrong_count_is_refused(scene):
    colour = TimeColour(torch.zeros(3, 2, 3), "cosine", 0, 1)
    with pytest.raises(SceneError, match="3 rows for 20 Gaussians"):
        replace(scene.object("car_7"), colour=colour)


def test_an_empty_time_span_is_refused():
    with pytest.raises(SceneError, match="start before it ends"):
        TimeColour(torch.zeros(3, 2, 3), "cosine", 5, 5)


def test_bundles_keep_colours(scene, tmp_path):
    coefficients = torch.rand(20, 4, 3, generator=torch.Generator().manual_seed(0))
    colour = TimeColour(coefficients, "real_dft", 7, 400_007)
    objects = dict(scene.objects) | {"car_7": replace(scene.object("car_7"), colour=colour)}
    save_scene(replace(scene, objects=objects), tmp_path / "a.r2s")
    loaded = load_scene(tmp_path / "a.r2s").object("car_7").colour
    assert loaded is not None
    assert torch.equal(loaded.coefficients, colour.coefficients)
    assert (loaded.basis, loaded.start_us, loaded.end_us) == ("real_dft", 7, 400_007)


def test_bundles_without_colours_have_no_colour_entries(scene, tmp_path):
    save_scene(scene, tmp_path / "a.r2s")
    document = json.loads((tmp_path / "a.r2s" / "scene.json").read_text())
    assert all("colour" not in part for part in document["content"]["objects"])
