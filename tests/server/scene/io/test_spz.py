"""Reading ``.spz``: decoding against the specification, and damaged files."""

import gzip
import math
import struct
import tracemalloc

import numpy as np
import pytest
import zstandard

from real2sim_server.scene import BundleError
from real2sim_server.scene.io import read_splats, write_splats
from real2sim_server.scene.io.spz import MAX_SPLATS, Spz

COUNT = 40


def sh_bytes(degree):
    return 3 * ((degree + 1) ** 2 - 1)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def random_parts(rng, *, version, degree):
    """Streams of 40 random splats with valid quaternions."""
    rotations = rng.integers(90, 166, size=(COUNT, 3)).astype(np.uint8)
    if version >= 3:
        place = rng.integers(0, 4, COUNT).astype(np.uint32)
        parts = rng.integers(0, 1024, size=(COUNT, 3)).astype(np.uint32) & 0b1011111111
        words = place << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
        rotations = words.astype("<u4").view(np.uint8).reshape(COUNT, 4)
    positions = rng.integers(0, 256, size=(COUNT, 9)).astype(np.uint8)
    if version == 1:
        positions = rng.normal(size=(COUNT, 3)).astype("<f2").view(np.uint8)
    return {
        "positions": positions,
        "alphas": rng.integers(0, 256, size=(COUNT, 1)).astype(np.uint8),
        "colours": rng.integers(0, 256, size=(COUNT, 3)).astype(np.uint8),
        "scales": rng.integers(0, 256, size=(COUNT, 3)).astype(np.uint8),
        "rotations": rotations,
        "sh": rng.integers(0, 256, size=(COUNT, sh_bytes(degree))).astype(np.uint8),
    }


def plain(parts, *, version, degree, bits=12, count=COUNT, flags=0, trailer=b""):
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0)
    return head + b"".join(part.tobytes() for part in parts.values()) + trailer


def version_4(parts, *, degree, count=COUNT, extension=b"", flags=0, streams=None):
    filled = [part.tobytes() for part in parts.values() if part.size]
    packed = [zstandard.ZstdCompressor().compress(part) for part in filled]
    head = struct.pack(
        "<4sIIBBBBI12x",
        b"NGSP",
        4,
        count,
        degree,
        12,
        flags,
        len(packed) if streams is None else streams,
        32 + len(extension),
    )
    toc = b"".join(struct.pack("<QQ", len(p), len(f)) for p, f in zip(packed, filled, strict=True))
    return head + extension + toc + b"".join(packed)


def decode(parts, i, *, version, bits):
    """Decode one splat from the specification."""
    raw = parts["positions"][i].tobytes()
    if version == 1:
        position = list(struct.unpack("<3e", raw))
    else:
        position = [
            int.from_bytes(raw[k : k + 3], "little", signed=True) / 2**bits for k in (0, 3, 6)
        ]
    if version < 3:
        xyz = [b / 127.5 - 1 for b in parts["rotations"][i]]
        quat = [math.sqrt(1 - sum(c * c for c in xyz)), *xyz]
    else:
        word = int.from_bytes(parts["rotations"][i].tobytes(), "little")
        xyzw = []
        for shift in (20, 10, 0):
            part = word >> shift & 1023
            xyzw.append((-1 if part >> 9 else 1) * (part & 511) / 511 * math.sqrt(0.5))
        xyzw.insert(word >> 30, math.sqrt(1 - sum(c * c for c in xyzw)))
        quat = [xyzw[3], *xyzw[:3]]
    return {
        "means": position,
        "quats": quat,
        "scales": [math.exp(b / 16 - 10) for b in parts["scales"][i]],
        "opacities": [parts["alphas"][i][0] / 255],
        "sh": [(b / 255 - 0.5) / 0.15 for b in parts["colours"][i]]
        + [(int(b) - 128) / 128 for b in parts["sh"][i][:45]],
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize(
    ("version", "packing"),
    [(1, "gzip"), (2, "gzip"), (3, "gzip"), (2, "none"), (3, "none"), (4, "zstd")],
)
def test_splats_are_decoded_as_specified(rng, tmp_path, version, packing, degree):
    parts = random_parts(rng, version=version, degree=degree)
    if packing == "zstd":
        data = version_4(parts, degree=degree)
    else:
        data = plain(parts, version=version, degree=degree)
    (tmp_path / "a.bin").write_bytes(gzip.compress(data) if packing == "gzip" else data)
    cloud = read_splats(tmp_path / "a.bin")
    cloud.check_values("cloud")
    assert (len(cloud), cloud.sh_degree) == (COUNT, min(degree, 3))
    for i in range(COUNT):
        for name, expected in decode(parts, i, version=version, bits=12).items():
            given = getattr(cloud, name)[i].numpy().ravel()
            np.testing.assert_allclose(given, expected, rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("bits", [0, 8, 23])
def test_fractional_bits_scale_positions(rng, tmp_path, bits):
    parts = random_parts(rng, version=3, degree=0)
    (tmp_path / "a.spz").write_bytes(plain(parts, version=3, degree=0, bits=bits))
    given = read_splats(tmp_path / "a.spz").means[3].tolist()
    expected = decode(parts, 3, version=3, bits=bits)["means"]
    np.testing.assert_allclose(given, expected, rtol=1e-6)


def test_extensions_are_skipped(rng, tmp_path):
    parts = random_parts(rng, version=3, degree=1)
    extension = struct.pack("<II", 0xADBE0002, 12) + b"x" * 12
    after = plain(parts, version=3, degree=1, flags=2, trailer=extension)
    (tmp_path / "a.spz").write_bytes(gzip.compress(after))
    (tmp_path / "b.spz").write_bytes(version_4(parts, degree=1, flags=2, extension=extension))
    a, b = read_splats(tmp_path / "a.spz"), read_splats(tmp_path / "b.spz")
    assert a.means.tolist() == b.means.tolist()
    assert a.sh.tolist() == b.sh.tolist()


def test_written_files_have_the_specified_headers(make_cloud, tmp_path):
    Spz(version=3).write(make_cloud(5, degree=2), tmp_path / "a.spz")
    Spz(version=4).write(make_cloud(5, degree=2), tmp_path / "b.spz")
    three, four = gzip.decompress((tmp_path / "a.spz").read_bytes()), (tmp_path / "b.spz")
    assert struct.unpack_from("<4sIIBBBB", three) == (b"NGSP", 3, 5, 2, 12, 0, 0)
    assert len(three) == 16 + 5 * (9 + 1 + 3 + 3 + 4 + 24)
    assert struct.unpack_from("<4sIIBBBBI", four.read_bytes()) == (b"NGSP", 4, 5, 2, 12, 0, 6, 32)


# Damage


@pytest.fixture
def parts(rng):
    return random_parts(rng, version=3, degree=1)


def refuse(tmp_path, data, reason):
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(BundleError, match=rf"a\.spz: {reason}"):
        read_splats(tmp_path / "a.spz")


@pytest.mark.parametrize("packed", [True, False])
def test_truncated_and_overlong_files_are_refused(parts, tmp_path, packed):
    whole = plain(parts, version=3, degree=1)
    pack = gzip.compress if packed else bytes
    refuse(tmp_path, pack(whole[:-1]), "truncated: the header promises 40 splats of degree 1")
    refuse(tmp_path, pack(whole[:12]), "truncated")
    refuse(tmp_path, pack(whole + b"\0"), "longer than its header says")


def test_a_gzip_stream_truncated_anywhere_is_refused(parts, tmp_path):
    whole = gzip.compress(plain(parts, version=3, degree=1))
    for end in range(12, len(whole) - 8, 17):
        (tmp_path / "a.spz").write_bytes(whole[:end])
        with pytest.raises(BundleError):
            read_splats(tmp_path / "a.spz")


def test_a_version_4_file_truncated_anywhere_is_refused(parts, tmp_path):
    whole = version_4(parts, degree=1)
    for end in range(4, len(whole), 13):
        (tmp_path / "a.spz").write_bytes(whole[:end])
        with pytest.raises(BundleError):
            read_splats(tmp_path / "a.spz")


def test_damaged_version_4_files_raise_only_bundle_errors(parts, tmp_path):
    whole = version_4(parts, degree=1)
    for position in range(0, len(whole), 7):
        broken = bytearray(whole)
        broken[position] ^= 0x55
        (tmp_path / "a.spz").write_bytes(broken)
        try:
            read_splats(tmp_path / "a.spz").check_values("cloud")
        except BundleError as error:
            assert "a.spz" in str(error)  # noqa: PT017 - unharmed is allowed too


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"version": 5}, "spz version 5 is not supported; known are 1 to 4"),
        ({"version": 0}, "spz version 0 is not supported"),
        ({"count": MAX_SPLATS + 1}, "header promises 20000001 splats; allowed are 20000000"),
        ({"degree": 5}, "harmonics of degree 5; allowed are 0 to 4"),
        ({"bits": 24}, "24 fractional bits of 24; allowed are 0 to 23"),
        ({"count": 39}, "longer than its header says"),
        ({"count": 41}, "truncated"),
        ({"degree": 2}, "truncated"),
    ],
)
@pytest.mark.parametrize("packed", [True, False])
def test_invalid_headers_are_refused(parts, tmp_path, change, reason, packed):
    data = plain(parts, **{"version": 3, "degree": 1} | change)
    refuse(tmp_path, gzip.compress(data) if packed else data, reason)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"count": 41}, r"truncated or broken: stream 'positions' is 360 bytes"),
        ({"degree": 2}, r"truncated or broken: stream 'sh' is 360 bytes"),
        ({"degree": 0}, "table of contents of 6 streams at byte 32 does not fit 5 streams"),
        ({"streams": 5}, "table of contents of 5 streams"),
        ({"streams": 255}, "table of contents of 255 streams"),
    ],
)
def test_inconsistent_tables_of_contents_are_refused(parts, tmp_path, change, reason):
    refuse(tmp_path, version_4(parts, **{"degree": 1} | change), reason)


def test_non_finite_positions_of_version_1_are_refused(rng, tmp_path):
    parts = random_parts(rng, version=1, degree=0)
    parts["positions"][3] = np.array([1, np.nan, np.inf], dtype="<f2").view(np.uint8)
    refuse(tmp_path, plain(parts, version=1, degree=0), "position is NaN or infinite in 1 of 40")


def test_a_gzip_bomb_is_not_inflated_beyond_its_header(tmp_path):
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0)
    bomb = gzip.compress(head + bytes(300_000_000), 1)
    (tmp_path / "a.spz").write_bytes(bomb)
    peak = peak_bytes(tmp_path / "a.spz", "longer than its header says")
    assert peak < 20_000_000


def test_a_zstd_bomb_is_not_inflated_beyond_its_header(tmp_path):
    bomb = zstandard.ZstdCompressor().compress(bytes(300_000_000))
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10, 0, 12, 0, 5, 32)
    toc = b"".join(struct.pack("<QQ", len(bomb), size) for size in (90, 10, 30, 30, 40))
    (tmp_path / "a.spz").write_bytes(head + toc + bomb * 5)
    peak = peak_bytes(tmp_path / "a.spz", "stream 'positions' holds more than 90 bytes")
    assert peak < 20_000_000


def peak_bytes(file, reason):
    """Peak Python memory while a file is refused, without allocations of C libraries."""
    tracemalloc.start()
    try:
        with pytest.raises(BundleError, match=reason):
            read_splats(file)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_an_unrelated_gzip_file_is_refused(tmp_path):
    (tmp_path / "a.spz").write_bytes(gzip.compress(b"hello world, hello world"))
    with pytest.raises(BundleError, match="not a ply nor any other known splat format"):
        read_splats(tmp_path / "a.spz")


def test_reading_ignores_the_suffix(make_cloud, tmp_path):
    write_splats(make_cloud(5), tmp_path / "a.spz")
    (tmp_path / "a.spz").rename(tmp_path / "a.ply")
    assert len(read_splats(tmp_path / "a.ply")) == 5
