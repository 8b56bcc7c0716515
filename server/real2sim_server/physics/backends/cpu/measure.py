"""Sums and bounds over the particles of each block."""

from __future__ import annotations

import math
from typing import Any

from numba import prange

from ..kernel import entry
from ..layout import CHUNKS
from ..particle import VOLUME_RATIO, add_material, add_motion


@entry(parallel=True)
def measure_blocks(state: Any, layout: Any, params: Any, out: Any) -> None:
    """Fill ``out`` [P, COLUMNS] float64, one row for each block."""
    for chunk in prange(CHUNKS):
        for block in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            row = out[block]
            row[:] = 0.0
            row[VOLUME_RATIO] = math.inf
            begin, end = layout.block_start[block], layout.block_start[block + 1]
            for p in range(begin, end):
                add_motion(p, layout.block_coordinates[block], state, params.dx, row)
                add_material(p, state, params.table[state.material[p]], row)
