import hashlib

import numpy as np
import pytest
import torch

from real2sim_server.geometry import apply_transform
from real2sim_server.scene import Asset, BundleError, GaussianCloud, Scene, SceneError
from real2sim_server.scene.io import (
    import_splats,
    load_asset,
    load_scene,
    read_splats,
    save_asset,
    save_scene,
    write_splats,
)
from real2sim_server.scene.io.splats import suffixes


@pytest.fixture
def ply(make_cloud, tmp_path):
    write_splats(make_cloud(400, degree=1), tmp_path / "thing.ply")
    return tmp_path / "thing.ply"


@pytest.mark.parametrize("data", [b"", b"\x1f\x8b\x08", b"solid", b"\0" * 200_000])
def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path, data):
    (tmp_path / "x.bin").write_bytes(data)
    with pytest.raises(BundleError, match=r"x\.bin: not a ply .*PlayCanvas compressed ply, INRIA"):
        read_splats(tmp_path / "x.bin")


@pytest.mark.parametrize("name", ["missing.ply", "."])
def test_unreadable_files_are_refused(tmp_path, name):
    with pytest.raises(BundleError, match="cannot be read"):
        read_splats(tmp_path / name)


def test_a_splat_file_is_imported_as_a_scene(ply, tmp_path):
    scene = import_splats(ply, name="thing")
    assert isinstance(scene, Scene)
    assert (scene.name, len(scene.background), len(scene.objects)) == ("thing", 400, 0)
    assert torch.equal(scene.background.means, read_splats(ply).means)
    assert scene.end_us > scene.start_us
    save_scene(scene, tmp_path / "thing.r2s")
    assert len(load_scene(tmp_path / "thing.r2s").background) == 400


def test_the_camera_frames_the_imported_scene(ply):
    scene = import_splats(ply, name="thing")
    camera = scene.rig["front"]
    low, high = np.percentile(
        scene.background.means[scene.background.opacities >= 0.1].numpy(), [0.5, 99.5], axis=0
    )
    box = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    viewmat = camera.viewmat(scene.ego.transform(scene.start_us))
    seen = apply_transform(viewmat, np.vstack([box, (low + high) / 2])) @ camera.K.T
    pixels = seen[:, :2] / seen[:, 2:]
    assert (seen[:, 2] > 0).all()
    assert (pixels >= 0).all()
    assert (pixels <= [camera.width, camera.height]).all()
    np.testing.assert_allclose(pixels[-1], [480, 320], atol=1e-3)


def test_provenance_names_the_file_and_its_hash(ply):
    provenance = import_splats(ply, name="thing", up_axis="-y", scale=2.0).provenance
    assert provenance["file"] == "thing.ply"
    assert provenance["sha256"] == hashlib.sha256(ply.read_bytes()).hexdigest()
    assert (provenance["up_axis"], provenance["scale"]) == ("-y", 2.0)


def test_an_asset_is_centred_on_its_box(ply, tmp_path):
    asset = import_splats(ply, name="chair", as_asset=True, category="furniture")
    assert isinstance(asset, Asset)
    assert (asset.asset_id, asset.category) == ("chair", "furniture")
    visible = asset.cloud.means[asset.cloud.opacities >= 0.1].numpy()
    low, high = np.percentile(visible, [0.5, 99.5], axis=0)
    np.testing.assert_allclose(low + high, 0, atol=1e-4)
    np.testing.assert_allclose(asset.size, high - low, rtol=1e-4)
    save_asset(asset, tmp_path / "chair.r2s")
    assert load_asset(tmp_path / "chair.r2s").size == asset.size


def test_floaters_do_not_enlarge_the_box_of_an_asset(make_cloud, tmp_path):
    cloud = make_cloud(1000)
    cloud.opacities[:] = 0.9
    cloud.means[:] = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    cloud.means[0] = 500
    cloud.means[1:100] = -70
    cloud.opacities[1:100] = 0.01
    write_splats(cloud, tmp_path / "a.ply")
    asset = import_splats(tmp_path / "a.ply", name="a", as_asset=True)
    assert max(asset.size) < 1.01
    assert len(asset.cloud) == 1000


@pytest.mark.parametrize(
    ("up_axis", "up", "forward"),
    [("z", [0, 0, 1], [1, 0, 0]), ("y", [0, 1, 0], [0, 0, 1]), ("-y", [0, -1, 0], [0, 0, 1])],
)
def test_up_and_forward_of_the_file_become_z_and_x(make_cloud, tmp_path, up_axis, up, forward):
    cloud = make_cloud(2)
    cloud.means[:] = torch.tensor([up, forward])
    write_splats(cloud, tmp_path / "a.ply")
    means = import_splats(tmp_path / "a.ply", name="a", up_axis=up_axis).background.means
    torch.testing.assert_close(means, torch.tensor([[0.0, 0, 1], [1, 0, 0]]))


def test_yaw_and_scale_are_applied(make_cloud, tmp_path):
    cloud = make_cloud(1)
    cloud.means[:] = torch.tensor([1.0, 0, 0.5])
    write_splats(cloud, tmp_path / "a.ply")
    turned = import_splats(tmp_path / "a.ply", name="a", yaw=np.pi / 2, scale=3.0).background
    torch.testing.assert_close(turned.means, torch.tensor([[0.0, 3, 1.5]]))
    torch.testing.assert_close(turned.scales, cloud.scales * 3)


@pytest.mark.parametrize(
    "options", [{"up_axis": "x"}, {"scale": 0.0}, {"scale": float("inf")}, {"yaw": float("nan")}]
)
def test_bad_options_are_refused(ply, options):
    with pytest.raises(SceneError):
        import_splats(ply, name="a", **options)


def test_a_file_without_splats_is_refused(tmp_path):
    write_splats(GaussianCloud.empty(), tmp_path / "a.ply")
    with pytest.raises(BundleError, match="holds no splats"):
        import_splats(tmp_path / "a.ply", name="a")


# Real files


def real(test_data, name):
    file = test_data / "splats" / name
    if not file.is_file():
        pytest.skip(f"no {file}")
    return file


def test_a_real_compressed_ply_has_plausible_values(test_data):
    cloud = read_splats(real(test_data, "biker.compressed.ply"))
    cloud.check_values("biker")
    assert (len(cloud), cloud.sh_degree) == (152_746, 0)
    # A motorcyclist, y down, feet at 0, about 3 units high.
    assert cloud.means[:, 1].min() == pytest.approx(-3.18, abs=0.01)
    assert cloud.means[:, 1].max() == pytest.approx(0, abs=0.01)
    assert 1e-3 < cloud.scales.median() < 1e-2
    colour = 0.5 + 0.28209479 * cloud.sh[:, 0]
    assert colour.min() >= -1e-5
    assert colour.max() <= 1 + 1e-5


def test_a_real_inria_ply_has_plausible_values(test_data):
    cloud = read_splats(real(test_data, "donut.ply"))
    cloud.check_values("donut")
    assert (len(cloud), cloud.sh_degree) == (45_624, 0)
    extent = (cloud.means.amax(0) - cloud.means.amin(0)).tolist()
    assert extent == pytest.approx([0.209, 0.207, 0.095], abs=0.001)
    assert 0.6 < cloud.opacities.median() < 0.7
    assert 5e-4 < cloud.scales.median() < 1e-3


def test_a_real_torus_has_a_hole(test_data):
    asset = import_splats(real(test_data, "donut.ply"), name="donut", as_asset=True)
    radius = asset.cloud.means[:, :2].norm(dim=1)
    # A torus 0.2 wide: almost empty near the axis.
    assert (radius < 0.01).float().mean() < 0.02
    assert (radius > 0.04).float().mean() > 0.8


def test_a_plain_point_cloud_is_refused_with_missing_properties(test_data):
    with pytest.raises(BundleError, match=r"lacks the properties \['f_dc_0'.*point cloud"):
        read_splats(real(test_data, "car_benz_points.ply"))


def test_splats_out_of_reach_are_left_out(make_cloud, tmp_path):
    cloud = make_cloud(5)
    cloud.means[1, 0], cloud.scales[3] = -3e6, 2e6
    write_splats(cloud, tmp_path / "a.ply")
    scene = import_splats(tmp_path / "a.ply", name="a")
    assert torch.equal(scene.background.means, cloud.means[[0, 2, 4]])
    assert scene.provenance["notes"][-1] == (
        "2 of 5 splats are more than 1000 km from the origin (1) or as wide (1): they are left out"
    )
    assert len(import_splats(tmp_path / "a.ply", name="a", scale=0.1).background) == 5


def test_geographic_coordinates_are_refused(make_cloud, tmp_path):
    cloud = make_cloud(5)
    cloud.means[:, 1] += 5.3e6
    write_splats(cloud, tmp_path / "a.ply")
    with pytest.raises(BundleError, match=r"no splat is left.* subtract an offset"):
        import_splats(tmp_path / "a.ply", name="a")


def test_the_suffix_may_be_in_capitals(make_cloud, tmp_path):
    for suffix in suffixes():
        write_splats(make_cloud(5), tmp_path / f"a{suffix}")
        (tmp_path / f"a{suffix}").rename(tmp_path / f"A{suffix.upper()}")
        assert len(read_splats(tmp_path / f"A{suffix.upper()}")) == 5


def test_an_unstated_up_axis_is_told(make_cloud, tmp_path):
    write_splats(make_cloud(5), tmp_path / "a.ply")
    write_splats(make_cloud(5), tmp_path / "b.ply", up_axis="-y")
    one, other = (import_splats(tmp_path / f"{n}.ply", name="a").provenance for n in "ab")
    assert (one["up_axis"], other["up_axis"]) == ("z", "-y")
    assert "does not say which axis points up: z is used" in one["notes"][-1]
    assert other["notes"] == []
