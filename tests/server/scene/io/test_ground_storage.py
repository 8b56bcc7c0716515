"""The ground in bundles and packed scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.scene import BundleError, Ground
from real2sim_server.scene.io import (
    load_scene,
    read_packed,
    read_scene_summary,
    save_scene,
    write_packed,
)


def test_the_ground_round_trips_exactly_in_bundles(scene, bundle):
    loaded = load_scene(bundle).stored_ground
    assert loaded is not None
    assert np.array_equal(loaded.heights, scene.ground.heights)
    assert np.array_equal(loaded.is_ground, scene.ground.is_ground)
    assert np.array_equal(loaded.origin, scene.ground.origin)
    assert loaded.cell == scene.ground.cell


def test_saving_returns_the_stored_ground(scene, tmp_path):
    assert save_scene(scene, tmp_path / "a.r2s").stored_ground is scene.ground


def test_the_hash_covers_the_ground(scene, tmp_path):
    plain = save_scene(scene, tmp_path / "a.r2s")
    raised = save_scene(replace(scene, stored_ground=Ground.level(1.0)), tmp_path / "b.r2s")
    assert plain.content_hash != raised.content_hash


def test_a_scene_and_its_summary_share_one_ground(bundle):
    loaded = load_scene(bundle)
    assert read_scene_summary(bundle).ground is loaded.ground


def test_a_summary_reads_the_ground_without_the_scene(scene, bundle):
    assert np.array_equal(read_scene_summary(bundle).ground.heights, scene.ground.heights)


def test_the_summary_of_a_replaced_bundle_raises(scene, bundle):
    summary = read_scene_summary(bundle)
    save_scene(replace(scene, stored_ground=Ground.level(1.0)), bundle, overwrite=True)
    with pytest.raises(BundleError, match="another bundle"):
        _ = summary.ground


def test_a_damaged_ground_is_refused(bundle):
    file = bundle / "ground.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    with pytest.raises(BundleError, match=r"ground\.safetensors: tensor"):
        load_scene(bundle)


def test_packed_scenes_keep_the_ground_to_half_a_millimetre(scene, tmp_path):
    write_packed(scene, tmp_path / "a.r2s.zip")
    unpacked = read_packed(tmp_path / "a.r2s.zip").stored_ground
    assert unpacked is not None
    np.testing.assert_allclose(unpacked.heights, scene.ground.heights, atol=0.000_51)
    assert np.array_equal(unpacked.is_ground, scene.ground.is_ground)
    assert np.array_equal(unpacked.origin, scene.ground.origin)
