"""What the kernels read, as NumPy types: the structures of ``kernels/beams.h``, field by field."""

from __future__ import annotations

import numpy as np

THREADS = 256
TILES_OF_BLOCK = 4
MET_BYTES = 64

_POINTER, _FLOAT, _COUNT = np.uint64, np.float32, np.uint32

TABLES = (
    *("rays", "directions", "slots", "lows", "highs", "sides", "band_starts"),
    *("tile_lows", "tile_highs", "first_tiles", "first_bands", "last_bands"),
    *("rows_before", "rows_until", "slot_of"),
)
"""Arrays of a BeamLayout that lie on the device."""
BODY = np.dtype(
    [
        *(
            (name, _POINTER)
            for name in ("means", "quats", "scales", "opacities", "covars", "attributes")
        ),
        ("linear", np.float64, (9,)),
        ("offset", np.float64, (3,)),
        *((name, _COUNT) for name in ("first", "count", "motion", "unused")),
        ("speed", _FLOAT),
        ("turn", _FLOAT),
    ]
)
SWEEP = np.dtype(
    [
        *((name, _POINTER) for name in ("bodies", "frames", "origins", *TABLES)),
        *(
            (name, _POINTER)
            for name in (
                *("met", "footprints", "depths", "counts", "keys", "members"),
                *("lists", "starts", "values", "owners", "returns"),
            )
        ),
        *((name, _COUNT) for name in ("body_count", "gaussians", "slot_count", "tiles")),
        *(
            (name, _FLOAT)
            for name in (
                *("near_range", "far_range", "pulse", "wide", "high", "spread"),
                *("period", "duration", "seam"),
            )
        ),
    ],
    align=True,
)
