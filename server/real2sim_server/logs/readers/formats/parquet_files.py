"""Parquet and Feather files by pyarrow; every failure is a LogError that names the file."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...driving_log import LogError

CACHE_BYTES = 1 << 30
"""How much of decoded row groups a file may keep in memory."""


class ParquetFile:
    """One Parquet file, whose columns are read when they are asked for.

    Cells of heavy columns are read row group by row group; the latest ones stay in memory.
    """

    def __init__(self, path: Path) -> None:
        """Open ``path`` and read its footer. Raises LogError when it is missing or broken."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.path = path
        self._lock = threading.Lock()
        self._groups: OrderedDict[tuple[int, str], Any] = OrderedDict()
        try:
            self._file = pq.ParquetFile(path)
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:  # A name may be damaged.
            raise LogError(f"{path}: cannot be read as Parquet ({_line(error)})") from error
        with _broken_named(f"{path}: the list of columns"):
            self.names = frozenset(self._file.schema_arrow.names)
        metadata = self._file.metadata
        sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
        self._starts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def require(self, names: Sequence[str]) -> None:
        """Raise LogError naming the first column that is missing."""
        for name in names:
            if name not in self.names:
                raise LogError(
                    f"{self.path}: has no column {name!r}; it has {sorted(self.names)[:12]}"
                )

    def numbers(self, name: str) -> NDArray[Any]:
        """A whole column of numbers [N], or of fixed lists of numbers [N, K]."""
        column = self._whole(name)
        if column.null_count:
            raise LogError(f"{self.path}: column {name!r} has {column.null_count} empty cells")
        if not _is_list(column.type):
            with _broken_named(f"{self.path}: column {name!r}"):
                return np.asarray(column.to_numpy(zero_copy_only=False))
        flat = column.flatten()
        if len(column) == 0 or len(flat) % len(column) or flat.null_count:
            raise LogError(f"{self.path}: the lists of column {name!r} differ in length")
        return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(column), -1)

    def texts(self, name: str) -> list[str]:
        """A whole column of text [N]."""
        return [str(value) for value in self.lists(name)]

    def lists(self, name: str) -> list[Any]:
        """A whole column as Python values; for small columns whose lists differ in length."""
        column = self._whole(name)
        with _broken_named(f"{self.path}: column {name!r}"):
            return list(column.to_pylist())

    def cell(self, name: str, row: int) -> Any:
        """One pyarrow scalar of a heavy column."""
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        with self._lock:
            column = self._group(group, name)
        return column[int(row - self._starts[group])]

    def _whole(self, name: str) -> Any:
        import pyarrow as pa

        self.require([name])
        try:
            with self._lock:
                chunked = self._file.read(columns=[name]).column(name)
        except (OSError, pa.ArrowException) as error:
            raise LogError(f"{self.path}: column {name!r} is broken ({_line(error)})") from error
        return chunked.combine_chunks() if chunked.num_chunks != 1 else chunked.chunk(0)

    def _group(self, group: int, name: str) -> Any:
        import pyarrow as pa

        key = (group, name)
        if key not in self._groups:
            try:
                table = self._file.read_row_group(group, columns=[name])
            except (OSError, pa.ArrowException) as error:
                raise LogError(
                    f"{self.path}: row group {group} of column {name!r} is broken ({_line(error)})"
                ) from error
            self._groups[key] = table.column(name)
        self._groups.move_to_end(key)
        while len(self._groups) > 1 and self._kept_bytes() > CACHE_BYTES:
            self._groups.popitem(last=False)
        return self._groups[key]

    def _kept_bytes(self) -> int:
        return sum(int(column.nbytes) for column in self._groups.values())


def check_feather(path: Path, columns: Sequence[str]) -> None:
    """Raise LogError when a Feather file is cut off or lacks a column; reads no values."""
    import pyarrow as pa
    from pyarrow import ipc

    try:
        with path.open("rb") as file:
            schema = ipc.open_file(file).schema
    except (OSError, ValueError, pa.ArrowException) as error:
        raise LogError(f"{path}: cannot be read as a Feather file ({_line(error)})") from error
    with _broken_named(f"{path}: the list of columns"):
        _require(path, columns, list(schema.names))


def _require(path: Path, columns: Sequence[str], there: Sequence[str]) -> None:
    for name in columns:
        if name not in there:
            raise LogError(f"{path}: has no column {name!r}; it has {list(there)[:12]}")


def read_feather(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a Feather file (version 2) as arrays, text as arrays of objects.

    Raises:
        LogError: the file is missing or broken, a column is missing or has empty cells.
    """
    import pyarrow as pa
    from pyarrow import ipc

    try:
        with path.open("rb") as file:
            table = ipc.open_file(file).read_all()
        # The file's offsets are followed as they are, unless they are looked at before.
        table.validate(full=True)
    except (OSError, ValueError, pa.ArrowException) as error:  # names that are no text among them
        raise LogError(f"{path}: cannot be read as a Feather file ({_line(error)})") from error
    with _broken_named(f"{path}: the list of columns"):
        _require(path, columns, list(table.column_names))
    found = {}
    for name in columns:
        column = table.column(name)
        if column.null_count:
            raise LogError(f"{path}: column {name!r} has {column.null_count} empty cells")
        with _broken_named(f"{path}: column {name!r}"):
            found[name] = np.asarray(column.to_numpy())
    return found


@contextmanager
def _broken_named(where: str) -> Iterator[None]:
    """Values that pyarrow cannot convert, such as text that is none, as LogError."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise LogError(f"{where} is broken ({_line(error)})") from error


def _is_list(kind: Any) -> bool:
    import pyarrow as pa

    return bool(
        pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)
    )


def _line(error: Exception) -> str:
    """The first line of pyarrow's messages, which may be long."""
    return str(error).split("\n", maxsplit=1)[0][:200]
