"""Arrays of many clouds for one kernel: a table of where they lie in memory.

Numba compiles a kernel anew for each number of arrays that it is given, and copying clouds
together would copy all that a small image does not show.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from .hierarchy import Hierarchy

FIELDS = (
    *("means", "quats", "scales", "opacities", "sh", "coefficients", "order", "starts"),
    *("low", "high", "sigmas"),
    *("merged_means", "merged_covars", "merged_opacities", "merged_sh", "merged_coefficients"),
)
"""Columns of the table that are addresses."""
COUNT, MERGED, BLOCKS, BANDS, MERGED_BANDS, TONES, CELL = range(len(FIELDS), len(FIELDS) + 7)
"""Columns with sizes; the last one has the side of the finest merged cells in micrometres."""
COLUMNS = len(FIELDS) + 7


_rows: weakref.WeakKeyDictionary[Hierarchy, NDArray[np.int64]] = weakref.WeakKeyDictionary()


def table_of(hierarchies: Sequence[Hierarchy]) -> NDArray[np.int64]:
    """[H, COLUMNS] int64; right as long as the hierarchies are held."""
    table = np.empty((len(hierarchies), COLUMNS), np.int64)
    for row, hierarchy in zip(table, hierarchies, strict=True):
        known = _rows.get(hierarchy)
        if known is None:
            known = _rows[hierarchy] = _row(hierarchy)
        row[:] = known
    return table


def _row(held: Hierarchy) -> NDArray[np.int64]:
    arrays: tuple[NDArray[Any], ...] = (*held.cloud, held.coefficients, held.order, held.starts)
    arrays += (held.low, held.high, held.sigmas, held.means, held.covars, held.opacities)
    arrays += (held.sh, held.merged_coefficients)
    row = np.empty(COLUMNS, np.int64)
    row[: len(FIELDS)] = [array.ctypes.data for array in arrays]
    row[len(FIELDS) :] = (
        len(held.order),
        len(held.means),
        len(held.sigmas),
        held.cloud.sh.shape[1],
        held.sh.shape[1],
        held.coefficients.shape[1],
        round(held.cell * 1e6),
    )
    return row


@intrinsic
def pointer_to(typingctx: Any, address: Any) -> Any:
    """An address as the pointer that ``carray`` takes."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), generate
