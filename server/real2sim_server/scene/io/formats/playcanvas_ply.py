"""Compressed PLY of PlayCanvas and SuperSplat: chunks of 256 splats, 16 bytes a splat.

Each chunk gives lowest and highest position, log scale and (in newer files) colour; each splat a
fraction in between. Facts: github.com/playcanvas/engine, gsplat-compressed-data.js, and
github.com/playcanvas/splat-transform, decompress-ply.ts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...._files import atomic_file
from ....geometry.transform import Float
from ...cloud import SH_DEGREES, GaussianCloud
from ...errors import BundleError
from ...spherical_harmonics import SH_C0
from ..ply import read_ply_elements
from .morton import morton_order
from .types import (
    UpAxis,
    build_cloud,
    check_memory,
    column,
    columns,
    host_array,
    require_properties,
)

CHUNK_SIZE = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
LOW_POSITION, HIGH_POSITION = ("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")
LOW_SCALE = ("min_scale_x", "min_scale_y", "min_scale_z")
HIGH_SCALE = ("max_scale_x", "max_scale_y", "max_scale_z")
LOW_COLOUR, HIGH_COLOUR = ("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")

Words = NDArray[np.uint32]


CHUNK_FIELDS = LOW_POSITION + HIGH_POSITION + LOW_SCALE + HIGH_SCALE + LOW_COLOUR + HIGH_COLOUR

LARGEST_LOG_SCALE = 20.0
"""Log scales are clamped to plus or minus this, as in the format's own writer."""


class PlayCanvasPly:
    """Elements ``chunk`` (12 or 18 floats), ``vertex`` (4 uint32) and, for degree > 0, ``sh``.

    Axes: those of the splats it was made of, mostly y down. Both ways keep the coordinates.

    Quantisation: within a chunk of 256, positions and log scales are cut into 2047 (x, z) and
    1023 (y) steps of the chunk's extent, colours of the first harmonic into 255; opacities are
    multiples of 1/255; the three small parts of a quaternion are multiples of sqrt(2)/1023;
    further harmonics are clamped to [-4, 4] and cut into 256 bins.
    """

    name = "PlayCanvas compressed ply"
    suffix = ".compressed.ply"
    has_signature = True
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` is that of a PLY file with packed positions."""
        header = head.split(b"end_header", 1)[0]
        return header.startswith((b"ply\n", b"ply\r\n")) and b" packed_position" in header

    def read(self, path: Path, *, max_bytes: int | None = None) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        elements = read_ply_elements(path)
        vertex, chunks = self._checked(path, elements)
        sh = elements.get("sh")
        rest = 0 if sh is None else len(sh.dtype.names or ()) // 3
        check_memory(path, len(vertex), 1 + rest, max_bytes)
        chunk_of = np.arange(len(vertex)) // CHUNK_SIZE

        def between(low: tuple[str, ...], high: tuple[str, ...], fraction: Float) -> Float:
            a, b = columns(path, chunks, low)[chunk_of], columns(path, chunks, high)[chunk_of]
            return a * (1 - fraction) + b * fraction

        rgba = _unpack_8888(vertex["packed_color"])
        has_colours = LOW_COLOUR[0] in (chunks.dtype.names or ())
        rgb = between(LOW_COLOUR, HIGH_COLOUR, rgba[:, :3]) if has_colours else rgba[:, :3]
        first = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None, :]
        return build_cloud(
            path,
            means=between(LOW_POSITION, HIGH_POSITION, _unpack_11_10_11(vertex["packed_position"])),
            quats=_unpack_rotation(vertex["packed_rotation"]),
            log_scales=between(LOW_SCALE, HIGH_SCALE, _unpack_11_10_11(vertex["packed_scale"])),
            opacities=rgba[:, 3],
            sh=np.concatenate([first, _rest(path, sh, len(vertex))], axis=1),
        )

    def write(self, cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
        """Write ``cloud`` in Z-curve order, so that chunks are small; the order is not kept.

        Raises:
            OSError: the file cannot be written.
        """
        cloud = cloud.select(torch.from_numpy(morton_order(host_array(cloud.means))))
        chunks, words = _packed(cloud)
        sh = _packed_rest(host_array(cloud.sh[:, 1:]))
        lines = ["ply", "format binary_little_endian 1.0"]
        lines += [f"comment {comment}"] * bool(comment) + [f"element chunk {len(chunks)}"]
        lines += [f"property float {name}" for name in CHUNK_FIELDS]
        lines += [f"element vertex {len(cloud)}", *(f"property uint {name}" for name in PACKED)]
        if sh.shape[1]:
            lines.append(f"element sh {len(cloud)}")
            lines += [f"property uchar f_rest_{i}" for i in range(sh.shape[1])]
        with atomic_file(path) as file:
            file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
            for part in (chunks.astype("<f4"), words.astype("<u4"), sh):
                file.write(part.tobytes())

    def _checked(
        self, path: Path, elements: dict[str, NDArray[np.void]]
    ) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Elements ``vertex`` and ``chunk`` once their properties and counts fit together."""
        vertex, chunks = elements.get("vertex"), elements.get("chunk")
        vertex_names = vertex.dtype.names or () if vertex is not None else None
        chunk_names = chunks.dtype.names or () if chunks is not None else None
        needed: tuple[str, ...] = LOW_POSITION + HIGH_POSITION + LOW_SCALE + HIGH_SCALE
        if chunk_names and LOW_COLOUR[0] in chunk_names:
            needed += LOW_COLOUR + HIGH_COLOUR
        require_properties(path, "chunk", chunk_names, needed)
        require_properties(path, "vertex", vertex_names, PACKED)
        assert vertex is not None
        assert chunks is not None
        if any(
            vertex.dtype[name].kind != "u" or vertex.dtype[name].itemsize != 4 for name in PACKED
        ):
            raise BundleError(f"{path}: the packed properties must be of type uint")
        if len(chunks) != -(-len(vertex) // CHUNK_SIZE):
            raise BundleError(
                f"{path}: {len(chunks)} chunks of {CHUNK_SIZE} do not fit {len(vertex)} splats"
            )
        return vertex, chunks


def _unpack_11_10_11(words: Words) -> Float:
    """Fractions [N, 3] in [0, 1]; the first component is in the highest bits."""
    w = np.asarray(words, dtype=np.uint32)
    return np.stack([(w >> 21) / 2047, (w >> 11 & 1023) / 1023, (w & 2047) / 2047], axis=-1)


def _unpack_8888(words: Words) -> Float:
    """Red, green, blue, alpha [N, 4] in [0, 1]; red is in the highest bits."""
    w = np.asarray(words, dtype=np.uint32)
    return np.stack([(w >> shift & 255) / 255 for shift in (24, 16, 8, 0)], axis=-1)


def _unpack_rotation(words: Words) -> Float:
    """Quaternions [N, 4] wxyz.

    The highest two bits say which component is largest and left out; the other three follow in
    the order w, x, y, z with 10 bits each over [-1/sqrt(2), 1/sqrt(2)].
    """
    w = np.asarray(words, dtype=np.uint32)
    small = (np.stack([w >> s & 1023 for s in (20, 10, 0)], axis=-1) / 1023 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (small * small).sum(axis=-1)))
    quats = np.empty((len(w), 4))
    for place in range(4):
        chosen = (w >> 30) == place
        others = [k for k in range(4) if k != place]
        quats[np.ix_(chosen, others)] = small[chosen]
        quats[chosen, place] = largest[chosen]
    return quats


def _rest(path: Path, sh: NDArray[np.void] | None, count: int) -> NDArray[np.float32]:
    """Harmonics past the first [N, K - 1, 3]: bytes over [-4, 4], channel by channel."""
    if sh is None:
        return np.empty((count, 0, 3), dtype=np.float32)
    names = tuple(f"f_rest_{i}" for i in range(len(sh.dtype.names or ())))
    if len(names) % 3 or len(names) // 3 + 1 not in SH_DEGREES or len(sh) != count:
        raise BundleError(
            f"{path}: element 'sh' has {len(sh)} records of {len(names)} properties; "
            f"allowed are {count} of 9, 24 or 45"
        )
    require_properties(path, "sh", sh.dtype.names, names)
    per_channel = len(names) // 3
    rest = np.empty((count, per_channel, 3), dtype=np.float32)
    for index, name in enumerate(names):
        codes = column(path, sh, name)
        # The writer cuts 256 equal bins; their middles come back, and the ends where it clamped.
        fraction = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
        rest[:, index % per_channel, index // per_channel] = (fraction - 0.5) * 8
    return rest


def _packed(cloud: GaussianCloud) -> tuple[Float, Words]:
    """Bounds [C, 18] of all chunks in the order of ``CHUNK_FIELDS``, and words [N, 4]."""
    log_scales = np.log(host_array(cloud.scales))
    position, low_position, high_position = _fractions(host_array(cloud.means))
    scale, low_scale, high_scale = _fractions(
        np.clip(log_scales, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    )
    colour, low_colour, high_colour = _fractions(0.5 + SH_C0 * host_array(cloud.sh[:, 0]))
    rgba = np.concatenate([colour, host_array(cloud.opacities)[:, None]], axis=1)
    words = [
        _pack(position, (11, 10, 11)),
        _pack_rotation(host_array(cloud.quats)),
        _pack(scale, (11, 10, 11)),
        _pack(rgba, (8, 8, 8, 8)),
    ]
    bounds = [low_position, high_position, low_scale, high_scale, low_colour, high_colour]
    return np.concatenate(bounds, axis=1), np.stack(words, axis=1)


def _fractions(values: Float) -> tuple[Float, Float, Float]:
    """Values [N, 3] as fractions between the bounds [C, 3] of their chunks, and these bounds."""
    starts = np.arange(0, len(values), CHUNK_SIZE)
    if not len(starts):
        return values, np.empty((0, 3)), np.empty((0, 3))
    # The file holds bounds as float32, so fractions refer to what will be read back.
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    chunk_of = np.arange(len(values)) // CHUNK_SIZE
    span = (high - low)[chunk_of]
    fractions = (values - low[chunk_of]) / np.where(span > 0, span, 1.0)
    return np.clip(fractions, 0.0, 1.0), low, high


def _pack(fractions: Float, bits: tuple[int, ...]) -> Words:
    """One word of each row of fractions; the first component goes to the highest bits."""
    words = np.zeros(len(fractions), dtype=np.uint32)
    for axis, width in enumerate(bits):
        codes = np.rint(fractions[:, axis] * (2**width - 1)).astype(np.uint32)
        words = words << np.uint32(width) | codes
    return words


def _pack_rotation(quats: Float) -> Words:
    """Inverse of :func:`_unpack_rotation`."""
    place = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    positive = np.where(quats[rows, place] < 0, -1.0, 1.0)[:, None] * quats
    others = np.array([[k for k in range(4) if k != p] for p in range(4)])[place]
    small = np.take_along_axis(positive, others, axis=1) / np.sqrt(2) + 0.5
    words: Words = place.astype(np.uint32) << np.uint32(30)
    return words | _pack(np.clip(small, 0, 1), (10, 10, 10))


def _packed_rest(rest: Float) -> NDArray[np.uint8]:
    """Bytes [N, 3 (K - 1)] of harmonics [N, K - 1, 3], channel by channel."""
    codes = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(codes.transpose(0, 2, 1).reshape(len(rest), 3 * rest.shape[1]))
