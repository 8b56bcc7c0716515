"""Round trips of every splat format within its documented rounding."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings

from real2sim_server.scene import GaussianCloud, SceneError
from real2sim_server.scene.cloud import SH_C0
from real2sim_server.scene.io import read_splats, write_splats
from real2sim_server.scene.io.ply import morton_order
from real2sim_server.scene.io.splats import FORMATS
from real2sim_server.scene.io.spz import Spz

from .splat_properties import covariances, largest_turn, recipes, rotation_angles

SUFFIXES = [known.suffix for known in FORMATS]

repeated = settings(
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    deadline=None,
)


def dc_colours(cloud):
    return 0.5 + SH_C0 * cloud.sh[:, 0].double().numpy()


def log_scales(cloud):
    return np.log(cloud.scales.double().numpy())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_invalid_values_are_not_written(make_cloud, tmp_path, suffix):
    cloud = make_cloud(3)
    cloud.means[1, 2] = float("nan")
    with pytest.raises(SceneError, match="means not finite"):
        write_splats(cloud, tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_suffix_is_refused_with_the_known_ones(make_cloud, tmp_path):
    with pytest.raises(SceneError, match=r"a\.obj: no splat format ends so; .*\.spz"):
        write_splats(make_cloud(1), tmp_path / "a.obj")


@pytest.mark.parametrize("version", [3, 4])
@repeated
@given(recipe=recipes())
def test_spz_rounds_as_documented(tmp_path, version, recipe):
    cloud = recipe.cloud()
    Spz(version=version).write(cloud, tmp_path / "a.spz")
    back = read_splats(tmp_path / "a.spz")
    assert (len(back), back.sh_degree) == (len(cloud), cloud.sh_degree)
    assert_near(back.means, cloud.means, 0.5 / 4096 + 1e-6)
    assert_near(log_scales(back), log_scales(cloud), 0.5 / 16 + 1e-5)
    assert_near(back.opacities, cloud.opacities, 0.5 / 255 + 1e-6)
    assert_near(back.sh[:, 0], cloud.sh[:, 0], 0.5 / 38.25 + 1e-5)
    assert_near(back.sh[:, 1:4], cloud.sh[:, 1:4].clamp(-1, 127 / 128), 0.5 / 16 + 1e-6)
    assert_near(back.sh[:, 4:], cloud.sh[:, 4:].clamp(-1, 127 / 128), 0.5 / 8 + 1e-6)
    assert rotation_angles(back, cloud).max(initial=0) < largest_turn(np.sqrt(0.5) / 511)


@repeated
@given(recipe=recipes(spreads=(1.0, 100.0)))
def test_splat_rounds_as_documented(tmp_path, recipe):
    cloud = recipe.cloud()
    write_splats(cloud, tmp_path / "a.splat")
    back = read_splats(tmp_path / "a.splat")
    order = match(cloud.means, back.means)
    cloud = cloud.select(order)
    assert torch.equal(back.means, cloud.means)
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=1e-6)
    assert_near(back.opacities, cloud.opacities, 0.5 / 255 + 1e-6)
    assert_near(dc_colours(back), dc_colours(cloud).clip(0, 1), 0.5 / 255 + 1e-6)
    # A part of 1 is clipped to 127/128. Normalization mostly compensates for it.
    assert rotation_angles(back, cloud).max(initial=0) < np.radians(1.2)


@repeated
@given(recipe=recipes(sh_reach=5.0))
def test_compressed_ply_rounds_as_documented(tmp_path, recipe):
    cloud = recipe.cloud()
    write_splats(cloud, tmp_path / "a.compressed.ply")
    back = read_splats(tmp_path / "a.compressed.ply")
    cloud = cloud.select(torch.from_numpy(morton_order(cloud.means.double().numpy())))
    assert (len(back), back.sh_degree) == (len(cloud), cloud.sh_degree)
    steps = np.array([2047, 1023, 2047])
    assert_within_chunks(back.means.numpy(), cloud.means.numpy(), steps)
    assert_within_chunks(log_scales(back), log_scales(cloud), steps)
    assert_within_chunks(dc_colours(back), dc_colours(cloud), np.array([255, 255, 255]))
    assert_near(back.opacities, cloud.opacities, 0.5 / 255 + 1e-6)
    # Bins are 1/32 wide. Clamped ends are off by at most a whole bin.
    assert_near(back.sh[:, 1:], cloud.sh[:, 1:].clamp(-4, 4), 1 / 32 + 1e-5)
    assert rotation_angles(back, cloud).max(initial=0) < largest_turn(np.sqrt(2) / 1023)


@repeated
@given(recipe=recipes())
def test_inria_ply_round_trips(tmp_path, recipe):
    cloud = recipe.cloud()
    write_splats(cloud, tmp_path / "a.ply")
    back = read_splats(tmp_path / "a.ply")
    assert torch.equal(back.means, cloud.means)
    assert torch.equal(back.sh, cloud.sh)
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=3e-6)
    np.testing.assert_allclose(back.opacities, cloud.opacities, atol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_zero_harmonics_stay_zero_in_spz(make_cloud, tmp_path, version):
    cloud = make_cloud(10, degree=3)
    cloud.sh[:, 1:] = 0
    Spz(version=version).write(cloud, tmp_path / "a.spz")
    assert (read_splats(tmp_path / "a.spz").sh[:, 1:] == 0).all()


@pytest.mark.parametrize(("reach", "step"), [(2047.9, 2**-12), (2048.1, 2**-11), (1e6, 2**-3)])
def test_spz_keeps_far_positions_with_a_coarser_step(make_cloud, tmp_path, reach, step):
    cloud = make_cloud(100)
    cloud.means[7] = torch.tensor([reach, -reach, 0.1])
    write_splats(cloud, tmp_path / "a.spz")
    assert_near(read_splats(tmp_path / "a.spz").means, cloud.means, step / 2 + 1e-5 * step + 1e-4)


def test_spz_refuses_positions_beyond_24_bits(make_cloud, tmp_path):
    cloud = make_cloud(2)
    cloud.means[0, 0] = 9e6
    with pytest.raises(SceneError, match="does not fit into an spz file; recentre"):
        write_splats(cloud, tmp_path / "a.spz")


def test_spz_writes_only_versions_3_and_4():
    with pytest.raises(SceneError, match="must be 3 or 4, not 2"):
        Spz(version=2)


def test_splat_files_are_sorted_by_importance(make_cloud, tmp_path):
    cloud = make_cloud(50)
    write_splats(cloud, tmp_path / "a.splat")
    back = read_splats(tmp_path / "a.splat")
    order = match(cloud.means, back.means)
    seen = (cloud.scales.prod(dim=1) * cloud.opacities)[order]
    assert (seen.diff() <= 1e-12).all()


def test_z_order_keeps_neighbours_together():
    random = np.random.default_rng(0)
    points = random.uniform(-50, 50, size=(8192, 3))
    sorted_points = points[morton_order(points)]
    volume, as_given = (
        np.median(np.ptp(p.reshape(32, 256, 3), axis=1).prod(axis=1))
        for p in (sorted_points, points)
    )
    # An aligned chunk takes 1/32 of the volume; others take several times as much.
    assert volume < 0.1 * as_given
    assert sorted(map(tuple, sorted_points)) == sorted(map(tuple, points))


def test_z_order_sorts_corners_by_octant():
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    shuffled = np.random.default_rng(1).permutation(8)
    np.testing.assert_array_equal(corners[shuffled][morton_order(corners[shuffled])], corners)


# Real files


def real(test_data, name):
    file = test_data / "splats" / name
    if not file.is_file():
        pytest.skip(f"no {file}")
    return read_splats(file)


@pytest.mark.parametrize(
    ("name", "turn"),
    [
        ("minimal-raw.spz", [1, 1, 1]),
        ("minimal-v2.spz", [1, 1, 1]),
        # The writer rotates y down to y up, as the format requires.
        ("minimal-v3.spz", [1, -1, -1]),
        ("minimal-v4.spz", [1, -1, -1]),
    ],
)
def test_all_samples_hold_the_same_four_splats(test_data, name, turn):
    splat, spz = real(test_data, "minimal.splat"), real(test_data, name)
    assert (len(spz), spz.sh_degree) == (4, 0)
    assert torch.equal(spz.means * torch.tensor(turn), splat.means)
    assert_near(log_scales(spz), log_scales(splat), 0.5 / 16)
    assert torch.equal(spz.opacities, splat.opacities)
    np.testing.assert_allclose(
        covariances(spz), np.eye(3)[None].repeat(4, 0) * 0.1**2, atol=2 * 0.1**2 / 32 + 1e-6
    )


def test_samples_have_the_same_colours(test_data):
    splat, v3 = dc_colours(real(test_data, "minimal.splat")), real(test_data, "minimal-v3.spz")
    step = SH_C0 / 38.25
    assert_near(dc_colours(v3), splat, 0.5 * step + 0.5 / 255)
    for name in ("minimal-raw.spz", "minimal-v2.spz"):
        # The writer copied the .splat bytes into the wider range of spz.
        stretched = 0.5 + (splat - 0.5) * SH_C0 / 0.15
        assert_near(dc_colours(real(test_data, name)), stretched, step)


def test_sample_versions_agree_exactly(test_data):
    for one, other in [("raw", "v2"), ("v3", "v4")]:
        a, b = (real(test_data, f"minimal-{v}.spz") for v in (one, other))
        for field in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.equal(getattr(a, field), getattr(b, field)), field


@pytest.mark.parametrize("version", [3, 4])
def test_spz_changes_a_real_cloud_only_by_rounding(test_data, tmp_path, version):
    cloud = real(test_data, "biker.compressed.ply")
    Spz(version=version).write(cloud, tmp_path / "biker.spz")
    back = read_splats(tmp_path / "biker.spz")
    assert_near(back.means, cloud.means, 0.5 / 4096 + 1e-6)
    assert_near(log_scales(back), log_scales(cloud).clip(-10, 95 / 16), 0.5 / 16 + 1e-5)
    assert_near(back.opacities, cloud.opacities, 0.5 / 255 + 1e-6)
    assert_near(back.sh[:, 0], cloud.sh[:, 0], 0.5 / 38.25 + 1e-5)
    assert rotation_angles(back, cloud).max() < largest_turn(np.sqrt(0.5) / 511)


def test_compressed_ply_keeps_positions_of_a_real_cloud(test_data, tmp_path):
    cloud = real(test_data, "donut.ply")
    write_splats(cloud, tmp_path / "once.compressed.ply")
    once = read_splats(tmp_path / "once.compressed.ply")
    assert len(once) == len(cloud)
    extent = float((cloud.means.amax(0) - cloud.means.amin(0)).max())
    order = torch.from_numpy(morton_order(cloud.means.double().numpy()))
    assert (once.means - cloud.means[order]).abs().max() < extent / 1023


def match(wanted: torch.Tensor, given: torch.Tensor) -> torch.Tensor:
    """Indices into ``wanted`` that reproduce ``given``."""
    left = {tuple(row): [] for row in wanted.tolist()}
    for index, row in enumerate(wanted.tolist()):
        left[tuple(row)].append(index)
    return torch.tensor([left[tuple(row)].pop(0) for row in given.tolist()], dtype=torch.int64)


def assert_near(given, expected, tolerance):
    difference = np.abs(np.asarray(given, dtype=float) - np.asarray(expected, dtype=float))
    assert difference.max(initial=0) <= tolerance


def assert_within_chunks(given: np.ndarray, expected: np.ndarray, steps: np.ndarray) -> None:
    """Assert errors of at most half a step of the chunk's extent."""
    for start in range(0, len(expected), 256):
        part = slice(start, start + 256)
        allowed = np.ptp(expected[part], axis=0) / steps / 2
        room = 1e-6 * (1 + np.abs(expected[part]).max())
        assert (np.abs(given[part] - expected[part]) <= allowed + room).all()


def test_an_empty_cloud_round_trips_in_every_format(tmp_path):
    for suffix in SUFFIXES:
        write_splats(GaussianCloud.empty(), tmp_path / f"a{suffix}")
        assert len(read_splats(tmp_path / f"a{suffix}")) == 0
