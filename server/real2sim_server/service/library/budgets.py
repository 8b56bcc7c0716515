"""Budgets: memory for loaded scenes and assets, and disk space for the folders of a worker."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError


@dataclass(frozen=True)
class IdleItem:
    """Something in memory that nobody uses.

    Attributes:
        used_at: when it was used last, by the monotonic clock.
        nbytes: what it takes.
        drop: forgets it; the bytes that come free, at once or within a moment.
    """

    used_at: float
    nbytes: int
    drop: Callable[[], int]


class MemoryHolder(Protocol):
    """What loads things under the budget. Both are called on any thread."""

    @property
    def held_bytes(self) -> int:
        """Memory of all that is loaded or being loaded."""

    def idle(self) -> Sequence[IdleItem]:
        """What could be forgotten."""


class MemoryBudget:
    """Bytes that all holders may take together. Safe to use on any thread.

    Args:
        total_bytes: the budget.
    """

    def __init__(self, total_bytes: int) -> None:
        self.total_bytes = total_bytes
        self._holders: list[MemoryHolder] = []
        self._lock = threading.Lock()

    def add(self, holder: MemoryHolder) -> None:
        """Count what ``holder`` loads."""
        self._holders.append(holder)

    @property
    def free_bytes(self) -> int:
        """What is left; negative where users keep more than the budget alive."""
        return self.total_bytes - sum(holder.held_bytes for holder in self._holders)

    def make_room(self, what: str, needed: int, *, reserve: Callable[[], None]) -> None:
        """Forget idle things, longest unused first, until ``needed`` bytes fit.

        Args:
            what: for messages, as ``scene 'street'``.
            needed: bytes.
            reserve: makes its holder count them; called while no other call can take the room.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        if needed > self.total_bytes:
            raise _out_of_memory(
                f"{what} needs {needed} bytes, the budget is {self.total_bytes}",
                hint="raise REAL2SIM_SCENE_MEMORY_BYTES, or thin it out",
                needed=needed,
                free=self.total_bytes,
            )
        with self._lock:
            free = self.free_bytes
            idle = sorted(
                (item for holder in self._holders for item in holder.idle()),
                key=lambda item: item.used_at,
            )
            if needed <= free + sum(item.nbytes for item in idle):
                for item in idle:
                    if needed <= free:
                        break
                    free += item.drop()
            if needed > free:
                raise _out_of_memory(
                    f"{what} needs {needed} bytes; of the budget of {self.total_bytes} all but "
                    f"{free} are taken by scenes and assets that are in use",
                    hint="close sessions on other scenes, or raise REAL2SIM_SCENE_MEMORY_BYTES",
                    needed=needed,
                    free=free,
                )
            reserve()


def _out_of_memory(detail: str, *, hint: str, needed: int, free: int) -> ServiceError:
    extra = {"needed_bytes": needed, "free_bytes": free}
    return ServiceError(ErrorCode.OUT_OF_MEMORY, detail, hint=hint, extra=extra)


# --- Disk ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quota:
    """Limits of one folder. What is there already counts, whoever put it there.

    Attributes:
        folder: that is looked at; it need not exist.
        what: its entries for messages, as ``assets``.
        max_entries: of the folder; hidden ones do not count.
        max_bytes: of everything below it.
        setting: that the operator raises, as ``ASSETS_QUOTA``.
        remedy: what makes room.
    """

    folder: Path
    what: str
    max_entries: int
    max_bytes: int
    setting: str
    remedy: str

    def check(self, *, added_bytes: int = 0, entries: int | None = None) -> None:
        """Refuse one more entry where there is no room. Reads the folder, which takes time.

        Args:
            added_bytes: of the new entry, as far as they are known.
            entries: that there are, where they are not counted by the folder.

        Raises:
            ServiceError: QUOTA_EXCEEDED.
        """
        found, used = folder_usage(self.folder)
        entries = found if entries is None else entries
        if entries >= self.max_entries:
            raise self._exceeded(
                f"there are {entries} {self.what}; allowed are {self.max_entries}", self.setting
            )
        if used + added_bytes > self.max_bytes or used >= self.max_bytes:
            raise self._exceeded(
                f"{self.what} take {used} bytes of disk and this one at least {added_bytes} more; "
                f"allowed are {self.max_bytes}",
                f"{self.setting}_BYTES",
            )

    def _exceeded(self, detail: str, setting: str) -> ServiceError:
        return ServiceError(
            ErrorCode.QUOTA_EXCEEDED,
            detail,
            hint=f"{self.remedy}, or let the operator raise REAL2SIM_{setting}",
        )


def folder_usage(folder: Path) -> tuple[int, int]:
    """Entries of a folder, and bytes of the files in them; hidden entries are being made."""
    entries = [entry for entry in _scan(folder) if not entry.name.startswith(".")]
    return len(entries), sum(map(_size, entries))


def _size(entry: os.DirEntry[str]) -> int:
    try:
        if entry.is_dir(follow_symlinks=False):
            return sum(map(_size, _scan(entry.path)))
        return entry.stat(follow_symlinks=False).st_size
    except OSError:  # it was removed meanwhile
        return 0


def _scan(folder: str | Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []
