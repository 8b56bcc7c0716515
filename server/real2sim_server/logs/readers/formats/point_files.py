"""Points as rows of float32 in a file without a header (``.bin``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...driving_log import LogError


def count_rows(path: Path, columns: int, hint: str = "is the file cut off?") -> int:
    """How many rows of ``columns`` float32 a file holds, by its size; ``hint`` ends an error.

    Raises:
        LogError: it is missing or empty, or ends within a row.
    """
    if not path.is_file():
        raise LogError(f"{path}: no such file; every frame needs its sweep")
    size = path.stat().st_size
    rows, rest = divmod(size, 4 * columns)
    if rest or not rows:
        raise LogError(
            f"{path}: {size} bytes is no whole number of points ({columns} float32 each, "
            f"{4 * columns} bytes); {hint}"
        )
    return rows


def read_rows(path: Path, columns: int, hint: str = "is the file cut off?") -> NDArray[np.float32]:
    """The rows [N, columns] of a file; arguments and errors are those of :func:`count_rows`."""
    rows = count_rows(path, columns, hint)
    try:
        return np.fromfile(path, dtype=np.float32).reshape(rows, columns)
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: cannot be read ({error})") from error
