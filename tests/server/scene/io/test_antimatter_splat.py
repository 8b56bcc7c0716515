import struct

import numpy as np
import pytest

from real2sim_server.scene import BundleError
from real2sim_server.scene.io import read_splats

SH_C0 = 0.28209479177387814


def record(
    position=(1, 2, 3), scale=(0.1, 0.2, 0.3), rgba=(0, 128, 255, 51), rotation=(255,) + (128,) * 3
):
    return struct.pack("<6f8B", *position, *scale, *rgba, *rotation)


def test_records_are_decoded_as_specified(tmp_path):
    (tmp_path / "a.splat").write_bytes(record() + record(rotation=(128, 192, 128, 64)))
    cloud = read_splats(tmp_path / "a.splat")
    cloud.check_values("cloud")
    assert cloud.means[0].tolist() == [1, 2, 3]
    np.testing.assert_allclose(cloud.scales[0], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(cloud.opacities, 0.2, rtol=1e-6)
    colours = 0.5 + SH_C0 * cloud.sh[0, 0].numpy()
    np.testing.assert_allclose(colours, [0, 128 / 255, 1], atol=1e-6)
    np.testing.assert_allclose(cloud.quats[0], [1, 0, 0, 0])
    np.testing.assert_allclose(cloud.quats[1], [0, 0.5**0.5, 0, -(0.5**0.5)], atol=1e-6)


def test_zero_scales_become_the_smallest_positive_scale(tmp_path):
    (tmp_path / "a.splat").write_bytes(record(scale=(0, 1, 1)))
    read_splats(tmp_path / "a.splat").check_values("cloud")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (record()[:-1], "truncated, or not a .splat file: 31 bytes are not a multiple of 32"),
        (record() * 2 + b"\0", "truncated, or not a .splat file: 65 bytes"),
        (record() + record(position=(0, float("nan"), 0)), "position is NaN.* in 1 of 2 .* at 1"),
        (record(position=(float("inf"), 0, 0)), "position is NaN, infinite"),
        (record(scale=(1, -1, 1)), "scale is NaN, infinite or negative in 1 of 1"),
        (record(scale=(1, float("nan"), 1)), "scale is NaN"),
        (record(rotation=(128,) * 4), "1 of 1 rotations have length zero"),
    ],
)
def test_damaged_files_are_refused(tmp_path, data, reason):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(BundleError, match=rf"a\.splat: {reason}"):
        read_splats(tmp_path / "a.splat")


def test_a_splat_file_is_recognised_only_by_its_suffix(tmp_path):
    (tmp_path / "a.bin").write_bytes(record())
    with pytest.raises(BundleError, match="not a ply nor any other known"):
        read_splats(tmp_path / "a.bin")
