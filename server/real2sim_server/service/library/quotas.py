"""How many things a folder of the worker may hold, and how much of the disk."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError


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
