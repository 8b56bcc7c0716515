"""Entries of a session's log on their way to the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..._records import made_quickly
from ..storage.store import Claim, SessionEntry, Store


@made_quickly
@dataclass(frozen=True, eq=False)
class LogWrite:
    """Writes entries when it is called, never on the event loop.

    Attributes:
        store: takes them.
        claim: on the session.
        entries: of its log.
        instead: whether they take the place of what may be on record from there on.
    """

    store: Store
    claim: Claim
    entries: Sequence[SessionEntry]
    instead: bool

    def __call__(self) -> None:
        """Raises as :meth:`Store.record` does."""
        self.store.record(self.claim, self.entries, instead=self.instead)


def write_together(writes: Sequence[LogWrite]) -> None:
    """Write the entries of several sessions to their store: all, or none of them."""
    writes[0].store.record_together([(write.claim, write.entries) for write in writes])
