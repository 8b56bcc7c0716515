from __future__ import annotations

import asyncio
import json
import sqlite3
from dataclasses import replace

import pytest
import sqlalchemy as sa

from real2sim_proto.jobs import JobInfo, JobState
from real2sim_server.service.storage import schema
from real2sim_server.service.storage.connection import StoreFullError, StoreUnavailableError
from real2sim_server.service.storage.job_log import JobLog
from real2sim_server.service.storage.store import (
    Claim,
    ClaimedEntries,
    ConflictError,
    FencedError,
    ScenarioRow,
    SessionEntry,
    SessionRow,
    SnapshotRow,
    StoredReply,
    StoreError,
    Write,
    now_us,
)

from .opened_store import run

SCENARIO = ScenarioRow("sc_1", "first", "tiny", "0" * 64, 1)
SESSION = SessionRow("w0.1", "w0", "tiny", "0" * 64, None, None, "secret", 1)
REPLY = StoredReply("key", "f" * 64, 201, {"ETag": '"r1"'}, b'{"a": 1}')


def entry(text: str) -> dict:
    return {"kind": "edit", "text": text}


def test_a_scenario_and_its_log_survive_closing(url):
    async def write(store):
        await store.create_scenario(SCENARIO)
        store.record_revision("sc_1", 1, entry("a"), created_us=1)
        store.record_revision("sc_1", 2, entry("b"), created_us=2)

    async def read(store):
        return await store.scenario("sc_1"), await store.scenario_entries("sc_1")

    run(url, write)
    assert run(url, read) == (SCENARIO, [entry("a"), entry("b")])


def test_a_revision_can_be_written_only_once(url):
    async def write(store):
        await store.create_scenario(SCENARIO)
        store.record_revision("sc_1", 1, entry("a"), created_us=1)
        with pytest.raises(ConflictError):
            store.record_revision("sc_1", 1, entry("b"), created_us=1)
        return await store.scenario_entries("sc_1")

    assert run(url, write) == [entry("a")]


def test_an_entry_without_its_scenario_is_refused(url):
    async def write(store):
        with pytest.raises(ConflictError):
            store.record_revision("sc_9", 1, entry("a"), created_us=1)

    run(url, write)


def test_deleting_a_scenario_deletes_its_log(url):
    async def work(store):
        await store.create_scenario(SCENARIO)
        store.record_revision("sc_1", 1, entry("a"), created_us=1)
        assert await store.delete_scenario("sc_1") is True
        assert await store.delete_scenario("sc_1") is False
        return await store.scenarios(), await store.scenario_kinds()

    assert run(url, work) == ([], {})


def test_the_last_snapshot_of_a_scenario_is_kept(url):
    async def write(store):
        await store.create_scenario(SCENARIO)
        for revision in (128, 256):
            await store.save_snapshot(SnapshotRow("sc_1", revision, "1", bytes([revision % 255])))
        return await store.snapshot("sc_1"), await store.snapshot("sc_2")

    assert run(url, write) == (SnapshotRow("sc_1", 256, "1", b"\x01"), None)


def test_snapshots_are_deleted_with_their_scenario(url):
    async def work(store):
        await store.create_scenario(SCENARIO)
        await store.save_snapshot(SnapshotRow("sc_1", 128, "1", b"state"))
        await store.delete_scenario("sc_1")
        with pytest.raises(ConflictError):
            await store.save_snapshot(SnapshotRow("sc_1", 256, "1", b"state"))
        return await store.snapshot("sc_1")

    assert run(url, work) is None


def test_scenarios_are_listed_oldest_first(url):
    async def work(store):
        await store.create_scenario(replace(SCENARIO, scenario_id="late", created_us=9))
        await store.create_scenario(replace(SCENARIO, scenario_id="early", created_us=3))
        return [row.scenario_id for row in await store.scenarios()]

    assert run(url, work) == ["early", "late"]


def test_a_reply_is_stored_with_its_effect_or_not_at_all(url):
    async def work(store):
        await store.create_scenario(SCENARIO)
        store.record_revision("sc_1", 1, entry("a"), created_us=1, reply=REPLY)
        other = replace(REPLY, key="other")
        with pytest.raises(ConflictError):
            store.record_revision("sc_1", 1, entry("b"), created_us=1, reply=other)
        return await store.reply("key"), await store.reply("other")

    assert run(url, work) == (REPLY, None)


def test_a_reply_expires_after_a_day(url, monkeypatch):
    async def work(store):
        await store.create_scenario(SCENARIO, reply=REPLY)
        day_us = 24 * 3600 * 1_000_000
        monkeypatch.setattr(
            "real2sim_server.service.storage.store.now_us", lambda: now_us() + day_us
        )
        gone = await store.reply("key")
        await store.create_scenario(replace(SCENARIO, scenario_id="sc_2"), reply=REPLY)
        return gone, await store.reply("key")

    assert run(url, work) == (None, REPLY)


def test_a_session_log_is_appended_all_or_nothing(url):
    first, second = (SessionEntry(i, "action", i, b"\x80", 1) for i in range(2))

    async def work(store):
        await store.create_session(SESSION)
        await store.append_session_entries(SESSION.claim, [first])
        with pytest.raises(ConflictError):
            await store.append_session_entries(SESSION.claim, [second, first])
        kept = await store.session_entries("w0.1")
        await store.append_session_entries(SESSION.claim, [second])
        return kept, await store.session_entries("w0.1", after=0)

    assert run(url, work) == ([first], [second])


def test_open_sessions_are_the_unclosed_ones_of_a_worker(url):
    async def work(store):
        for session_id, worker_id in (("w0.1", "w0"), ("w0.2", "w0"), ("w1.1", "w1")):
            row = replace(SESSION, session_id=session_id, worker_id=worker_id)
            await store.create_session(row)
        await store.close_session(SESSION.claim, reason="done")
        await store.close_session(SESSION.claim, reason="again")
        return await store.open_sessions("w0"), await store.session("w0.1")

    still_open, closed = run(url, work)
    assert [row.session_id for row in still_open] == ["w0.2"]
    assert closed.reason == "done"
    assert closed.closed_us is not None


def test_sqlite_uses_a_write_ahead_log(sqlite_url, tmp_path):
    async def work(store):
        await store.create_scenario(SCENARIO)
        return (tmp_path / "deep" / "store.db-wal").exists()

    assert run(sqlite_url, work)


def test_entries_of_several_sessions_are_stored_all_or_nothing(url):
    sessions = [replace(SESSION, session_id=name) for name in ("w0.1", "w0.2")]

    def logs(*seqs: int) -> list[ClaimedEntries]:
        entries = [SessionEntry(seq, "action", seq, b"p", 1) for seq in seqs]
        return [(s.claim, [e]) for s, e in zip(sessions, entries, strict=True)]

    async def work(store):
        for session in sessions:
            await store.create_session(session)
        store.record_together(logs(0, 0))
        with pytest.raises(ConflictError):
            store.record_together(logs(1, 0))
        store.record_together(logs(1, 1))
        return [[e.seq for e in await store.session_entries(s.session_id)] for s in sessions]

    assert run(url, work) == [[0, 1], [0, 1]]


def test_sqlite_keeps_temporary_data_in_memory(sqlite_url):
    async def work(store):
        await store.create_session(SESSION)
        writer = store.database._writer.connection.dbapi_connection
        return writer.execute("PRAGMA temp_store").fetchone()[0]

    in_memory = 2
    assert run(sqlite_url, work) == in_memory


NORMAL, FULL = 1, 2
"""Values of SQLite's ``synchronous``: do not sync at a commit, or sync to disk."""


@pytest.mark.parametrize(
    ("durability", "edit", "step", "answered_step"),
    [("all", FULL, FULL, FULL), ("edits", FULL, NORMAL, FULL), ("process", NORMAL, NORMAL, NORMAL)],
)
def test_the_durability_setting_determines_which_writes_are_synced(
    sqlite_url, durability, edit, step, answered_step
):
    async def work(store):
        def waits_for() -> int:
            writer = store.database._writer.connection.dbapi_connection
            return writer.execute("PRAGMA synchronous").fetchone()[0]

        seen = []
        for write in (
            store.create_scenario(SCENARIO),
            store.create_session(SESSION),
            store.append_session_entries(SESSION.claim, [SessionEntry(0, "action", 0, b"", 1)]),
            store.append_session_entries(
                SESSION.claim, [SessionEntry(1, "action", 1, b"", 1)], reply=REPLY
            ),
        ):
            await write
            seen.append(await store.database.on_thread(waits_for))
        return seen

    assert run(sqlite_url, work, durability=durability) == [edit, edit, step, answered_step]


def test_a_store_with_a_newer_schema_is_refused_with_both_versions(sqlite_url, tmp_path):
    async def nothing(store):
        pass

    run(sqlite_url, nothing)
    connection = sqlite3.connect(tmp_path / "deep" / "store.db")
    connection.execute("UPDATE alembic_version SET version_num = '0099'")
    connection.commit()
    connection.close()
    with pytest.raises(StoreError, match=r"schema version 99, this program reads 1 to \d+;"):
        run(sqlite_url, nothing)


def test_a_file_that_is_not_a_database_is_refused(sqlite_url, tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "store.db").write_bytes(b"not a database at all" * 100)

    async def nothing(store):
        pass

    with pytest.raises(StoreError, match="cannot open the store"):
        run(sqlite_url, nothing)


def test_a_password_in_the_url_is_not_revealed():
    async def nothing(store):
        pass

    with pytest.raises(StoreError) as caught:
        run("nosuchdb://user:hunter2@host/db", nothing)
    assert "hunter2" not in str(caught.value)


def test_a_started_write_completes_when_its_caller_is_cancelled(url):
    async def work(store):
        await store.create_scenario(SCENARIO)
        row = {"scenario_id": "sc_1", "revision": 1, "kind": "edit", "created_us": 1}
        row["entry"] = json.dumps(entry("a"))
        task = asyncio.create_task(store.write(Write(sa.insert(schema.scenario_log), [row])))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return await store.scenario_entries("sc_1")

    assert run(url, work) == [entry("a")]


def test_an_in_memory_store_works():
    async def work(store):
        await store.create_scenario(SCENARIO)
        return await store.scenario("sc_1")

    assert run("sqlite://", work) == SCENARIO


def test_an_empty_append_is_allowed(url):
    async def work(store):
        await store.create_session(SESSION)
        await store.append_session_entries(SESSION.claim, [])
        return await store.session_entries("w0.1")

    assert run(url, work) == []


def test_jobs_survive_closing_and_are_found_by_state_and_subject(url):
    done = JobInfo(job_id="job_1", kind="export", subject="a", state="succeeded", created_at="then")
    stuck = JobInfo(job_id="job_2", kind="simulate", subject="b", state="running", created_at="now")

    async def write(store):
        log = JobLog(store, "w0")
        await log.add(done, reply=None)
        await log.add(stuck.model_copy(update={"state": JobState.QUEUED}), reply=None)
        await log.update(stuck, epoch=0)

    async def read(store):
        log = JobLog(store, "w0")
        other = await JobLog(store, "w1").orphaned(own=True)
        by_subject = await log.newest(subject="a", limit=5)
        return await log.get("job_2"), await log.orphaned(own=True), other, by_subject

    run(url, write)
    assert run(url, read) == (stuck, ["job_2"], [], [done])


def test_a_scenario_is_created_with_its_log_or_not_at_all(url):
    log = [entry("a") | {"revision": 1}, entry("b") | {"revision": 2}]

    async def work(store):
        await store.create_scenario(SCENARIO, entries=log)
        twice = replace(SCENARIO, scenario_id="sc_2")
        with pytest.raises(ConflictError):
            await store.create_scenario(twice, entries=[log[0], log[0]])
        return await store.scenario_entries("sc_1"), await store.scenario("sc_2")

    assert run(url, work) == (log, None)


def test_after_a_full_disk_the_connection_still_reads_and_writes(sqlite_url):
    async def fill(store):
        await store.create_scenario(SCENARIO)
        writer = store.database._writer.connection.dbapi_connection
        (pages,) = writer.execute("PRAGMA page_count").fetchone()
        writer.execute(f"PRAGMA max_page_count={pages + 2}")
        for revision in (1, 2):
            with pytest.raises(StoreFullError):
                store.record_revision("sc_1", revision, entry("x" * 100_000), created_us=1)
            assert store.database._writer.connection.dbapi_connection is writer
        entries = await store.scenario_entries("sc_1")
        writer.execute(f"PRAGMA max_page_count={pages + 1000}")
        store.record_revision("sc_1", 1, entry("there"), created_us=1)
        return entries, await store.scenario_entries("sc_1")

    before, after = run(sqlite_url, fill)
    assert (len(before), len(after)) == (0, 1)


def test_a_failed_store_refuses_without_querying_its_database(sqlite_url, monkeypatch):
    def ask(*_arguments, **_options):
        raise AssertionError

    async def work(store):
        await store.create_scenario(SCENARIO)
        database = store.database
        monkeypatch.setattr(database, "_executed", ask)
        monkeypatch.setattr(database, "_connected", ask)
        database._noted(StoreUnavailableError("gone"))
        with pytest.raises(StoreUnavailableError):
            store.record_revision("sc_1", 1, entry("a"), created_us=1)
        with pytest.raises(StoreUnavailableError):
            await store.scenario_entries("sc_1")
        monkeypatch.undo()

    run(sqlite_url, work)


def action(seq: int) -> SessionEntry:
    return SessionEntry(seq, "action", seq, b"\x80", 1)


def test_an_append_on_postgresql_is_prepared_and_fenced(postgres):
    url = postgres.new_database()

    async def work(store):
        await store.create_session(SESSION)
        claim = SESSION.claim
        store.record(claim, [action(0), action(1)])
        with pytest.raises(ConflictError):
            store.record(claim, [action(1)])
        with pytest.raises(FencedError):
            store.record(Claim(SESSION.session_id, 7), [action(2)])
        store.record(claim, [action(2)])
        prepared = store.database._prepared
        assert len(prepared._known) == 2
        return [entry.seq for entry in await store.session_entries(SESSION.session_id)]

    assert run(url, work) == [0, 1, 2]


def test_prepared_appends_continue_after_a_server_restart(postgres):
    url = postgres.new_database()

    async def work(store):
        await store.create_session(SESSION)
        claim = SESSION.claim
        store.record(claim, [action(0)])
        await asyncio.to_thread(postgres.stop)
        await asyncio.to_thread(postgres.start)
        store.record(claim, [action(1)])
        return len(await store.session_entries(SESSION.session_id))

    assert run(url, work) == 2
