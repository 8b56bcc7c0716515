"""The ground in bundles and packed scenes, and what becomes of scenes stored without one."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

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
from real2sim_server.scene.io.container import content_hash


def without_ground(bundle: Path) -> Path:
    """The bundle as programs before version 3 wrote it."""
    file = bundle / "scene.json"
    document = json.loads(file.read_text())
    del document["content"]["ground"]
    del document["files"]["ground.safetensors"]
    document["version"] = 1
    document["content_hash"] = content_hash("scene", document["content"])
    file.write_text(json.dumps(document))
    (bundle / "ground.safetensors").unlink()
    return bundle


def test_a_bundle_keeps_the_ground_bit_for_bit(scene, bundle):
    loaded = load_scene(bundle).stored_ground
    assert loaded is not None
    assert np.array_equal(loaded.heights, scene.ground.heights)
    assert np.array_equal(loaded.is_ground, scene.ground.is_ground)
    assert np.array_equal(loaded.origin, scene.ground.origin)
    assert loaded.cell == scene.ground.cell
    assert json.loads((bundle / "scene.json").read_text())["version"] == 3


def test_saving_says_which_ground_was_stored(scene, tmp_path):
    assert save_scene(scene, tmp_path / "a.r2s").stored_ground is scene.ground


def test_the_ground_counts_for_the_hash(scene, tmp_path):
    plain = save_scene(scene, tmp_path / "a.r2s")
    raised = save_scene(replace(scene, stored_ground=Ground.level(1.0)), tmp_path / "b.r2s")
    assert plain.content_hash != raised.content_hash


def test_a_scene_and_its_summary_share_one_ground(bundle):
    loaded = load_scene(bundle)
    assert read_scene_summary(bundle).ground is loaded.ground


def test_a_summary_reads_the_ground_without_the_scene(scene, bundle):
    assert np.array_equal(read_scene_summary(bundle).ground.heights, scene.ground.heights)


def test_a_summary_of_a_bundle_that_was_replaced_says_so(scene, bundle):
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


def test_a_bundle_of_version_1_gets_the_ground_that_fits_it(scene, bundle):
    loaded = load_scene(without_ground(bundle))
    assert loaded.stored_ground is None
    assert np.array_equal(loaded.ground.heights, scene.ground.heights)


def test_a_summary_of_version_1_tells_the_same_ground_as_its_scene(scene, bundle):
    summary = read_scene_summary(without_ground(bundle))
    assert np.array_equal(summary.ground.heights, scene.ground.heights)
    assert load_scene(bundle).ground is summary.ground


def test_a_packed_scene_keeps_the_ground_to_half_a_millimetre(scene, tmp_path):
    write_packed(scene, tmp_path / "a.r2s.zip")
    unpacked = read_packed(tmp_path / "a.r2s.zip").stored_ground
    assert unpacked is not None
    np.testing.assert_allclose(unpacked.heights, scene.ground.heights, atol=0.000_51)
    assert np.array_equal(unpacked.is_ground, scene.ground.is_ground)
    assert np.array_equal(unpacked.origin, scene.ground.origin)


def test_a_packed_scene_of_version_1_gets_a_fitted_ground(scene, tmp_path):
    new, old = tmp_path / "new.r2s.zip", tmp_path / "old.r2s.zip"
    write_packed(scene, new)
    with zipfile.ZipFile(new) as source, zipfile.ZipFile(old, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "scene.json":
                document = json.loads(data) | {"version": 1}
                del document["ground"]
                data = json.dumps(document).encode()
            if not name.startswith("ground."):
                target.writestr(name, data)
    unpacked = read_packed(old)
    assert unpacked.stored_ground is None
    x, y, z = unpacked.ego.positions[0].tolist()
    assert unpacked.ground.height(x, y) == pytest.approx(z, abs=0.01)
