"""Niantic's ``.spz``, versions 1 to 4: quantised attributes, one after the other, compressed.

Facts: github.com/nianticlabs/spz, README.md and load-spz.cc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...._files import atomic_file
from ....geometry.transform import Float
from ...cloud import GaussianCloud
from ...errors import BundleError, SceneError
from .spz_container import (
    GZIP_LEVEL,
    MAX_REST,
    Header,
    Streams,
    is_spz,
    read_streams,
    write_streams,
)
from .types import UpAxis, build_cloud, host_array

COLOUR_SCALE = 0.15
"""Coefficients of the first harmonic per full range of a byte."""

FRACTIONAL_BITS = 12
"""Positions are multiples of 2^-12 (a quarter of a millimetre) unless they reach too far."""

SH_BITS = (5, 4, 4)
"""Bits kept of harmonics of degree 1, 2, 3; the other bits are zero and compress away."""

Bytes = NDArray[np.uint8]


class Spz:
    """Gaussians with 19 to 65 bytes each before compression.

    Axes: by definition right, up, back (y up, as glTF), unlike trained PLY files. Reading and
    writing keep the coordinates: whoever imports such a file says ``up_axis="y"``, and
    ``export_scene`` turns the scene before it writes one.

    Quantisation: positions are multiples of 2^-12 within 2048 units, coarser only where the
    cloud reaches farther; log scales multiples of 1/16 in [-10, 5.94]; opacities multiples of
    1/255; coefficients of the first harmonic multiples of 1/38.25 in [-3.33, 3.33]; the three small
    parts of a quaternion multiples of sqrt(1/2)/511; further harmonics multiples of 1/16 (degree 1)
    and 1/8 in [-1, 0.992]. Harmonics of degree 4 are cut when read; extensions are skipped.

    Args:
        version: of the files to write: 3 (gzip, what most viewers read) or 4 (zstd, smaller).
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
        """Whether ``head`` is that of a plain or gzipped spz file."""
        return is_spz(head)

    def read(self, path: Path, *, max_bytes: int | None = None) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        header, streams = read_streams(path, max_bytes=max_bytes)
        return build_cloud(
            path,
            means=_positions(path, header, streams),
            quats=_rotations(header, streams),
            log_scales=streams.scales.reshape(-1, 3) / 16.0 - 10,
            opacities=streams.alphas / 255.0,
            sh=_spherical_harmonics(header, streams),
        )

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write ``cloud`` in its order.

        Raises:
            SceneError: for positions beyond what 24 bits of whole units hold (8 million).
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


def _positions(path: Path, header: Header, streams: Streams) -> NDArray[np.float32]:
    if header.version == 1:
        means = streams.positions.view("<f2").astype(np.float32).reshape(-1, 3)
        bad = int((~np.isfinite(means)).any(axis=1).sum())
        if bad:
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
    """The three places [N, 3] in a quaternion besides ``place`` [N], in order."""
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
    """Harmonics past the first [N, K - 1, 3] as bytes; zero is always exact."""
    codes = np.empty(rest.shape, dtype=np.uint8)
    for degree, bits in enumerate(SH_BITS, start=1):
        band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        bucket = 1 << (8 - bits)
        whole = np.rint(rest[:, band] * 128 / bucket) * bucket + 128
        codes[:, band] = np.clip(whole, 0, 255)
    return codes.reshape(-1)


def _byte(values: Float) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).reshape(-1)
