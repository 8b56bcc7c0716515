"""Niantic's ``.spz``, versions 1 to 4: quantised and compressed attributes.

Source: github.com/nianticlabs/spz, README.md and load-spz.cc.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry import Float
from ..cloud import GaussianCloud
from ..errors import BundleError, SceneError
from .splat_format import UpAxis, build_cloud, check_memory, host_array

# Headers and compressed streams, without the meaning of their bytes.

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
HEADER_4 = struct.Struct("<4sIIBBBBI12x")
TOC_ENTRY = struct.Struct("<QQ")

HAS_EXTENSIONS = 2
MAX_EXTENSION_BYTES = 1 << 20

MAX_REST = 15
"""Maximum number of harmonics past the first in a cloud; those of degree 4 are dropped."""

MAX_SPLATS = 20_000_000
"""Maximum number of splats; the largest street scenes have a few million."""

ZSTD_LEVEL = 12
GZIP_LEVEL = 6
_CHUNK = 1 << 20

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Header:
    """Fields common to all versions: version, number of splats, degree 0 to 4, bits, flags."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    @property
    def harmonics(self) -> int:
        """Number of spherical harmonics of each splat after reading."""
        return 1 + min(MAX_REST, (self.sh_degree + 1) ** 2 - 1)

    @property
    def stream_sizes(self) -> dict[str, int]:
        """Bytes of each stream of :class:`Streams`, in file order."""
        per_splat = {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colours": 3,
            "scales": 3,
            "rotations": 3 if self.version < 3 else 4,
            "sh": 3 * ((self.sh_degree + 1) ** 2 - 1),
        }
        return {name: size * self.count for name, size in per_splat.items()}


@dataclass(frozen=True, eq=False)
class Streams:
    """Bytes of all splats, one attribute after the other: each [N * bytes per splat] uint8."""

    positions: Bytes
    alphas: Bytes
    colours: Bytes
    scales: Bytes
    rotations: Bytes
    sh: Bytes


def is_spz(head: bytes) -> bool:
    """Whether a file that starts with ``head`` is a plain or gzipped spz file."""
    if head.startswith(GZIP_MAGIC):
        try:
            head = zlib.decompressobj(31).decompress(head, len(MAGIC))
        except zlib.error:
            return False
    return head.startswith(MAGIC)


def read_streams(path: Path, *, max_bytes: int | None = None) -> tuple[Header, Streams]:
    """Header and decompressed streams of a file of any version.

    The header is checked first, and limits the number of inflated bytes.

    Args:
        path: the file.
        max_bytes: memory limit of its Gaussians.

    Raises:
        BundleTooLargeError: the limit is exceeded.
        BundleError: names the file and the reason: missing, unknown version, counts out of range
            or mismatched, truncated, broken compression.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror}") from error
    if data.startswith(GZIP_MAGIC):
        inflated = _inflate_gzip(path, data, HEADER.size)
        header = _header(path, inflated, versions=(1, 2, 3))
        check_memory(path, header.count, header.harmonics, max_bytes)
        wanted = HEADER.size + sum(header.stream_sizes.values())
        # Reading one extra byte detects a file that is too long.
        data = _inflate_gzip(path, data, wanted + _extension_room(header) + 1)
        return header, _cut(path, header, data)
    header = _header(path, data, versions=(1, 2, 3, 4))
    check_memory(path, header.count, header.harmonics, max_bytes)
    return header, _cut(path, header, data) if header.version < 4 else _unpack(path, header, data)


def write_streams(header: Header, streams: Streams, *, gzip_level: int = GZIP_LEVEL) -> bytes:
    """A complete file of version 3 (gzip, ``gzip_level`` 1 to 9) or 4 (zstd). Deterministic."""
    parts = [getattr(streams, name).tobytes() for name in header.stream_sizes]
    values = (header.version, header.count, header.sh_degree, header.fractional_bits, header.flags)
    if header.version < 4:
        plain = b"".join([HEADER.pack(MAGIC, *values, 0), *parts])
        return gzip.compress(plain, gzip_level, mtime=0)
    filled = [part for part in parts if part]
    packed = [zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(part) for part in filled]
    start = HEADER_4.pack(MAGIC, *values, len(packed), HEADER_4.size)
    toc = [TOC_ENTRY.pack(len(p), len(f)) for p, f in zip(packed, filled, strict=True)]
    return b"".join([start, *toc, *packed])


def _header(path: Path, data: bytes, *, versions: tuple[int, ...]) -> Header:
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        raise BundleError(
            f"{path}: truncated: an spz file starts with {HEADER.size} bytes of header"
        )
    _, version, count, degree, bits, flags, _ = HEADER.unpack_from(data)
    if version not in versions:
        raise BundleError(f"{path}: spz version {version} is not supported; known are 1 to 4")
    if count > MAX_SPLATS:
        raise BundleError(f"{path}: header promises {count} splats; allowed are {MAX_SPLATS}")
    if degree > 4:
        raise BundleError(f"{path}: harmonics of degree {degree}; allowed are 0 to 4")
    if bits > 23:
        raise BundleError(f"{path}: {bits} fractional bits of 24; allowed are 0 to 23")
    return Header(version, count, degree, bits, flags)


def _extension_room(header: Header) -> int:
    return MAX_EXTENSION_BYTES if header.flags & HAS_EXTENSIONS else 0


def _cut(path: Path, header: Header, data: bytes) -> Streams:
    """Streams that follow a header of versions 1 to 3; extensions after them are skipped."""
    wanted = HEADER.size + sum(header.stream_sizes.values())
    if not wanted <= len(data) <= wanted + _extension_room(header):
        what = "truncated" if len(data) < wanted else "longer than its header says"
        raise BundleError(
            f"{path}: {what}: the header promises {header.count} splats of degree "
            f"{header.sh_degree} in {wanted} bytes, found {len(data)}"
            f"{'' if len(data) < wanted else ' or more'}"
        )
    arrays = {}
    offset = HEADER.size
    for name, size in header.stream_sizes.items():
        arrays[name] = np.frombuffer(data, dtype=np.uint8, count=size, offset=offset)
        offset += size
    return Streams(**arrays)


def _unpack(path: Path, header: Header, data: bytes) -> Streams:
    """Streams of version 4: a table of contents, then one zstd frame for each stream not empty."""
    if len(data) < HEADER_4.size:
        raise BundleError(f"{path}: truncated: the header of version 4 has {HEADER_4.size} bytes")
    *_, stream_count, toc_start = HEADER_4.unpack_from(data)
    sizes = {name: size for name, size in header.stream_sizes.items() if size}
    offset = toc_start + stream_count * TOC_ENTRY.size
    if stream_count != len(sizes) or toc_start < HEADER_4.size or offset > len(data):
        raise BundleError(
            f"{path}: table of contents of {stream_count} streams at byte {toc_start} does not fit "
            f"{len(sizes)} streams in a file of {len(data)} bytes"
        )
    arrays = {name: np.empty(0, dtype=np.uint8) for name in header.stream_sizes}
    for index, (name, size) in enumerate(sizes.items()):
        packed, plain = TOC_ENTRY.unpack_from(data, toc_start + index * TOC_ENTRY.size)
        if plain != size or packed > len(data) - offset:
            raise BundleError(
                f"{path}: truncated or broken: stream {name!r} is {plain} bytes packed into "
                f"{packed}; {header.count} splats need {size}, and {len(data) - offset} are left"
            )
        frame = data[offset : offset + packed]
        arrays[name] = np.frombuffer(_inflate_zstd(path, name, frame, size), dtype=np.uint8)
        offset += packed
    if offset != len(data):
        raise BundleError(f"{path}: {len(data) - offset} bytes more than its streams need")
    return Streams(**arrays)


def _inflate_gzip(path: Path, data: bytes, limit: int) -> bytes:
    """At most ``limit`` decompressed bytes of ``data``."""
    machine = zlib.decompressobj(31)
    position = 0

    def step(room: int) -> bytes:
        nonlocal position
        source = machine.unconsumed_tail
        if not source:
            source = data[position : position + _CHUNK]
            position += len(source)
        return machine.decompress(source, room)

    def exhausted() -> bool:
        return machine.eof or (position >= len(data) and not machine.unconsumed_tail)

    try:
        return _collect(step, exhausted, limit)
    except zlib.error as error:
        raise BundleError(f"{path}: broken gzip data: {error}") from error


def _collect(step: Callable[[int], bytes], exhausted: Callable[[], bool], limit: int) -> bytes:
    parts: list[bytes] = []
    total = 0
    while total < limit and not exhausted():
        parts.append(step(min(_CHUNK, limit - total)))
        total += len(parts[-1])
    return b"".join(parts)


def _inflate_zstd(path: Path, name: str, frame: bytes, size: int) -> bytes:
    """Exactly ``size`` bytes of a frame; memory grows with its actual content."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(frame) as reader:
            parts: list[bytes] = []
            total = 0
            while total <= size and (part := reader.read(min(_CHUNK, size + 1 - total))):
                parts.append(part)
                total += len(part)
    except zstandard.ZstdError as error:
        raise BundleError(f"{path}: stream {name!r}: broken zstd data: {error}") from error
    if total != size:
        more = "more than " if total > size else ""
        raise BundleError(
            f"{path}: stream {name!r} holds {more}{min(total, size)} bytes; "
            f"its header promises {size}"
        )
    return b"".join(parts)


COLOUR_SCALE = 0.15
"""Coefficients of the first harmonic per full range of a byte."""

FRACTIONAL_BITS = 12
"""Positions are multiples of 2^-12 (a quarter of a millimetre) unless their range is too large."""

SH_BITS = (5, 4, 4)
"""Significant bits of harmonics of degree 1, 2, 3; the other bits are zero and compress away."""


class Spz:
    """Gaussians with 19 to 65 bytes each before compression.

    Axes: by definition right, up, back (y up, as glTF), unlike trained PLY files. Reading and
    writing preserve the coordinates: pass ``up_axis="y"`` to import such a file. ``export_scene``
    rotates the scene before writing.

    Quantisation: positions are multiples of 2^-12 within 2048 units, coarser only for larger
    clouds; log scales multiples of 1/16 in [-10, 5.94]; opacities multiples of 1/255; coefficients
    of the first harmonic multiples of 1/38.25 in [-3.33, 3.33]; the three small components of a
    quaternion multiples of sqrt(1/2)/511; further harmonics multiples of 1/16 (degree 1) and 1/8 in
    [-1, 0.992]. Harmonics of degree 4 are dropped when read; extensions are skipped.

    Args:
        version: version of written files: 3 (gzip, supported by most viewers) or 4 (zstd, smaller).
        gzip_level: 1 (fast) to 9 (small), of version 3.
    """

    name = "spz"
    suffix = ".spz"
    has_signature = True
    up_axis: UpAxis = "y"

    def __init__(self, *, version: int = 3, gzip_level: int = GZIP_LEVEL) -> None:
        if version not in (3, 4):
            raise SceneError(f"spz version to write must be 3 or 4, not {version!r}")
        if not 1 <= gzip_level <= 9:
            raise SceneError(f"gzip_level of an spz file must be 1 to 9, not {gzip_level!r}")
        self.version = version
        self.gzip_level = gzip_level

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` belongs to a plain or gzipped spz file."""
        return is_spz(head)

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        header, streams = read_streams(path, max_bytes=max_bytes)
        return build_cloud(
            path,
            means=_positions(path, header, streams, notes),
            quats=_rotations(header, streams),
            log_scales=streams.scales.reshape(-1, 3) / 16.0 - 10,
            opacities=streams.alphas / 255.0,
            sh=_spherical_harmonics(header, streams),
            notes=notes,
        )

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write ``cloud`` in its current order.

        Raises:
            SceneError: positions beyond the range of 24 bits of whole units (8 million).
            OSError: the file cannot be written.
        """
        content = self.encode(cloud)
        with atomic_file(path) as file:
            file.write(content)

    def encode(self, cloud: GaussianCloud) -> bytes:
        """The bytes of a file with ``cloud`` in its order. Raises SceneError as :meth:`write`."""
        means = host_array(cloud.means)
        bits = _fractional_bits(means)
        header = Header(self.version, len(cloud), cloud.sh_degree, bits, 0)
        streams = Streams(
            positions=_packed_positions(means, bits),
            alphas=_byte(host_array(cloud.opacities) * 255),
            colours=_byte((host_array(cloud.sh[:, 0]) * COLOUR_SCALE + 0.5) * 255),
            scales=_byte((np.log(host_array(cloud.scales)) + 10) * 16),
            rotations=_packed_rotations(host_array(cloud.quats)),
            sh=_packed_harmonics(host_array(cloud.sh[:, 1:])),
        )
        return write_streams(header, streams, gzip_level=self.gzip_level)


def _positions(
    path: Path, header: Header, streams: Streams, notes: list[str] | None
) -> NDArray[np.float32]:
    if header.version == 1:
        means = streams.positions.view("<f2").astype(np.float32).reshape(-1, 3)
        bad = int((~np.isfinite(means)).any(axis=1).sum())
        if bad and notes is None:
            raise BundleError(
                f"{path}: position is NaN or infinite in {bad} of {len(means)} splats"
            )
        return means
    triples = streams.positions.reshape(-1, 3).astype(np.int32)
    whole = triples[:, 0] | triples[:, 1] << 8 | triples[:, 2] << 16
    signed = np.where(whole >= 1 << 23, whole - (1 << 24), whole)
    # 24 bits and a power of two: exact in float32.
    means = signed.astype(np.float32).reshape(-1, 3)
    means /= np.float32(1 << header.fractional_bits)
    return means


def _rotations(header: Header, streams: Streams) -> Float:
    """Quaternions [N, 4] wxyz; files hold xyz in bytes (to version 2) or the smallest three."""
    if header.version < 3:
        small = streams.rotations.reshape(-1, 3) / 127.5 - 1
        largest = np.sqrt(np.maximum(0.0, 1 - (small * small).sum(axis=1)))
        return np.concatenate([largest[:, None], small], axis=1)
    words = streams.rotations.view("<u4").astype(np.uint32)
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    small = (parts & 511) / 511 * np.sqrt(0.5) * np.where(parts >> 9, -1.0, 1.0)
    largest = np.sqrt(np.maximum(0.0, 1 - (small * small).sum(axis=1)))
    xyzw = np.empty((len(words), 4))
    place = (words >> 30).astype(np.int64)
    np.put_along_axis(xyzw, _other_places(place), small, axis=1)
    np.put_along_axis(xyzw, place[:, None], largest[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def _other_places(place: NDArray[np.int64]) -> NDArray[np.int64]:
    """The three components [N, 3] of a quaternion other than ``place`` [N], in order."""
    return np.array([[k for k in range(4) if k != p] for p in range(4)])[place]


def _spherical_harmonics(header: Header, streams: Streams) -> NDArray[np.float32]:
    """Coefficients [N, K, 3]. Bytes by powers of two are exact in float32."""
    sh = np.empty((header.count, header.harmonics, 3), dtype=np.float32)
    sh[:, 0] = (streams.colours.reshape(-1, 3) / 255.0 - 0.5) / COLOUR_SCALE
    rest = streams.sh.reshape(header.count, (header.sh_degree + 1) ** 2 - 1, 3)
    np.subtract(rest[:, :MAX_REST], np.float32(128), out=sh[:, 1:])
    sh[:, 1:] /= 128
    return sh


def _fractional_bits(means: Float) -> int:
    reach = float(np.abs(means).max(initial=0.0))
    for bits in range(FRACTIONAL_BITS, -1, -1):
        if np.rint(reach * (1 << bits)) < 1 << 23:
            return bits
    raise SceneError(f"a position of {reach} does not fit into an spz file; recentre the cloud")


def _packed_positions(means: Float, bits: int) -> Bytes:
    whole = np.rint(means.reshape(-1) * (1 << bits)).astype("<i4")
    return np.ascontiguousarray(whole.view(np.uint8).reshape(-1, 4)[:, :3]).reshape(-1)


def _packed_rotations(quats: Float) -> Bytes:
    xyzw = quats[:, [1, 2, 3, 0]]
    place = np.abs(xyzw).argmax(axis=1)
    sign = np.where(np.take_along_axis(xyzw, place[:, None], axis=1) < 0, -1.0, 1.0)
    small = np.take_along_axis(xyzw * sign, _other_places(place), axis=1)
    magnitudes = np.clip(np.rint(np.abs(small) / np.sqrt(0.5) * 511), 0, 511).astype(np.uint32)
    parts = magnitudes | (small < 0).astype(np.uint32) << np.uint32(9)
    words = place.astype(np.uint32)
    for column in range(3):
        words = words << np.uint32(10) | parts[:, column]
    packed: Bytes = words.astype("<u4").view(np.uint8)
    return packed


def _packed_harmonics(rest: Float) -> Bytes:
    """Harmonics past the first [N, K - 1, 3] as bytes. Zero is exact."""
    codes = np.empty(rest.shape, dtype=np.uint8)
    for degree, bits in enumerate(SH_BITS, start=1):
        band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        bucket = 1 << (8 - bits)
        whole = np.rint(rest[:, band] * 128 / bucket) * bucket + 128
        codes[:, band] = np.clip(whole, 0, 255)
    return codes.reshape(-1)


def _byte(values: Float) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).reshape(-1)
