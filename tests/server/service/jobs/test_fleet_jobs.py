"""Jobs of several workers on one store. Each job is done once, even if a worker dies."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager

import pytest
import sqlalchemy as sa

from real2sim_proto.jobs import JobInfo, JobState
from real2sim_server.service import jobs as module
from real2sim_server.service.jobs import MAX_DEATHS, JobResult, Jobs, NewJob
from real2sim_server.service.library.scenes import Quota
from real2sim_server.service.storage import job_log, schema
from real2sim_server.service.storage.fleet import Leases
from real2sim_server.service.storage.job_log import JobLog
from real2sim_server.service.storage.store import FencedError, Store, Write
from tests.waiting import LIMIT_S, wait_until_async

from ..postgres import Postgres

SIMULATION = NewJob("simulate", "sc_1", {"scenario": "sc_1"}, portable=True)


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.db'}"
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(module, "POLL_S", 0.05)
    monkeypatch.setattr(module, "FOLLOW_S", 0.02)
    # Queued jobs are claimed only when a test allows it.
    monkeypatch.setattr(job_log, "OVERDUE_US", 3_600_000_000)


@pytest.fixture
def fleet(url, tmp_path):
    """Run ``work(start)``. ``start(name)`` returns the jobs of a live worker."""

    def run(work):
        async def inside():
            async with AsyncExitStack() as stack:

                async def start(name: str, alive: bool = True) -> Jobs:
                    return await stack.enter_async_context(worker(url, name, tmp_path, alive))

                return await work(start)

        return asyncio.run(inside())

    return run


@asynccontextmanager
async def worker(url, name, tmp_path, alive):
    store = Store(url)
    await store.open()
    try:
        await Leases(store, name, seconds=3600 if alive else 0).renew({})
        quota = Quota(tmp_path / name, "jobs", 1000, 1 << 30, "JOBS_QUOTA", "delete jobs")
        jobs = Jobs(JobLog(store, name), quota)
        jobs.rebuild = remade(name)
        async with jobs.running():
            yield jobs
    finally:
        await store.close()


def remade(name: str):
    async def rebuild(info: JobInfo):
        async def work(_context) -> JobResult:
            return JobResult({"by": name, "asked": info.request})

        return work

    return rebuild


async def for_ever(context) -> JobResult:
    while True:
        context.progress(0.5, "waiting")
        await asyncio.sleep(0.005)


async def die(jobs: Jobs) -> None:
    """Simulate a killed worker: its tasks stop and its lease runs out."""
    jobs._closing = True
    jobs._log.claim_overdue = jobs._log.claim_orphaned = none
    for job in jobs._jobs.values():
        job.lost = True
        job.task.cancel()
    await Leases(jobs._log._store, jobs._log.worker_id, seconds=0).renew({})


async def none(*_given) -> None:
    """Claim nothing, as a dead worker does."""


async def running(jobs: Jobs, job: JobInfo) -> None:
    held = jobs._jobs[job.job_id]
    await wait_until_async(lambda: held.info.state is JobState.RUNNING, "the job to run")


def test_a_job_of_a_dead_worker_is_completed_by_another(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        job = await first.start(SIMULATION, for_ever)
        await running(first, job)
        await die(first)
        return await second.wait(job.job_id, LIMIT_S)

    done = fleet(work)
    assert (done.state, done.attempt, done.worker) == (JobState.SUCCEEDED, 2, "w1")
    assert done.result == {"by": "w1", "asked": {"scenario": "sc_1"}}


def test_only_one_of_several_workers_claims_a_job(url):
    left = JobInfo(job_id="job_1", kind="export", subject="a", state="running", created_at="then")

    async def work():
        stores = [Store(url) for _ in range(4)]
        for store in stores:
            await store.open()
        logs = [JobLog(store, f"w{k}") for k, store in enumerate(stores)]
        try:
            await logs[0].add(left, reply=None)
            for k in (1, 2, 3):
                await Leases(stores[k], f"w{k}", seconds=3600).renew({})
            return await asyncio.gather(*(log.claim("job_1") for log in logs[1:]))
        finally:
            for store in stores:
                await store.close()

    claims = asyncio.run(work())
    assert [claim.deaths for claim in claims if claim is not None] == [1]


def test_a_job_that_cannot_be_repeated_is_marked_interrupted_by_another_worker(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        job = await first.start(NewJob("drive", "tiny"), for_ever)
        await running(first, job)
        await die(first)
        return await second.wait(job.job_id, LIMIT_S)

    left = fleet(work)
    assert left.state is JobState.INTERRUPTED
    assert left.error.retryable


def test_a_job_fails_after_too_many_worker_deaths(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        job = await first.start(SIMULATION, for_ever)
        await running(first, job)
        died = sa.update(schema.jobs).values(deaths=MAX_DEATHS - 1)
        await first._log._store.write(Write(died))
        await die(first)
        return await second.wait(job.job_id, LIMIT_S)

    left = fleet(work)
    assert left.state is JobState.FAILED
    assert f"{MAX_DEATHS} workers died" in left.error.detail


def test_cancelling_reaches_the_worker_that_runs_the_job(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        job = await first.start(NewJob("export", "tiny"), for_ever)
        await running(first, job)
        await second.cancel(job.job_id)
        return await second.wait(job.job_id, LIMIT_S), await first.get(job.job_id)

    told, there = fleet(work)
    assert told.state is there.state is JobState.CANCELLED


def test_any_worker_streams_the_progress_of_a_job(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        gate = asyncio.Event()

        async def half(context) -> JobResult:
            context.progress(0.5, "half")
            await gate.wait()
            return JobResult({"answer": 42})

        job = await first.start(NewJob("export", "tiny"), half)
        seen = []
        async for info in second.events(job.job_id, after=0):
            seen.append(info)
            if info.progress == 0.5:
                gate.set()
        return seen

    seen = fleet(work)
    assert (seen[-1].state, seen[-1].result) == (JobState.SUCCEEDED, {"answer": 42})
    assert [info.event for info in seen] == sorted({info.event for info in seen})


def test_an_idle_worker_claims_jobs_queued_at_another(fleet, monkeypatch):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        busy = await first.start(NewJob("simulate", "tiny"), for_ever)
        await running(first, busy)
        monkeypatch.setattr(job_log, "OVERDUE_US", 0)
        waiting = await first.start(SIMULATION, for_ever)
        return await first.wait(waiting.job_id, LIMIT_S), await second.get(busy.job_id)

    done, busy = fleet(work)
    assert (done.worker, done.attempt, done.state) == ("w1", 1, JobState.SUCCEEDED)
    assert (busy.worker, busy.state) == ("w0", JobState.RUNNING)


def test_a_worker_with_an_expired_lease_cannot_update_a_job_completed_elsewhere(fleet):
    async def work(start):
        first, second = await start("w0"), await start("w1")
        job = await first.start(SIMULATION, for_ever)
        await running(first, job)
        await Leases(first._log._store, "w0", seconds=0).renew({})
        done = await second.wait(job.job_id, LIMIT_S)
        late = done.model_copy(update={"state": JobState.FAILED})
        with pytest.raises(FencedError):
            await first._log.update(late, epoch=0)
        return await first.wait(job.job_id, LIMIT_S)

    assert fleet(work).result["by"] == "w1"


def test_a_stopped_worker_leaves_its_jobs_to_others(fleet, url, tmp_path):
    async def work(start):
        async with worker(url, "w0", tmp_path, alive=False) as first:
            job = await first.start(SIMULATION, for_ever)
            await running(first, job)
        return await (await start("w1")).wait(job.job_id, LIMIT_S)

    done = fleet(work)
    assert (done.state, done.attempt) == (JobState.SUCCEEDED, 1)
