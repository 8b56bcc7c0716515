"""A session moves to another worker only after its lease has expired. The previous worker can then
no longer write to it."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest
import sqlalchemy as sa

from real2sim_server.service.storage.connection import FencedError
from real2sim_server.service.storage.fleet import Leases
from real2sim_server.service.storage.store import (
    SessionEntry,
    SessionRow,
    Store,
    StoredReply,
    Write,
)
from tests.waiting import LIMIT_S, wait_until_async

from .opened_store import run

SESSION = SessionRow("w0.1", "w0", "tiny", "0" * 64, None, None, "secret", 1)
LONG_S, OVER_S = 3600.0, -1.0


def action(seq: int) -> SessionEntry:
    return SessionEntry(seq, "action", seq, b"\x80", 1)


def leases_of(store: Store, worker_id: str, seconds: float = LONG_S) -> Leases:
    return Leases(store, worker_id, seconds=seconds)


async def taken_over(store: Store) -> SessionRow:
    """A session of w0 that w1 has taken over."""
    await store.create_session(SESSION)
    await store.append_session_entries(SESSION.claim, [action(0)])
    row = await leases_of(store, "w1").take_over("w0.1")
    assert row is not None
    return row


def test_a_session_with_a_valid_lease_is_not_taken_over(url):
    async def work(store):
        await store.create_session(SESSION)
        await leases_of(store, "w0").renew({})
        return await leases_of(store, "w1").take_over("w0.1"), await store.session("w0.1")

    taken, row = run(url, work)
    assert taken is None
    assert row == SESSION


def test_a_session_with_an_expired_lease_is_taken_over_once(url):
    async def work(store):
        await store.create_session(SESSION)
        await leases_of(store, "w0", OVER_S).renew({})
        one = await leases_of(store, "w1").take_over("w0.1")
        await leases_of(store, "w1").renew({})
        return one, await leases_of(store, "w2").take_over("w0.1")

    one, two = run(url, work)
    assert one == replace(SESSION, worker_id="w1", epoch=1)
    assert two is None


def test_a_released_lease_allows_a_takeover(url):
    async def work(store):
        await store.create_session(SESSION)
        await leases_of(store, "w0").renew({})
        await leases_of(store, "w0").give_up({})
        return await leases_of(store, "w1").take_over("w0.1")

    assert run(url, work).worker_id == "w1"


def test_a_worker_can_always_reclaim_its_own_session(url):
    async def work(store):
        await store.create_session(SESSION)
        await leases_of(store, "w0").renew({})
        return await leases_of(store, "w0").take_over("w0.1")

    assert run(url, work) == replace(SESSION, epoch=1)


def test_closed_and_unknown_sessions_are_not_taken_over(url):
    async def work(store):
        await store.create_session(SESSION)
        await store.close_session(SESSION.claim, reason="done")
        leases = leases_of(store, "w1")
        return await leases.take_over("w0.1"), await leases.take_over("w0.2")

    assert run(url, work) == (None, None)


def test_the_previous_worker_cannot_append(url):
    reply = StoredReply("key", "f" * 64, 200, {}, b"{}")

    async def work(store):
        row = await taken_over(store)
        with pytest.raises(FencedError):
            await store.append_session_entries(SESSION.claim, [action(1)], reply=reply)
        with pytest.raises(FencedError):
            await store.append_session_entries(SESSION.claim, [action(0)], instead=True)
        await store.append_session_entries(row.claim, [action(1)])
        return await store.session_entries("w0.1"), await store.reply("key"), store.trouble

    entries, reply, trouble = run(url, work)
    assert [e.seq for e in entries] == [0, 1]
    assert reply is None
    assert trouble is None


def test_the_previous_worker_cannot_withdraw_or_close(url):
    async def work(store):
        row = await taken_over(store)
        with pytest.raises(FencedError):
            await store.withdraw(SESSION.claim, from_seq=0)
        await store.close_session(SESSION.claim, reason="its controller has left")
        return row, await store.session("w0.1"), await store.session_entries("w0.1")

    row, now, entries = run(url, work)
    assert now == row
    assert [e.seq for e in entries] == [0]


@pytest.mark.parametrize("count", [1, 40])
def test_logs_written_together_are_all_refused_if_one_was_taken_over(url, count):
    other = replace(SESSION, session_id="w0.2")

    async def work(store):
        await taken_over(store)
        await store.create_session(other)
        entries = [action(1 + k) for k in range(count)]
        logs = [(other.claim, entries), (SESSION.claim, entries)]
        with pytest.raises(FencedError):
            await store.database.on_thread(lambda: store.record_together(logs))
        return await store.session_entries("w0.2")

    assert run(url, work) == []


def test_a_concurrent_append_and_takeover_exclude_each_other(postgres):
    """With a database server both can run at once. Either the entry is in the log that is taken
    over, or it is refused."""
    url = postgres.new_database()

    async def work(store):
        await store.create_session(SESSION)
        other = Store(url)
        await other.open()
        engine = other.database._connected()
        taking = sa.text("UPDATE sessions SET worker_id = 'w1', epoch = epoch + 1")
        with engine.connect() as connection:
            connection.execute(taking)
            appending = asyncio.create_task(
                store.append_session_entries(SESSION.claim, [action(0)])
            )
            waiting = sa.text("SELECT count(*) FROM pg_locks WHERE NOT granted")
            await wait_until_async(lambda: connection.execute(waiting).scalar(), "the append")
            connection.commit()
        with pytest.raises(FencedError):
            await appending
        entries = await store.session_entries("w0.1")
        await other.close()
        return entries

    assert run(url, work, timeout_s=LIMIT_S) == []


def test_epochs_are_returned_for_own_sessions_only(url):
    async def work(store):
        await taken_over(store)
        await store.create_session(replace(SESSION, session_id="w0.2"))
        ids = ["w0.1", "w0.2", "w0.3"]
        return await leases_of(store, "w0").epochs(ids), await leases_of(store, "w1").epochs(ids)

    assert run(url, work) == ({"w0.2": 0}, {"w0.1": 1})


def test_workers_lists_liveness_and_documents(url):
    async def work(store):
        await leases_of(store, "w0").renew({"sessions": 2})
        await leases_of(store, "w0").renew({"sessions": 3})
        await leases_of(store, "w1").renew({})
        await leases_of(store, "w1").give_up({})
        return await leases_of(store, "w0").workers()

    one, two = run(url, work)
    assert (one.worker_id, one.alive, one.document) == ("w0", True, {"sessions": 3})
    assert (two.worker_id, two.alive) == ("w1", False)


def test_a_write_that_changes_too_few_rows_is_rolled_back(url):
    async def work(store):
        await store.create_session(SESSION)
        rename = sa.text("UPDATE sessions SET scene = 'other'")
        miss = sa.text("UPDATE sessions SET scene = 'none' WHERE session_id = 'w9.9'")
        with pytest.raises(FencedError):
            await store.database.write(Write(rename), Write(miss, fenced=1))
        return await store.session("w0.1")

    assert run(url, work) == SESSION
