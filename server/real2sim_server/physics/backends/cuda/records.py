"""What the kernels read, as NumPy types: the structures of ``kernels/space.h``, field by field."""

from __future__ import annotations

import numpy as np

THREADS = 128
PIECE = 1024
NODES, TILE, AROUND = 64, 512, 27
COLUMNS, REACH = 16, 15
DIGITS = 256
DIVERGED, TOO_FAR, OVERFLOW = 1, 2, 4
XI, VELOCITY, GRADIENT, ELASTIC_F, STRESS, ENERGY = 0, 3, 6, 15, 24, 30
HISTORY, MASS, VOLUME, TOTAL_F = 31, 32, 33, 34
"""First of the numbers of a particle that a name stands for."""
MOVES, DEFORMS, SCATTERS = 1 << 16, 1 << 17, 1 << 18
BY_LAW, FLIPPED = 15, 16
BLOCKS, FIELDS, LISTS = range(3)

LAYOUT = (
    *("block_key", "field_key", "block_start", "block_fields", "block_near", "field_blocks"),
    *("field_near", "group_start", "contact_start", "contact_collider", "contact_field"),
    *("pair_start", "pair_field", "thin_start", "thin_collider", "thin_block"),
    *("tiles", "moments", "velocity", "offset"),
    *("by_collider", "by_pair", "by_thin", "touched", "rows"),
)
"""Arrays that grow with what particles touch."""
CAPACITIES = ("blocks", "fields", "contacts", "pairs", "thins")
_COUNTS = (
    *("particles", "pitch", "plastic", "bodies", "colliders", "sort_blocks"),
    *("block_capacity", "field_capacity", "contact_capacity", "pair_capacity", "thin_capacity"),
    "unused",
)
SPACE = np.dtype(
    [
        ("sets", np.uint64, (2,)),
        ("keys", np.uint64, (2,)),
        ("order", np.uint64, (2,)),
        *((name, np.uint64) for name in ("digit_counts", "counts", "sums")),
        *((name, np.uint64) for name in LAYOUT),
        *((name, np.uint64) for name in ("table", "friction", "heights", "step", "held")),
        *((name, np.uint64) for name in ("measured", "collider_totals", "body_totals")),
        ("dx", np.float64),
        ("gravity", np.float64, (3,)),
        *((name, np.uint32) for name in _COUNTS),
    ]
)
STEP = np.dtype([("dt", np.float64), ("moving", np.uint32), ("unused", np.uint32)])
HELD = np.dtype(
    [
        *((name, np.uint32) for name in ("current", "stop_after", "fault", "done")),
        *((name, np.uint32) for name in ("blocks", "fields", "groups", "contacts", "pairs")),
        ("thins", np.uint32),
        ("unused", np.uint32, (6,)),
    ]
)
