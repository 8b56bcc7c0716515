"""Word between workers by PostgreSQL, and what is left where there is none."""

from __future__ import annotations

import asyncio
import time

import pytest

from real2sim_server.service.storage import notices as module
from real2sim_server.service.storage.notices import Notices, notice
from real2sim_server.service.storage.store import Store

from .opened_store import run

LONG_S = 20.0


@pytest.fixture
def server_url(postgres) -> str:
    return postgres.new_database()


def test_who_waits_hears_of_a_change_at_once(server_url):
    async def work(store: Store) -> float:
        notices = Notices(server_url, timeout_s=5)
        async with notices.running():
            jobs, bundles = notices.listener("jobs"), notices.listener("bundles")
            await asyncio.gather(jobs(LONG_S), bundles(LONG_S))  # that it listens now
            began = time.monotonic()
            waiting = asyncio.create_task(jobs(LONG_S))
            await store.write(*notice("jobs", on_server=True))
            await waiting
            took = time.monotonic() - began
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(bundles(LONG_S), 0.2)
        return took

    assert run(server_url, work) < LONG_S / 2


def test_a_change_that_is_taken_back_is_not_told(server_url):
    async def work(store: Store) -> None:
        notices = Notices(server_url, timeout_s=5)
        async with notices.running():
            jobs = notices.listener("jobs")
            await jobs(LONG_S)
            failing = module.Write("SELECT 1/0")
            with pytest.raises(Exception, match="division by zero"):
                await store.write(*notice("jobs", on_server=True), failing)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(jobs(LONG_S), 0.3)

    run(server_url, work)


def test_word_is_heard_again_after_the_server_was_gone(postgres, monkeypatch):
    monkeypatch.setattr(module, "RETRY_S", 0.05)
    monkeypatch.setattr(module, "BEAT_S", 0.05)

    async def work() -> None:
        notices = Notices(postgres.new_database(), timeout_s=5)
        async with notices.running():
            jobs = notices.listener("jobs")
            await jobs(LONG_S)
            await asyncio.to_thread(postgres.stop)
            await asyncio.to_thread(postgres.start)
            # It may have missed something: it looks.
            await asyncio.wait_for(jobs(4 * LONG_S), LONG_S)

    asyncio.run(work())


def test_a_file_has_no_word_and_waiting_ends_by_itself(tmp_path):
    async def work() -> None:
        notices = Notices(f"sqlite:///{tmp_path / 'x.db'}", timeout_s=5)
        assert not notices.can_hear
        async with notices.running():
            await notices.listener("jobs")(0.01)

    asyncio.run(work())
    assert notice("jobs", on_server=False) == []
