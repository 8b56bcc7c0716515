"""Sums and bounds over the particles of each home."""

from __future__ import annotations

import math
from typing import Any

from numba import prange

from ..kernel import entry
from ..layout import CHUNKS
from ..particle import VOLUME_RATIO, add_matter, add_motion


@entry(parallel=True)
def measure_homes(state: Any, layout: Any, rules: Any, out: Any) -> None:
    """Fill ``out`` [P, COLUMNS] float64, one row for each home."""
    for chunk in prange(CHUNKS):
        for home in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            row = out[home]
            row[:] = 0.0
            row[VOLUME_RATIO] = math.inf
            begin, end = layout.home_start[home], layout.home_start[home + 1]
            for p in range(begin, end):
                add_motion(p, layout.home_block[home], state, rules.dx, row)
                add_matter(p, state, rules.table[state.material[p]], row)
