from pathlib import Path

import numpy as np
import pytest
import torch

from real2sim_server.scene import BundleError, GaussianCloud, SceneError
from real2sim_server.scene.io import import_splats, read_splats, write_splats

BASE = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Write a ply with exactly these properties, in this order and with these types."""
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
    count = len(next(iter(columns.values())))
    records = np.empty(count, dtype=[(n, v.dtype) for n, v in columns.items()])
    for name, values in columns.items():
        records[name] = values
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {names[v.dtype.str[1:]]} {n}" for n, v in columns.items()]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + records.tobytes())
    return path


@pytest.fixture
def columns() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    return {name: random.normal(size=6).astype(np.float32) for name in BASE}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_written_cloud_round_trips(make_cloud, tmp_path, degree):
    cloud = make_cloud(31, degree=degree)
    write_splats(cloud, tmp_path / "a.ply")
    back = read_splats(tmp_path / "a.ply")
    assert torch.equal(back.means, cloud.means)
    assert torch.equal(back.sh, cloud.sh)
    torch.testing.assert_close(back.quats, cloud.quats, rtol=0, atol=2e-7)
    torch.testing.assert_close(back.scales, cloud.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.opacities, cloud.opacities, rtol=1e-6, atol=1e-7)


def test_opacities_of_zero_and_one_survive(make_cloud, tmp_path):
    cloud = make_cloud(2)
    cloud.opacities[:] = torch.tensor([0.0, 1.0])
    write_splats(cloud, tmp_path / "a.ply")
    back = read_splats(tmp_path / "a.ply").opacities
    assert back[0] < 1e-16
    assert back[1] == 1


def test_an_empty_cloud_round_trips(tmp_path):
    write_splats(GaussianCloud.empty(sh_degree=2), tmp_path / "a.ply")
    back = read_splats(tmp_path / "a.ply")
    assert (len(back), back.sh_degree) == (0, 2)


def test_parameters_are_activated(columns, tmp_path):
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns))
    c = {name: torch.from_numpy(values) for name, values in columns.items()}
    torch.testing.assert_close(cloud.means[:, 1], c["y"])
    torch.testing.assert_close(cloud.scales[:, 2], c["scale_2"].exp())
    torch.testing.assert_close(cloud.opacities, c["opacity"].sigmoid())
    torch.testing.assert_close(cloud.sh[:, 0, 1], c["f_dc_1"])
    raw = torch.stack([c[f"rot_{i}"] for i in range(4)], dim=1)
    torch.testing.assert_close(cloud.quats, raw / raw.norm(dim=1, keepdim=True))


@pytest.mark.parametrize(("count", "degree"), [(9, 1), (24, 2), (45, 3)])
def test_harmonics_are_stored_channel_by_channel(columns, tmp_path, count, degree):
    rest = {f"f_rest_{i}": np.full(6, i, np.float32) for i in range(count)}
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns | rest))
    assert cloud.sh_degree == degree
    bands = count // 3
    for channel in range(3):
        assert cloud.sh[0, 1:, channel].tolist() == [channel * bands + k for k in range(bands)]


def test_property_order_types_and_extras_do_not_matter(columns, tmp_path):
    plain = read_splats(write_columns(tmp_path / "a.ply", columns))
    other = {name: columns[name] for name in reversed(columns)}
    other["y"] = other["y"].astype(np.float64)
    other = {"semantic": np.arange(6, dtype=np.int32), "nx": columns["x"], **other}
    other["flag"] = np.zeros(6, np.uint8)
    again = read_splats(write_columns(tmp_path / "b.ply", other))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(plain, name), getattr(again, name))


def test_byte_properties_are_read_as_numbers(columns, tmp_path):
    columns["x"] = np.arange(6, dtype=np.uint8)
    assert read_splats(write_columns(tmp_path / "a.ply", columns)).means[:, 0].tolist() == [
        *(0, 1, 2, 3, 4, 5)
    ]


@pytest.mark.parametrize("name", BASE)
def test_nan_is_refused_with_property_and_count(columns, tmp_path, name):
    columns[name][[2, 4]] = np.nan
    reason = rf"a\.ply: property '{name}' is NaN.* in 2 of 6 splats, the first at 2"
    with pytest.raises(BundleError, match=reason):
        read_splats(write_columns(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("name", ["x", "f_dc_2", "scale_1", "rot_3"])
def test_infinity_is_refused(columns, tmp_path, name):
    columns[name][0] = -np.inf
    with pytest.raises(BundleError, match=rf"property '{name}' .* 1 of 6"):
        read_splats(write_columns(tmp_path / "a.ply", columns))


def test_damaged_splats_are_left_out_and_counted(columns, tmp_path):
    columns["x"][1] = np.nan
    columns["f_dc_2"][[1, 3]] = np.inf
    columns["scale_0"][4] = 200
    file = write_columns(tmp_path / "a.ply", columns)
    notes: list[str] = []
    cloud = read_splats(file, notes=notes)
    assert cloud.means[:, 1].tolist() == columns["y"][[0, 2, 5]].tolist()
    (sentence,) = notes
    assert sentence.startswith("3 of 6 splats")
    assert "(1 means, 1 scales, 2 sh): they are left out" in sentence
    assert import_splats(file, name="a").provenance["notes"][0] == sentence


def test_a_file_without_usable_splats_is_refused(columns, tmp_path):
    columns["y"][:] = np.nan
    with pytest.raises(BundleError, match=r"6 of 6 splats .* no splat is left"):
        read_splats(write_columns(tmp_path / "a.ply", columns), notes=[])


def test_rotations_of_length_zero_do_not_rotate(columns, tmp_path):
    for k in range(4):
        columns[f"rot_{k}"][2] = 0
    notes: list[str] = []
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns), notes=notes)
    assert cloud.quats[2].tolist() == [1, 0, 0, 0]
    assert notes == [
        "1 of 6 rotations have length zero, the first at 2: these splats are not rotated"
    ]


def test_activated_parameters_are_recognised(columns, tmp_path):
    plain = read_splats(write_columns(tmp_path / "a.ply", columns))
    columns["opacity"] = plain.opacities.numpy()
    for k in range(3):
        columns[f"scale_{k}"] = plain.scales[:, k].numpy()
    notes: list[str] = []
    cloud = read_splats(write_columns(tmp_path / "b.ply", columns), notes=notes)
    torch.testing.assert_close(cloud.opacities, plain.opacities)
    torch.testing.assert_close(cloud.scales, plain.scales)
    assert ["read as they are" in sentence for sentence in notes] == [True]


@pytest.mark.parametrize("part", ["opacity", "scale"])
def test_doubtful_parameters_are_told(columns, tmp_path, part):
    for name in columns:
        if name.startswith(part):
            columns[name] = np.abs(columns[name]) % 1
    notes: list[str] = []
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns), notes=notes)
    torch.testing.assert_close(cloud.scales[:, 0], torch.from_numpy(columns["scale_0"]).exp())
    torch.testing.assert_close(cloud.opacities, torch.from_numpy(columns["opacity"]).sigmoid())
    assert len(notes) == 1


def test_own_files_are_never_mistaken_for_activated_ones(make_cloud, tmp_path):
    cloud = make_cloud(3)
    cloud.opacities[:], cloud.scales[:] = 0.6, 3.0
    write_splats(cloud, tmp_path / "a.ply")
    notes: list[str] = []
    back = read_splats(tmp_path / "a.ply", notes=notes)
    torch.testing.assert_close(back.scales, cloud.scales)
    torch.testing.assert_close(back.opacities, cloud.opacities)
    assert notes == []


def test_the_3d_filter_of_mip_splatting_is_applied(columns, tmp_path):
    plain = read_splats(write_columns(tmp_path / "a.ply", columns))
    width = np.linspace(0, 0.5, 6, dtype=np.float32)
    notes: list[str] = []
    file = write_columns(tmp_path / "b.ply", columns | {"filter_3D": width})
    cloud = read_splats(file, notes=notes)
    squares = plain.scales.square()
    wider = squares + torch.from_numpy(width)[:, None] ** 2
    factor = (squares.prod(dim=1) / wider.prod(dim=1)).sqrt()
    torch.testing.assert_close(cloud.scales, wider.sqrt())
    torch.testing.assert_close(cloud.opacities, plain.opacities * factor)
    assert ["filter_3D" in sentence for sentence in notes] == [True]


def test_harmonics_of_degree_four_are_cut(columns, tmp_path):
    rest = {f"f_rest_{i}": np.full(6, i, np.float32) for i in range(72)}
    notes: list[str] = []
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns | rest), notes=notes)
    assert cloud.sh_degree == 3
    assert cloud.sh[0, 1:, 1].tolist() == [24 + k for k in range(15)]
    assert len(notes) == 1


def test_infinite_logits_become_opacities_of_zero_and_one(columns, tmp_path):
    columns["opacity"][:2] = [-np.inf, np.inf]
    cloud = read_splats(write_columns(tmp_path / "a.ply", columns))
    assert cloud.opacities[:2].tolist() == [0, 1]


def test_zero_length_rotations_are_refused(columns, tmp_path):
    for i in range(4):
        columns[f"rot_{i}"][3] = 0
    with pytest.raises(BundleError, match="1 of 6 rotations have length zero, the first at 3"):
        read_splats(write_columns(tmp_path / "a.ply", columns))


def test_scales_beyond_float32_are_refused(columns, tmp_path):
    columns["scale_0"][1] = 200
    with pytest.raises(
        BundleError, match=r"1 of 6 splats .* beyond the range of float32 \(1 scales\)"
    ):
        read_splats(write_columns(tmp_path / "a.ply", columns))


def test_vanishing_scales_stay_positive(columns, tmp_path):
    columns["scale_0"][1] = -1000
    read_splats(write_columns(tmp_path / "a.ply", columns)).check_values("cloud")


@pytest.mark.parametrize("name", ["z", "opacity", "rot_2"])
def test_missing_properties_are_named(columns, tmp_path, name):
    del columns[name]
    with pytest.raises(BundleError, match=rf"lacks the properties \['{name}'\]"):
        read_splats(write_columns(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("indices", [[0], range(8), range(10), range(1, 10), range(48)])
def test_incomplete_harmonics_are_refused(columns, tmp_path, indices):
    rest = {f"f_rest_{i}": columns["x"] for i in indices}
    with pytest.raises(BundleError, match="f_rest properties; allowed"):
        read_splats(write_columns(tmp_path / "a.ply", columns | rest))


def test_a_ply_without_vertices_is_refused(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement point 0\nproperty float x\nend_header\n"
    (tmp_path / "a.ply").write_text(header)
    with pytest.raises(BundleError, match="no 'vertex' element"):
        read_splats(tmp_path / "a.ply")


def test_a_non_finite_cloud_is_not_written(make_cloud, tmp_path):
    cloud = make_cloud()
    cloud.means[0, 0] = float("nan")
    with pytest.raises(SceneError, match="not finite"):
        write_splats(cloud, tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_the_old_file(make_cloud, tmp_path, monkeypatch):
    file = tmp_path / "a.ply"
    write_splats(make_cloud(3), file)
    before = file.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "no space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        write_splats(make_cloud(9), file)
    assert file.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["a.ply"]
