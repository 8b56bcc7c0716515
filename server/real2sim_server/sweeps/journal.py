"""Rows of episodes on disk as they come, so that a sweep goes on where it was killed."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

FORMAT = "real2sim-episodes 1"
MOST_BYTES = 4 << 30
MOST_LINE = 1 << 20


class Journal:
    """A file that only grows: ``checksum key row`` a line.

    What was being written when the program was killed is the last line, whose checksum then does
    not fit; it is cut off. Lines that are damaged elsewhere are left out, and their episodes driven
    again.

    Args:
        path: of the file; it is made where it is not there.

    Raises:
        ValueError: a file of another kind, or too large.
        OSError: it cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, dict[str, Any]] = {}
        self._path = path
        self._file: IO[bytes] | None = None
        self._end = self._read() if path.exists() else 0

    def __enter__(self) -> Self:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("ab")
        self._file.truncate(self._end)
        if self._end == 0:
            self._write(FORMAT.encode() + b"\n")
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        assert self._file is not None
        self._file.close()
        self._file = None

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Keep a row: once this returns, no kill of the program loses it."""
        # Numbers are written as the shortest text that reads back as the same bits.
        text = f"{key} {json.dumps(dict(row), separators=(',', ':'))}".encode()
        self._write(b"%08x %s\n" % (zlib.crc32(text), text))
        self.rows[key] = dict(row)

    def _write(self, line: bytes) -> None:
        assert self._file is not None
        self._file.write(line)
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def _read(self) -> int:
        """Take in all whole lines; where the last of them ends."""
        if (size := self._path.stat().st_size) > MOST_BYTES:
            raise ValueError(f"{self._path} has {size} bytes; at most {MOST_BYTES} are read")
        end = 0
        with self._path.open("rb") as file:
            first = file.readline(MOST_LINE)
            if not first.endswith(b"\n"):
                if not (FORMAT.encode() + b"\n").startswith(first):
                    raise ValueError(f"{self._path} is no journal of episodes")
                return 0
            if first.rstrip(b"\n") != FORMAT.encode():
                raise ValueError(f"{self._path} is no journal of episodes of this version")
            end = file.tell()
            while (line := file.readline(MOST_LINE)).endswith(b"\n"):
                end = file.tell()
                if (found := _row(line)) is not None:
                    self.rows[found[0]] = found[1]
        return end


def _row(line: bytes) -> tuple[str, dict[str, Any]] | None:
    checksum, _, text = line.rstrip(b"\n").partition(b" ")
    try:
        if int(checksum, 16) != zlib.crc32(text):
            return None
        key, _, fields = text.decode().partition(" ")
        row = json.loads(fields)
    except (ValueError, RecursionError):
        return None
    return (key, row) if isinstance(row, dict) else None
