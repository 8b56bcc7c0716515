"""Headers and compressed streams of ``.spz`` files. Knows nothing of what the bytes mean."""

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

from ...errors import BundleError
from .types import check_memory

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
HEADER_4 = struct.Struct("<4sIIBBBBI12x")
TOC_ENTRY = struct.Struct("<QQ")

HAS_EXTENSIONS = 2
MAX_EXTENSION_BYTES = 1 << 20

MAX_REST = 15
"""Harmonics past the first that a cloud can hold; those of degree 4 are cut."""

MAX_SPLATS = 20_000_000
"""More are refused; the largest street scenes have a few million."""

ZSTD_LEVEL = 12
GZIP_LEVEL = 6
_CHUNK = 1 << 20

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Header:
    """What all versions say: version, number of splats, degree 0 to 4, bits, flags."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    @property
    def harmonics(self) -> int:
        """Spherical harmonics of each splat once read."""
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

    No more is inflated than the header asks for, and the header is checked before.

    Args:
        path: the file.
        max_bytes: what its Gaussians may take in memory.

    Raises:
        BundleTooLargeError: they take more.
        BundleError: naming the file and the reason: not there, an unknown version, counts out of
            range or not fitting, cut short, broken compression.
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
        # One byte more than may be there tells a file that is too long.
        data = _inflate_gzip(path, data, wanted + _extension_room(header) + 1)
        return header, _cut(path, header, data)
    header = _header(path, data, versions=(1, 2, 3, 4))
    check_memory(path, header.count, header.harmonics, max_bytes)
    return header, _cut(path, header, data) if header.version < 4 else _unpack(path, header, data)


def write_streams(header: Header, streams: Streams, *, gzip_level: int = GZIP_LEVEL) -> bytes:
    """A whole file of version 3 (gzip, ``gzip_level`` 1 to 9) or 4 (zstd); the same streams give
    the same bytes."""
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
    """At most ``limit`` bytes of what is packed in ``data``."""
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
    """Exactly ``size`` bytes of a frame; memory grows with what it really holds."""
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
