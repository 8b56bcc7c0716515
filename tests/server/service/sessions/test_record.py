"""Log entries of several sessions share a transaction. One failure does not affect the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from real2sim_server.service.sessions.pipeline import LogWrite, Step, record
from real2sim_server.service.storage.store import SessionEntry, Store


class Shelf:
    """A store that refuses entries of some sessions."""

    def __init__(self, refused: Sequence[str] = ()) -> None:
        self.refused = set(refused)
        self.transactions: list[list[str]] = []

    def record(self, claim: str, entries: Sequence[SessionEntry], *, instead: bool) -> None:
        self.record_together([(claim, entries)])

    def record_together(self, logs: Sequence[tuple[str, Sequence[SessionEntry]]]) -> None:
        names = [name for name, _ in logs]
        if self.refused & set(names):
            raise OSError(f"no place for {names}")
        self.transactions.append(names)


def recorded(shelf: Shelf, names: Sequence[str], *, unsure: Sequence[str] = ()) -> dict[str, Any]:
    """Errors by session."""
    entries = [SessionEntry(1, "action", 0, b"", 0)]
    steps = {
        name: Step(
            cast(Any, None), {}, log=LogWrite(cast(Store, shelf), name, entries, name in unsure)
        )
        for name in names
    }
    record(list(steps.values()))
    for name, step in steps.items():
        assert step.recorded == (step.error is None), name
    return {name: step.error for name, step in steps.items() if step.error is not None}


def test_entries_of_several_sessions_share_one_transaction() -> None:
    shelf = Shelf()
    assert recorded(shelf, ["a", "b", "c"]) == {}
    assert shelf.transactions == [["a", "b", "c"]]


def test_a_failing_session_does_not_affect_the_others() -> None:
    shelf = Shelf(refused=["b"])
    failed = recorded(shelf, ["a", "b", "c"])
    assert list(failed) == ["b"]
    assert isinstance(failed["b"], OSError)
    assert shelf.transactions == [["a"], ["c"]]


def test_a_log_with_an_uncertain_end_is_written_separately() -> None:
    shelf = Shelf()
    assert recorded(shelf, ["a", "b"], unsure=["b"]) == {}
    assert shelf.transactions == [["a"], ["b"]]
