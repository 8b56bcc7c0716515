import math
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.scene import BundleError
from real2sim_server.scene.io import read_splats

POSITIONS = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
SCALES = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
COLOURS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def write_compressed(
    path: Path, chunks: np.ndarray, words: np.ndarray, sh: np.ndarray | None = None
) -> Path:
    """Write chunks [C, 12 or 18] float32, words [N, 4] uint32, sh [N, 9, 24 or 45] uint8."""
    lines = ["ply", "format binary_little_endian 1.0", "comment a test"]
    lines.append(f"element chunk {len(chunks)}")
    names = (POSITIONS + SCALES + COLOURS)[: chunks.shape[1]]
    lines += [f"property float {name}" for name in names]
    lines.append(f"element vertex {len(words)}")
    lines += [f"property uint {name}" for name in PACKED]
    if sh is not None:
        lines.append(f"element sh {len(sh)}")
        lines += [f"property uchar f_rest_{i}" for i in range(sh.shape[1])]
    data = chunks.astype("<f4").tobytes() + words.astype("<u4").tobytes()
    data += b"" if sh is None else sh.astype("u1").tobytes()
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + data)
    return path


@pytest.fixture
def chunks() -> np.ndarray:
    random = np.random.default_rng(1)
    low, span = random.normal(size=(3, 2, 9)), random.uniform(0.1, 2, size=(3, 2, 9))
    ends = np.stack([low[:, 0], low[:, 0] + span[:, 0]], axis=1)
    return np.concatenate(
        [
            ends[:, 0, :3],
            ends[:, 1, :3],
            ends[:, 0, 3:6],
            ends[:, 1, 3:6],
            ends[:, 0, 6:],
            ends[:, 1, 6:],
        ],
        axis=1,
    ).astype(np.float32)


@pytest.fixture
def words() -> np.ndarray:
    """Random words of 600 splats in 3 chunks, with valid quaternions."""
    random = np.random.default_rng(2)
    words = random.integers(0, 2**32, size=(600, 4), dtype=np.uint64)
    small = random.integers(312, 712, size=(600, 3), dtype=np.uint64)
    words[:, 1] = words[:, 1] >> 30 << 30 | small[:, 0] << 20 | small[:, 1] << 10 | small[:, 2]
    return words


def lerp(low: float, high: float, fraction: float) -> float:
    return low * (1 - fraction) + high * fraction


def decode(chunk: np.ndarray, word: np.ndarray) -> dict[str, list[float]]:
    """Decode one splat from the specification, in plain Python."""
    position, rotation, scale, colour = (int(w) for w in word)
    fractions = [
        [(w >> 21) / 2047, (w >> 11 & 1023) / 1023, (w & 2047) / 2047] for w in (position, scale)
    ]
    small = [((rotation >> s & 1023) / 1023 - 0.5) * math.sqrt(2) for s in (20, 10, 0)]
    quat = [*small]
    quat.insert(rotation >> 30, math.sqrt(1 - sum(c * c for c in small)))
    rgba = [(colour >> s & 255) / 255 for s in (24, 16, 8, 0)]
    if len(chunk) == 18:
        rgba[:3] = [lerp(chunk[12 + i], chunk[15 + i], rgba[i]) for i in range(3)]
    return {
        "means": [lerp(chunk[i], chunk[3 + i], fractions[0][i]) for i in range(3)],
        "quats": quat,
        "scales": [math.exp(lerp(chunk[6 + i], chunk[9 + i], fractions[1][i])) for i in range(3)],
        "opacities": [rgba[3]],
        "sh": [(c - 0.5) / 0.28209479177387814 for c in rgba[:3]],
    }


@pytest.mark.parametrize("width", [12, 18])
def test_splats_are_decoded_as_specified(chunks, words, tmp_path, width):
    chunks = chunks[:, :width]
    cloud = read_splats(write_compressed(tmp_path / "a.ply", chunks, words))
    assert (len(cloud), cloud.sh_degree) == (600, 0)
    for i in range(600):
        for name, expected in decode(chunks[i // 256].astype(float), words[i]).items():
            given = getattr(cloud, name)[i].numpy().ravel()
            np.testing.assert_allclose(given, expected, rtol=2e-6, atol=2e-6, err_msg=name)
    cloud.check_values("cloud")


@pytest.mark.parametrize("largest", range(4))
def test_the_largest_quaternion_part_is_placed_by_its_index(chunks, words, tmp_path, largest):
    # 0.5 is not among the 1024 levels: the small parts are half a level off zero.
    words[:, 1] = largest << 30 | 512 << 20 | 512 << 10 | 511
    quats = read_splats(write_compressed(tmp_path / "a.ply", chunks, words)).quats[0]
    np.testing.assert_allclose(quats.abs().numpy(), np.eye(4)[largest], atol=1e-3)


def test_the_extreme_codes_are_the_chunk_bounds(chunks, words, tmp_path):
    words[0, 0], words[1, 0] = 0, 0xFFFFFFFF
    means = read_splats(write_compressed(tmp_path / "a.ply", chunks, words)).means
    np.testing.assert_array_equal(means[0], chunks[0, :3])
    np.testing.assert_array_equal(means[1], chunks[0, 3:6])


@pytest.mark.parametrize(("count", "degree"), [(9, 1), (24, 2), (45, 3)])
def test_harmonics_are_bytes_from_minus_four_to_four(chunks, words, tmp_path, count, degree):
    codes = np.random.default_rng(3).integers(0, 256, size=(600, count))
    codes[0, :3] = [0, 255, 128]
    cloud = read_splats(write_compressed(tmp_path / "a.ply", chunks, words, codes))
    assert cloud.sh_degree == degree
    assert cloud.sh[0, 1:4, 0].tolist() == [-4, 4, 0.015625]
    bands = count // 3
    for channel in range(3):
        middle = (codes[7, channel * bands : (channel + 1) * bands] + 0.5) / 32 - 4
        np.testing.assert_allclose(cloud.sh[7, 1:, channel], middle, atol=0.016)


def test_small_parts_beyond_unit_length_give_a_valid_rotation(chunks, words, tmp_path):
    words[:, 1] = 0xFFFFFFFF
    read_splats(write_compressed(tmp_path / "a.ply", chunks, words)).check_values("cloud")


@pytest.mark.parametrize("count", [2, 4, 0])
def test_a_wrong_number_of_chunks_is_refused(chunks, words, tmp_path, count):
    chunks = np.resize(chunks, (count, 18))
    with pytest.raises(BundleError, match=rf"a\.ply: {count} chunks of 256 do not fit 600 splats"):
        read_splats(write_compressed(tmp_path / "a.ply", chunks, words))


@pytest.mark.parametrize(("rows", "width"), [(599, 9), (600, 8), (600, 12), (600, 48), (0, 9)])
def test_harmonics_with_a_wrong_shape_are_refused(chunks, words, tmp_path, rows, width):
    with pytest.raises(BundleError, match="element 'sh' has"):
        read_splats(write_compressed(tmp_path / "a.ply", chunks, words, np.zeros((rows, width))))


def test_nan_in_a_chunk_is_refused(chunks, words, tmp_path):
    chunks[1, 4] = np.nan
    with pytest.raises(BundleError, match="property 'max_y' is NaN"):
        read_splats(write_compressed(tmp_path / "a.ply", chunks, words))


def test_a_truncated_file_is_refused(chunks, words, tmp_path):
    file = write_compressed(tmp_path / "a.ply", chunks, words)
    file.write_bytes(file.read_bytes()[:-16])
    with pytest.raises(BundleError, match="truncated: the header promises 3 chunk, 600 vertex"):
        read_splats(file)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("float max_scale_z", "float max_scale_q", r"lacks the properties \['max_scale_z'\]"),
        ("float max_b", "float max_q", r"lacks the properties \['max_b'\]"),
        ("uint packed_scale", "uint packed_size", r"lacks the properties \['packed_scale'\]"),
        ("uint packed_color", "float packed_color", "must be of type uint"),
        ("element chunk", "element block", "no 'chunk' element"),
    ],
)
def test_other_layouts_are_refused(chunks, words, tmp_path, old, new, reason):
    file = write_compressed(tmp_path / "a.ply", chunks, words)
    file.write_bytes(file.read_bytes().replace(old.encode(), new.encode(), 1))
    with pytest.raises(BundleError, match=reason):
        read_splats(file)
