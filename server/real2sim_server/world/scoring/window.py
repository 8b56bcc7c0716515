"""The newest entries of a sequence that grows with every step, without a copy at every step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np

from ..path import Float

T = TypeVar("T")

ROOM = 8
"""Rows that a window of rows has room for at least."""


class Window(Generic[T]):
    """The last entries of a growing sequence, newest last.

    A window never changes for who holds it: :meth:`pushed` gives a new one. The two share their
    entries, as long as it is the first that goes on from this one; a second one, of a world that
    was forked here, begins with a copy.
    """

    __slots__ = ("_end", "_entries", "_length", "_unclaimed")

    def __init__(self, *entries: T) -> None:
        self._own(list(entries), len(entries))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[T]:
        return iter(self._entries[self._end - self._length : self._end])

    def newest(self, back: int = 0) -> T:
        """The newest entry, or the one ``back`` entries before; ``back`` < the length."""
        return self._entries[self._end - 1 - back]

    def pushed(self, entry: T, most: int) -> Window[T]:
        """With one more entry, the last ``most`` of them."""
        kept = min(self._length, most - 1)
        entries = self._entries
        try:
            # Atomic, so that worlds that go on from here on two threads do not share.
            self._unclaimed.pop()
            shared = len(entries) < 2 * most
        except IndexError:
            shared = False
        if not shared:
            entries = entries[self._end - kept : self._end]
        entries.append(entry)
        found: Window[T] = Window.__new__(Window)
        found._own(entries, kept + 1)
        return found

    def mapped(self, change: Callable[[T], T]) -> Window[T]:
        """With every entry changed."""
        return Window(*(change(entry) for entry in self))

    def _own(self, entries: list[T], length: int) -> None:
        self._entries, self._length = entries, length
        self._end = len(entries)
        self._unclaimed = [True]


class RowWindow:
    """The same of rows of numbers, which kernels take as one array.

    Attributes:
        rows: [n, C] float64, newest last; nobody writes into it.
    """

    __slots__ = ("_buffer", "_end", "_unclaimed", "rows")

    def __init__(self, rows: Float) -> None:
        self._own(rows, 0, len(rows))

    def __len__(self) -> int:
        return len(self.rows)

    def pushed(self, row: Sequence[float], most: int) -> RowWindow:
        """With one more row, the last ``most`` of them."""
        kept = min(len(self.rows), most - 1)
        buffer, end = self._buffer, self._end
        try:
            # As in Window.
            self._unclaimed.pop()
            shared = end < len(buffer)
        except IndexError:
            shared = False
        if not shared:
            buffer = np.empty((max(2 * kept, ROOM), self.rows.shape[1]))
            buffer[:kept] = self.rows[len(self.rows) - kept :]
            end = kept
        buffer[end] = row
        found = RowWindow.__new__(RowWindow)
        found._own(buffer, end - kept, end + 1)
        return found

    def _own(self, buffer: Float, begin: int, end: int) -> None:
        self._buffer, self._end = buffer, end
        self.rows = buffer[begin:end]
        self._unclaimed = [True]
