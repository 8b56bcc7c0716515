"""Compressed PLY of PlayCanvas and SuperSplat: chunks of 256 splats, 16 bytes a splat.

Each chunk gives lowest and highest position, log scale and (in newer files) colour; each splat a
fraction in between. Facts: github.com/playcanvas/engine, gsplat-compressed-data.js, and
github.com/playcanvas/splat-transform, decompress-ply.ts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...cloud import SH_DEGREES, GaussianCloud
from ...errors import BundleError
from ...harmonics import SH_C0
from ...rotation import Float
from ..ply import read_ply_elements
from .types import build_cloud, columns, require_properties

CHUNK_SIZE = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
LOW_POSITION, HIGH_POSITION = ("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")
LOW_SCALE = ("min_scale_x", "min_scale_y", "min_scale_z")
HIGH_SCALE = ("max_scale_x", "max_scale_y", "max_scale_z")
LOW_COLOUR, HIGH_COLOUR = ("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")

Words = NDArray[np.uint32]


class PlayCanvasPly:
    """Elements ``chunk`` (12 or 18 floats), ``vertex`` (4 uint32) and, for degree > 0, ``sh``."""

    name = "PlayCanvas compressed ply"

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` is that of a PLY file with packed positions."""
        header = head.split(b"end_header", 1)[0]
        return header.startswith((b"ply\n", b"ply\r\n")) and b" packed_position" in header

    def read(self, path: Path) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        elements = read_ply_elements(path)
        vertex, chunks = self._checked(path, elements)
        chunk_of = np.arange(len(vertex)) // CHUNK_SIZE

        def between(low: tuple[str, ...], high: tuple[str, ...], fraction: Float) -> Float:
            a, b = columns(path, chunks, low)[chunk_of], columns(path, chunks, high)[chunk_of]
            return a * (1 - fraction) + b * fraction

        rgba = _unpack_8888(vertex["packed_color"])
        has_colours = LOW_COLOUR[0] in (chunks.dtype.names or ())
        rgb = between(LOW_COLOUR, HIGH_COLOUR, rgba[:, :3]) if has_colours else rgba[:, :3]
        first = ((rgb - 0.5) / SH_C0)[:, None, :]
        return build_cloud(
            path,
            means=between(LOW_POSITION, HIGH_POSITION, _unpack_11_10_11(vertex["packed_position"])),
            quats=_unpack_rotation(vertex["packed_rotation"]),
            log_scales=between(LOW_SCALE, HIGH_SCALE, _unpack_11_10_11(vertex["packed_scale"])),
            opacities=rgba[:, 3],
            sh=np.concatenate([first, _rest(path, elements.get("sh"), len(vertex))], axis=1),
        )

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


def _rest(path: Path, sh: NDArray[np.void] | None, count: int) -> Float:
    """Harmonics past the first [N, K - 1, 3]: bytes over [-4, 4], channel by channel."""
    if sh is None:
        return np.empty((count, 0, 3))
    names = tuple(f"f_rest_{i}" for i in range(len(sh.dtype.names or ())))
    if len(names) % 3 or len(names) // 3 + 1 not in SH_DEGREES or len(sh) != count:
        raise BundleError(
            f"{path}: element 'sh' has {len(sh)} records of {len(names)} properties; "
            f"allowed are {count} of 9, 24 or 45"
        )
    require_properties(path, "sh", sh.dtype.names, names)
    codes = columns(path, sh, names)
    # The writer cuts 256 equal bins; their middles come back, and the ends where it clamped.
    fraction = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
    return ((fraction - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)
