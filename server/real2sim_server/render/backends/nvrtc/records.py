"""What the kernels read, as NumPy types: the structures of ``kernels/frame.h``, field by field."""

from __future__ import annotations

import numpy as np

THREADS = 256
PIECE = 1024
"""Gaussians, or splats, that one block works on."""
WORDS = PIECE // 32
DIGITS = 256
TILE = 16
MAX_CAMERAS = 64
COUNTERS = 16
SEEN_WANTED, PAIRS_WANTED = 2, 3
"""Places of counters in the report."""

SPLAT_BYTES = 48
"""Three float4, see ``store`` in ``kernels/seen.h``."""

_POINTER, _FLOAT, _COUNT = np.uint64, np.float32, np.uint32


def _structure(
    pointers: tuple[str, ...], rest: list[tuple[str, type, tuple[int, ...]]]
) -> np.dtype:
    return np.dtype([*((name, _POINTER, ()) for name in pointers), *rest])


def _counts(*names: str) -> list[tuple[str, type, tuple[int, ...]]]:
    return [(name, _COUNT, ()) for name in names]


OBJECT = _structure(
    ("means", "quats", "scales", "opacities", "sh", "covars", "colour", "tones"),
    [
        *_counts("count", "functions", "tone_count", "first_piece", "first_entry"),
        *_counts("first_placement", "first_camera", "cameras"),
        ("scale", _FLOAT, (3,)),
        ("instance", np.uint16, ()),
        ("semantic", np.uint16, ()),
    ],
)
PLACEMENT = _structure(
    (),
    [
        ("depth_row", np.float64, (4,)),
        ("linear", _FLOAT, (3, 3)),
        ("eye", _FLOAT, (3,)),
        ("eye_rest", _FLOAT, (3,)),
        ("unused", _FLOAT, ()),
    ],
)
CAMERA = _structure(
    ("sky",),
    [
        ("focal", _FLOAT, (2,)),
        ("centre", _FLOAT, (2,)),
        ("lowest", _FLOAT, (2,)),
        ("highest", _FLOAT, (2,)),
        ("directions", _FLOAT, (3, 3)),
        ("background", _FLOAT, (3,)),
        *_counts("sky_resolution", "width", "height", "tiles_x", "tiles_y"),
        *_counts("first_tile", "first_pixel", "behind"),
    ],
)
IMAGES: dict[str, tuple[type, tuple[int, ...]]] = {
    "rgb": (np.float32, (3,)),
    "alpha": (np.float32, ()),
    "depth": (np.float32, ()),
    "median": (np.float32, ()),
    "solid": (np.float32, ()),
    "instance": (np.uint16, ()),
    "semantic": (np.uint8, ()),
    "bytes": (np.uint8, (3,)),
}
"""Images that a pass can write: dtype of a number, and channels."""
FRAME = _structure(
    (
        *("objects", "placements", "cameras", "seen_masks", "entry_starts", "splats", "boxes"),
        *("depths_0", "depths_1", "order_0", "order_1", "tiles_0", "tiles_1"),
        *("members_0", "members_1", "pair_starts", "digit_counts", "digit_starts"),
        *("tile_ranges", "counters", "report", *IMAGES),
    ),
    [
        *_counts("object_count", "camera_count", "pieces", "entries", "tile_count"),
        *_counts("seen_capacity", "pair_capacity", "sort_blocks", "tile_passes", "antialiased"),
        ("near_plane", _FLOAT, ()),
        ("far_plane", _FLOAT, ()),
        ("eps2d", _FLOAT, ()),
        ("radius_clip", _FLOAT, ()),
    ],
)
