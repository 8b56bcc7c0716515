"""Strict readers for file formats of data sets; every failure is a LogError that names the file."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._files import read_text
from ...geometry import Float, is_rotation
from ...scene.errors import LeftOut
from ..driving_log import LogError
from ..images import check_image_file, read_image
from .common import Lens


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """One file per camera and frame, and the lens of every camera."""

    files: Mapping[str, Sequence[Path]]
    lenses: Mapping[str, Lens]

    def read(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """The pinhole image, RGB uint8 [H, W, 3]."""
        return self.lenses[camera].undistort(read_image(self.files[camera][frame]))

    def check(self, camera: str, frame: int) -> None:
        """Raise LogError if the file is truncated or its size differs from the lens's."""
        lens = self.lenses[camera]
        check_image_file(self.files[camera][frame], (lens.width, lens.height))


# --- JSON ----------------------------------------------------------------------------------------


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        LogError: the file is missing or not JSON.
    """
    try:
        return json.loads(read_text(path))
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: is not a JSON file ({error})") from error


class Tables:
    """A folder of JSON tables with rows that refer to each other by ``token``."""

    def __init__(self, folder: Path, names: Sequence[str], left_out: LeftOut) -> None:
        """Read the tables ``names``; rows without a token of their own are left out.

        Raises:
            LogError: a file is missing, or is not a list.
        """
        self._folder = folder
        self._rows: dict[str, list[_Row]] = {}
        self._by_token: dict[str, dict[str, _Row]] = {}
        for name in names:
            content = read_json(self.path(name))
            if not isinstance(content, list):
                raise LogError(f"{self.path(name)}: expected a list of objects")
            by_token: dict[str, _Row] = {}
            for number, item in enumerate(content):
                token = item.get("token") if isinstance(item, dict) else None
                if isinstance(token, str) and token not in by_token:
                    by_token[token] = _Row(item, self.path(name))
                    continue
                reason = "has no token" if token not in by_token else f"is a second {token!r}"
                left_out["rows"].append(f"{self.path(name)}: row {number} {reason}")
            self._rows[name] = list(by_token.values())
            self._by_token[name] = by_token

    def path(self, name: str) -> Path:
        """The file of a table."""
        return self._folder / f"{name}.json"

    def rows(self, name: str) -> Sequence[Mapping[str, Any]]:
        """All rows of a table."""
        return self._rows[name]

    def row(self, name: str, token: str) -> Mapping[str, Any]:
        """The row with a token. Raises LogError if it is missing."""
        try:
            return self._by_token[name][token]
        except (KeyError, TypeError):
            raise LogError(f"{self.path(name)}: has no row with token {token!r}") from None


class _Row(dict[str, Any]):
    """A row whose errors name the file and the missing key."""

    def __init__(self, content: Mapping[str, Any], path: Path) -> None:
        super().__init__(content)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise LogError(f"{self._path}: row {self.get('token')!r} has no {key!r}")


# --- Parquet and Feather -------------------------------------------------------------------------

CACHE_BYTES = 1 << 30
"""Maximum size of cached row groups per file [bytes]."""


class ParquetFile:
    """One Parquet file with columns that are read on demand.

    Cells of large columns are read by row group; the latest groups are cached.
    """

    def __init__(self, path: Path) -> None:
        """Open ``path`` and read its footer. Raises LogError if it is missing or broken."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.path = path
        self._lock = threading.Lock()
        self._groups: OrderedDict[tuple[int, str], Any] = OrderedDict()
        try:
            self._file = pq.ParquetFile(path)
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:  # A damaged column name.
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

    def complete(self, names: Sequence[str], left_out: LeftOut) -> NDArray[np.bool_]:
        """Which rows [N] have no empty cell in the columns ``names``; the others are left out."""
        from pyarrow import compute

        good = np.ones(len(self), dtype=bool)
        for name in names:
            column = self._whole(name)
            if column.null_count:
                good &= np.asarray(compute.is_valid(column))
        for row in np.flatnonzero(~good):
            left_out["rows"].append(f"{self.path} row {row}: has an empty cell")
        return good

    def numbers(self, name: str) -> NDArray[Any]:
        """A whole column of numbers [N], or of lists of K numbers [N, K].

        Empty cells are 0 in columns of whole numbers, and NaN in others, as are lists of another
        length than most; see :meth:`complete`.
        """
        import pyarrow as pa

        column = self._whole(name)
        if not _is_list(column.type):
            with _broken_named(f"{self.path}: column {name!r}"):
                if column.null_count and pa.types.is_integer(column.type):
                    column = column.fill_null(0)
                return np.asarray(column.to_numpy(zero_copy_only=False))
        lengths = np.asarray(column.value_lengths().fill_null(-1))
        if len(lengths) == 0 or lengths.max() < 0:
            raise LogError(f"{self.path}: column {name!r} is empty")
        known = lengths[lengths >= 0]
        length = int(np.bincount(known).argmax())
        rows = np.full((len(column), length), np.nan)
        with _broken_named(f"{self.path}: column {name!r}"):
            fits = np.flatnonzero(lengths == length)
            flat = column.take(pa.array(fits)).flatten()
            rows[fits] = np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(-1, length)
        return rows

    def texts(self, name: str) -> list[str]:
        """A whole column of text [N]."""
        return [str(value) for value in self.lists(name)]

    def lists(self, name: str) -> list[Any]:
        """A whole column as Python values; for small columns with lists of different lengths."""
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
    """Raise LogError if a Feather file is truncated or lacks a column; reads no values."""
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


def read_feather(
    path: Path, columns: Sequence[str], left_out: LeftOut | None = None, *, kind: str = "rows"
) -> dict[str, NDArray[Any]]:
    """Columns of a Feather file (version 2) as arrays, text as arrays of objects.

    Rows with an empty cell are left out.

    Raises:
        LogError: the file is missing or broken, a column is missing; without ``left_out`` also a
            column with empty cells.
    """
    import pyarrow as pa
    from pyarrow import compute, ipc

    try:
        with path.open("rb") as file:
            table = ipc.open_file(file).read_all()
        # Unvalidated offsets could point outside the file.
        table.validate(full=True)
    except (OSError, ValueError, pa.ArrowException) as error:  # Damaged text in a cell.
        raise LogError(f"{path}: cannot be read as a Feather file ({_line(error)})") from error
    with _broken_named(f"{path}: the list of columns"):
        _require(path, columns, list(table.column_names))
    empty = np.zeros(len(table), dtype=bool)
    for name in columns:
        column = table.column(name)
        if column.null_count and left_out is None:
            raise LogError(f"{path}: column {name!r} has {column.null_count} empty cells")
        if column.null_count:
            empty |= np.asarray(compute.is_null(column))
    if left_out is not None:
        for row in np.flatnonzero(empty):
            left_out[kind].append(f"{path} row {row}: has an empty cell")
    found = {}
    for name in columns:
        with _broken_named(f"{path}: column {name!r}"):
            found[name] = np.asarray(table.column(name).filter(pa.array(~empty)).to_numpy())
    return found


@contextmanager
def _broken_named(where: str) -> Iterator[None]:
    """Convert errors for values that pyarrow cannot convert, such as invalid text, to LogError."""
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


# --- Points --------------------------------------------------------------------------------------

# Rows of float32 in a file without a header (``.bin``).


def count_rows(path: Path, columns: int, hint: str = "is the file cut off?") -> int:
    """Number of rows of ``columns`` float32 in a file, from its size; ``hint`` ends an error.

    Raises:
        LogError: it is missing or empty, or ends within a row.
    """
    if not path.is_file():
        raise LogError(f"{path}: no such file; every frame needs its sweep")
    size = path.stat().st_size
    rows, rest = divmod(size, 4 * columns)
    if rest or not rows:
        raise LogError(
            f"{path}: {size} bytes is not a whole number of points ({columns} float32 each, "
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


# --- Text tables ---------------------------------------------------------------------------------


def read_lines(path: Path) -> list[str]:
    """Lines of a text file, see ``_files.read_text``, without trailing blank ones.

    Raises:
        LogError: the file is missing, not text, or empty.
    """
    try:
        text = read_text(path).rstrip()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: is not a text file ({error})") from error
    if not text:
        raise LogError(f"{path}: is empty")
    return text.split("\n")


def parse_numbers(words: list[str], where: str) -> Float:
    """Finite float64 numbers of ``words``; ``where`` names file and line in the LogError."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise LogError(f"{where}: expected numbers, {error}") from error
    if not np.isfinite(values).all():
        raise LogError(f"{where}: holds a value that is not finite")
    return values


def read_numbers(path: Path) -> Float:
    """All numbers of a text file. Raises LogError."""
    return parse_numbers(" ".join(read_lines(path)).split(), str(path))


def read_rigid(path: Path) -> Float:
    """A rigid transform [4, 4] in a text file. Raises LogError."""
    numbers = read_numbers(path)
    if numbers.size != 16:
        raise LogError(f"{path}: expected 16 numbers, found {numbers.size}")
    return check_rigid(numbers.reshape(4, 4), str(path))


def read_number_table(path: Path, *, columns: int, what: str, left_out: LeftOut) -> Float:
    """Rows [N, columns] float64 of a table, separated by white space or commas.

    A line with another number of columns, or with a value that is not finite, is a row of NaN.

    Raises:
        LogError: the file cannot be read.
    """
    lines = read_lines(path)
    rows = np.full((len(lines), columns), np.nan)
    for i, line in enumerate(lines):
        with left_out.damaged("lines"):
            words = line.replace(",", " ").split()
            where = f"{path} line {i + 1}"
            if len(words) != columns:
                raise LogError(f"{where}: expected {columns} numbers ({what}), found {len(words)}")
            rows[i] = parse_numbers(words, where)
    return rows


def check_rigid(matrix: Float, where: str) -> Float:
    """The matrix [4, 4], if it is a finite rigid transform.

    Raises:
        LogError: otherwise.
    """
    if not np.isfinite(matrix).all():
        raise LogError(f"{where}: holds a value that is not finite")
    if not is_rotation(matrix[:3, :3]):
        raise LogError(f"{where}: its left 3x3 block is not a rotation matrix")
    return matrix


def check_frame_times(times_us: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """The time stamps themselves if they are strictly increasing and not empty.

    Raises:
        LogError: names the first frame out of order.
    """
    if len(times_us) == 0:
        raise LogError(f"{where}: a log needs at least one frame")
    unordered = np.flatnonzero(np.diff(times_us) <= 0)
    if len(unordered):
        i = int(unordered[0])
        raise LogError(
            f"{where}: frame times must increase strictly, but frame {i} is at {times_us[i]} us "
            f"and frame {i + 1} at {times_us[i + 1]} us"
        )
    return times_us
