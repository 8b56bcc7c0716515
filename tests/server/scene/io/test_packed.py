"""Packed scenes: accuracy of round trips, and refused files."""

import contextlib
import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.scene import BundleError, TimeColour
from real2sim_server.scene.io import open_scene, read_packed, save_scene, write_packed


@pytest.fixture
def packed(scene, tmp_path):
    path = tmp_path / "street.r2s.zip"
    write_packed(scene, path)
    return path


def matched(before, after):
    """Gaussians of ``after`` in the order of ``before``, matched by their centres."""
    _, index = cKDTree(after.means.numpy()).query(before.means.numpy())
    assert len(set(index.tolist())) == len(index)
    return after.select(torch.from_numpy(index))


def same_rotation(a, b):
    return (torch.nn.functional.normalize(a, dim=1) * b).sum(1).abs()


def test_gaussians_round_trip_within_quantisation(scene, packed):
    read = read_packed(packed)
    pairs = [(scene.background, read.background)]
    pairs += [(scene.objects[key].cloud, read.objects[key].cloud) for key in scene.objects]
    for before, unordered in pairs:
        after = matched(before, unordered)
        extent = before.means.amax(0) - before.means.amin(0)
        assert ((before.means - after.means).abs() <= extent / 65535 + 1e-6).all()
        assert ((before.scales / after.scales).log().abs() < 1e-3).all()
        assert ((before.opacities - after.opacities).abs() <= 0.5 / 255 + 1e-6).all()
        assert (same_rotation(before.quats, after.quats) > 0.9998).all()
        assert (before.sh[:, 0] - after.sh[:, 0]).abs().max() < 2e-3
        assert (before.sh[:, 1:] - after.sh[:, 1:]).abs().max() <= before.sh[
            :, 1:
        ].abs().max() / 127


def test_other_parts_round_trip_exactly(scene, packed):
    read = read_packed(packed)
    assert read.name == scene.name
    assert read.provenance == scene.provenance
    assert read.ego_size == scene.ego_size
    assert list(read.objects) == list(scene.objects)
    assert read.rig.names == scene.rig.names
    assert (read.frame_times_us == scene.frame_times_us).all()
    for key, item in scene.objects.items():
        assert read.objects[key].size == item.size
        assert (read.objects[key].trajectory.positions == item.trajectory.positions).all()


def test_time_varying_colours_stay_with_their_gaussians(scene, tmp_path):
    key, item = next(iter(scene.objects.items()))
    # The coefficient of each Gaussian is its x coordinate, which identifies it after reading.
    own = item.cloud.means[:, :1, None].expand(-1, 1, 3).contiguous()
    coloured = replace(item, colour=TimeColour(own, "cosine", 0, 1_000_000))
    write_packed(replace(scene, objects={**scene.objects, key: coloured}), tmp_path / "a.r2s.zip")
    read = read_packed(tmp_path / "a.r2s.zip").objects[key]
    error = (read.colour.coefficients[:, 0, 0] - read.cloud.means[:, 0]).abs()
    assert error.max() < 4e-3 * item.cloud.means.abs().max()


def test_packing_is_reproducible(scene, packed, tmp_path):
    write_packed(scene, tmp_path / "again.r2s.zip")
    assert packed.read_bytes() == (tmp_path / "again.r2s.zip").read_bytes()


def test_missing_and_truncated_files_are_refused_by_name(packed, tmp_path):
    with pytest.raises(BundleError, match="nowhere"):
        read_packed(tmp_path / "nowhere.r2s.zip")
    short = tmp_path / "short.r2s.zip"
    short.write_bytes(packed.read_bytes()[:-200])
    with pytest.raises(BundleError, match=r"short\.r2s\.zip"):
        read_packed(short)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 4}, "version 4"),
        ({"format": "other"}, "no packed scene"),
        ({"ego_size": [1.0, 2.0]}, "damaged"),
    ],
)
def test_other_documents_are_refused(packed, tmp_path, change, message):
    other = tmp_path / "other.r2s.zip"
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "scene.json":
                data = json.dumps({**json.loads(data), **change}).encode()
            target.writestr(name, data)
    with pytest.raises(BundleError, match=message):
        read_packed(other)


def test_a_missing_array_is_refused(packed, tmp_path):
    other = tmp_path / "other.r2s.zip"
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            if name != "background.quats.npy":
                target.writestr(name, source.read(name))
    with pytest.raises(BundleError, match="damaged"):
        read_packed(other)


def test_bit_flips_raise_only_bundle_errors(packed, tmp_path):
    whole = packed.read_bytes()
    path = tmp_path / "damaged.r2s.zip"
    generator = np.random.default_rng(3)
    places = [*generator.integers(0, len(whole), 100), *range(len(whole) - 100, len(whole))]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        with contextlib.suppress(BundleError):
            read_packed(path)


def test_an_array_larger_than_the_file_is_refused(packed, tmp_path):
    other = tmp_path / "other.r2s.zip"
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "background.means.npy":
                head = io.BytesIO()
                described = {"descr": "<u2", "fortran_order": False, "shape": (10**12, 3)}
                np.lib.format.write_array_header_1_0(head, described)
                data = head.getvalue()
            target.writestr(name, data)
    with pytest.raises(BundleError, match="needs 6000000000000 bytes"):
        read_packed(other)


def test_packing_saves_60_percent(make_cloud, scene, tmp_path):
    big = replace(scene, background=make_cloud(20_000, degree=1))
    write_packed(big, tmp_path / "big.r2s.zip")
    raw = sum(np.prod(t.shape) * 4 for t in big.background.tensors().values())
    assert (tmp_path / "big.r2s.zip").stat().st_size < raw / 2.5


def test_scenes_are_opened_by_path_and_name(scene, tmp_path):
    saved = save_scene(scene, tmp_path / "a.r2s")
    assert open_scene(tmp_path / "a.r2s").content_hash == saved.content_hash
    assert open_scene("a.r2s", tmp_path).content_hash == saved.content_hash
    write_packed(scene, tmp_path / "a.r2s.zip")
    packed = save_scene(read_packed(tmp_path / "a.r2s.zip"), tmp_path / "b.r2s")
    assert open_scene(tmp_path / "a.r2s.zip").content_hash == packed.content_hash
    with pytest.raises(BundleError, match=r"no scene 'nowhere'; .* demo_street"):
        open_scene("nowhere", tmp_path)


def test_commands_take_the_shipped_scene_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        return CliRunner().invoke(build_app(), [*words, "--json", "figures.json"])

    assert "demo_street: has no lanes" in " ".join(run("map", "demo_street").output.split())
    log = tmp_path / "log"
    log.mkdir()
    refused = run("fit-lidar", "demo_street", str(log))
    assert "demo_street is not a bundle that can be changed" in " ".join(refused.output.split())
    assert not (tmp_path / "demo_street").exists()
