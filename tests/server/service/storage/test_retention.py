"""Data that a store deletes automatically, and data that it keeps."""

from __future__ import annotations

from dataclasses import replace

import pytest
import sqlalchemy as sa

from real2sim_server.service import maintenance as module
from real2sim_server.service.maintenance import DAY_US, Retention, RetentionLimits
from real2sim_server.service.storage import schema
from real2sim_server.service.storage.store import (
    ScenarioRow,
    SessionEntry,
    SessionRow,
    Write,
    now_us,
)

from ..postgres import Postgres
from .opened_store import run

SESSION = SessionRow("w0.1", "w0", "tiny", "0" * 64, None, None, "hash", 1)
GIB = 1024**3


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.db'}"
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()


async def add(store, session_id, *, days_ago, ended=False, steps=3, payload=b"x") -> None:
    """Add a session last used some days ago, ended or still open."""
    us = now_us() - round(days_ago * DAY_US)
    entries = [SessionEntry(k, "action", k, payload, us) for k in range(steps)]
    row = replace(SESSION, session_id=session_id, created_us=us - DAY_US)
    await store.create_session(row, entries=entries)
    if ended:
        change = sa.update(schema.sessions).where(schema.sessions.c.session_id == session_id)
        await store.write(Write(change.values(closed_us=us, reason="done")))


async def kept(store) -> dict[str, bool]:
    """Remaining sessions, and whether they are open."""
    rows = await store.read(sa.select(schema.sessions))
    return {row["session_id"]: row["closed_us"] is None for row in rows}


def tidy(store, *, days=30.0, max_bytes=GIB, in_use=()):
    limits = RetentionLimits(days, max_bytes)
    return Retention(store, limits, worker_id="w0").tidy(in_use=in_use)


def test_old_ended_sessions_are_deleted_with_their_logs(url, monkeypatch):
    monkeypatch.setattr(module, "PIECE_ROWS", 10)

    async def work(store):
        await add(store, "w0.old", days_ago=31, ended=True, steps=35)
        await add(store, "w0.new", days_ago=29, ended=True)
        removed = await tidy(store)
        return removed, await kept(store), len(await store.session_entries("w0.old"))

    assert run(url, work) == (1, {"w0.new": False}, 0)


def test_only_unused_sessions_are_ended(url):
    async def work(store):
        await add(store, "w0.forgotten", days_ago=31)
        await add(store, "w0.held", days_ago=31)
        await add(store, "w0.used", days_ago=1)
        await tidy(store, in_use={"w0.held"})
        return await kept(store)

    expected = {"w0.forgotten": False, "w0.held": True, "w0.used": True}
    assert run(url, work) == expected


def test_over_its_size_limit_a_store_deletes_the_oldest_ended_sessions(url):
    async def work(store):
        for n in range(20):
            payload = bytes(10_000)
            await add(store, f"w0.{n:02}", days_ago=20 - n, ended=True, steps=20, payload=payload)
        await add(store, "w0.open", days_ago=20)
        before = await store.size_bytes()
        await tidy(store, max_bytes=before // 2)
        return await kept(store), await store.size_bytes(), before

    left, after, before = run(url, work)
    assert after <= before // 2
    assert "w0.open" in left
    assert "w0.19" in left
    assert "w0.00" not in left


def test_scenarios_are_never_deleted(url):
    async def work(store):
        await store.create_scenario(ScenarioRow("sc_1", "n", "tiny", "0" * 64, 1))
        store.record_revision("sc_1", 1, {"kind": "edit", "x": "y" * 100_000}, created_us=1)
        await tidy(store, max_bytes=1)
        return await store.scenario_entries("sc_1")

    assert len(run(url, work)) == 1


def test_freed_pages_are_returned_to_the_file_system(tmp_path):
    file = tmp_path / "store.db"
    url = f"sqlite:///{file}"
    log = {"steps": 200, "payload": bytes(10_000)}
    run(url, lambda store: add(store, "w0.old", days_ago=31, ended=True, **log))
    before = file.stat().st_size
    assert before > 2_000_000
    run(url, tidy)
    assert file.stat().st_size < before / 4


def test_only_the_requested_number_of_pages_is_released_at_once(tmp_path):
    async def work(store):
        await add(store, "w0.old", days_ago=31, ended=True, steps=200, payload=bytes(10_000))
        everything = sa.delete(schema.session_log)
        await store.write(Write(everything))
        more = await store.give_back(300)
        return more, await _free_pages(store), await store.give_back(10_000)

    more, left, even_more = run(f"sqlite:///{tmp_path / 'store.db'}", work)
    assert (more, even_more) == (True, False)
    assert 200 <= left <= 500


async def _free_pages(store) -> int:
    def ask() -> int:
        with store.database._connected().connect() as connection:
            return connection.exec_driver_sql("PRAGMA freelist_count").scalar_one()

    return await store.database.on_thread(ask)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_week_of_work_stays_within_the_size_limit(tmp_path):
    """One million steps, 100,000 edits and 1,000 sessions."""
    url, limit = f"sqlite:///{tmp_path / 'store.db'}", 200 * 1024**2
    entry = {"kind": "edit", "operations": [{"op": "translate", "object_id": "post", "x": 1.0}]}

    async def week(store) -> list[int]:
        for n in range(100):
            row = ScenarioRow(f"sc_{n}", "n", "tiny", "0" * 64, n)
            log = [entry | {"revision": k + 1} for k in range(1000)]
            await store.create_scenario(row, entries=log)
        resident = []
        for n in range(1000):
            days_ago = 7 * (1 - n / 1000)
            await add(
                store, f"w0.{n}", days_ago=days_ago, ended=True, steps=1000, payload=b"p" * 250
            )
            if n % 100 == 99:
                await tidy(store, max_bytes=limit)
                resident.append(_resident_bytes())
        return resident

    resident = run(url, week)
    assert resident[-1] - resident[1] < 50 * 1024**2
    assert sum(f.stat().st_size for f in tmp_path.glob("store.db*")) < 1.2 * limit

    async def open_and_read(store):
        return len(await store.scenario_entries("sc_99")), len(
            await store.session_entries("w0.999")
        )

    assert run(url, open_and_read) == (1000, 1000)


def _resident_bytes() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096
