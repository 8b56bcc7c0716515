"""The table of a sweep: one Parquet file, a row an episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._files import atomic_file

if TYPE_CHECKING:
    import pyarrow as pa


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], types: Mapping[str, type]) -> None:
    """Write rows, whole or not at all; equal rows are equal bytes.

    Args:
        path: of the file.
        rows: in their order.
        types: of the columns, in their order: ``bool``, ``int``, ``float`` or ``str``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    known: dict[type, pa.DataType] = {
        bool: pa.bool_(),
        int: pa.int64(),
        float: pa.float64(),
        str: pa.string(),
    }
    schema = pa.schema([(name, known[kind]) for name, kind in types.items()])
    columns = [
        pa.array([_as(kind, row.get(name)) for row in rows], known[kind])
        for name, kind in types.items()
    ]
    table = pa.Table.from_arrays(columns, schema=schema)
    with atomic_file(path) as file:
        pq.write_table(table, file, compression="zstd")


def _as(kind: type, value: Any) -> Any:
    return None if value is None else kind(value)
