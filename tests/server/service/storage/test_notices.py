"""Notices between workers over PostgreSQL, and the fallback on SQLite."""

from __future__ import annotations

import asyncio
from collections import Counter

import pytest

from real2sim_server.service.storage import fleet as module
from real2sim_server.service.storage.fleet import Notices, notice
from real2sim_server.service.storage.store import Store
from tests.waiting import LIMIT_S, wait_until_async

from .opened_store import run


@pytest.fixture
def server_url(postgres) -> str:
    return postgres.new_database()


def test_a_waiting_listener_is_notified_of_a_change_immediately(server_url):
    async def work(store: Store) -> Counter[str]:
        notices = Notices(server_url, timeout_s=LIMIT_S)
        async with notices.running():
            jobs, bundles = notices.listener("jobs"), notices.listener("bundles")
            await asyncio.gather(jobs(LIMIT_S), bundles(LIMIT_S))  # wait until it listens
            before = notices._counts.copy()
            waiting = asyncio.create_task(jobs(LIMIT_S))
            await store.write(*notice("jobs", on_server=True))
            await waiting
            return notices._counts - before

    assert run(server_url, work) == {"jobs": 1}


def test_a_rolled_back_change_is_not_announced(server_url):
    async def work(store: Store) -> Counter[str]:
        notices = Notices(server_url, timeout_s=LIMIT_S)
        async with notices.running():
            jobs, bundles = notices.listener("jobs"), notices.listener("bundles")
            await asyncio.gather(jobs(LIMIT_S), bundles(LIMIT_S))
            before = notices._counts.copy()
            failing = module.Write("SELECT 1/0")
            with pytest.raises(Exception, match="division by zero"):
                await store.write(*notice("jobs", on_server=True), failing)
            # Notices arrive in the order of the changes.
            await store.write(*notice("bundles", on_server=True))
            await bundles(LIMIT_S)
            return notices._counts - before

    assert run(server_url, work) == {"bundles": 1}


def test_notices_resume_after_a_server_restart(postgres, monkeypatch):
    monkeypatch.setattr(module, "RETRY_S", 0.05)
    monkeypatch.setattr(module, "BEAT_S", 0.05)

    async def work() -> None:
        notices = Notices(postgres.new_database(), timeout_s=LIMIT_S)
        async with notices.running():
            await notices.listener("jobs")(LIMIT_S)
            before = notices._counts["jobs"]
            await asyncio.to_thread(postgres.stop)
            await asyncio.to_thread(postgres.start)
            # A notice may have been missed, so the listener wakes up.
            await wait_until_async(lambda: notices._counts["jobs"] > before, "word")

    asyncio.run(work())


def test_sqlite_has_no_notices_and_waiting_times_out(tmp_path):
    async def work() -> None:
        notices = Notices(f"sqlite:///{tmp_path / 'x.db'}", timeout_s=5)
        assert not notices.can_hear
        async with notices.running():
            await notices.listener("jobs")(0.01)

    asyncio.run(work())
    assert notice("jobs", on_server=False) == []
