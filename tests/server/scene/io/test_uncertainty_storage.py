"""Uncertainties of Gaussians and sky, in bundles and packed scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from real2sim_server.scene import Asset, BundleError, SceneError, Sky
from real2sim_server.scene.io import (
    load_asset,
    load_scene,
    read_packed,
    read_scene_summary,
    save_asset,
    save_scene,
    write_packed,
)
from real2sim_server.scene.io.summary import read_asset_summary


def known(cloud):
    return replace(cloud, uncertainties=cloud.opacities * 0.3)


@pytest.fixture
def certain(scene):
    """The scene with uncertainties for all Gaussians and the sky."""
    objects = {name: replace(o, cloud=known(o.cloud)) for name, o in scene.objects.items()}
    sky = replace(scene.sky, uncertainties=scene.sky.faces.mean(-1).clamp(0, 1))
    return replace(scene, background=known(scene.background), objects=objects, sky=sky)


def test_uncertainties_round_trip(certain, tmp_path):
    save_scene(certain, tmp_path / "a.r2s")
    assert read_scene_summary(tmp_path / "a.r2s").has_uncertainties
    read = load_scene(tmp_path / "a.r2s")
    assert read.has_uncertainties
    assert torch.equal(read.background.uncertainties, certain.background.uncertainties)
    assert torch.equal(read.sky.uncertainties, certain.sky.uncertainties)
    for name, item in certain.objects.items():
        assert torch.equal(read.objects[name].cloud.uncertainties, item.cloud.uncertainties)


def test_a_summary_knows_what_images_saw(certain, tmp_path):
    save_scene(certain, tmp_path / "a.r2s")
    coverage = read_scene_summary(tmp_path / "a.r2s").coverage
    for name, item in certain.objects.items():
        for azimuth in (-2.0, 0.0, 1.0, 4.0):
            assert coverage.of_side(name, azimuth) == pytest.approx(
                certain.coverage.of_side(name, azimuth), nan_ok=True
            )
        poses = [item.trajectory.transform(item.trajectory.start_us)]
        assert coverage.of_ground(name, poses, item.size) == pytest.approx(
            certain.coverage.of_ground(name, poses, item.size), nan_ok=True
        )


def test_a_scene_without_uncertainties_has_none(scene, tmp_path):
    save_scene(scene, tmp_path / "a.r2s")
    assert not read_scene_summary(tmp_path / "a.r2s").has_uncertainties
    assert read_scene_summary(tmp_path / "a.r2s").coverage is scene.coverage is None
    read = load_scene(tmp_path / "a.r2s")
    assert read.background.uncertainties is read.sky.uncertainties is None


def test_assets_keep_uncertainties(scene, tmp_path):
    cloud = scene.object("car_3").cloud
    for name, kept in (("a", known(cloud)), ("b", cloud)):
        saved = save_asset(Asset("taxi", "car", (4.0, 2.0, 1.5), kept), tmp_path / name)
        read = load_asset(tmp_path / name)
        assert read.content_hash == saved.content_hash
        assert read_asset_summary(tmp_path / name).nbytes == kept.nbytes
    assert load_asset(tmp_path / "b").cloud.uncertainties is None
    assert torch.equal(load_asset(tmp_path / "a").cloud.uncertainties, known(cloud).uncertainties)


def test_changed_uncertainties_are_detected(certain, tmp_path):
    save_scene(certain, tmp_path / "a.r2s")
    file = tmp_path / "a.r2s" / "background.safetensors"
    stored = known(certain.background).uncertainties.numpy().tobytes()
    data = bytearray(file.read_bytes())
    data[data.index(stored)] ^= 1
    file.write_bytes(data)
    with pytest.raises(BundleError, match=r"'uncertainties' does not have the SHA-256"):
        load_scene(tmp_path / "a.r2s")


def test_invalid_uncertainties_are_refused(certain, tmp_path):
    sky = Sky(certain.sky.faces, torch.full_like(certain.sky.uncertainties, 2.0))
    with pytest.raises(SceneError, match=r"sky: uncertainties hold values outside \[0, 1\]"):
        save_scene(replace(certain, sky=sky), tmp_path / "a.r2s")
    with pytest.raises(SceneError, match="uncertainties of a sky must be"):
        Sky(certain.sky.faces, torch.zeros(6, 1, 2))


def test_packed_scenes_quantise_the_root_of_uncertainties(certain, scene, tmp_path):
    write_packed(certain, tmp_path / "a.r2s.zip")
    read = read_packed(tmp_path / "a.r2s.zip")
    given, back = (s.background.uncertainties.sqrt().sort().values for s in (certain, read))
    assert float((given - back).abs().max()) <= 0.5 / 255 + 1e-6
    off = (read.sky.uncertainties.sqrt() - certain.sky.uncertainties.sqrt()).abs()
    assert float(off.max()) <= 0.5 / 255 + 1e-6
    write_packed(scene, tmp_path / "b.r2s.zip")
    assert read_packed(tmp_path / "b.r2s.zip").background.uncertainties is None
