"""What a session's log holds, between the store and the world."""

from __future__ import annotations

from collections.abc import Iterable

from ...world.recording.replay import Entry
from ..storage.store import SessionEntry


def entries_of(rows: Iterable[SessionEntry]) -> list[Entry]:
    """Entries of a stored log, for the world to live through again."""
    return [Entry(row.kind, row.step or 0, row.payload) for row in rows]
