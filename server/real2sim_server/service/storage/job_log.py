"""The jobs table of the store: one row per job, rewritten when the job changes state."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from real2sim_proto.jobs import JobInfo, JobState

from ..clock import now_us
from . import schema as t
from .fleet import clock_of, is_alive, notice
from .store import Store, StoredReply, Write

UNFINISHED = (JobState.QUEUED.value, JobState.RUNNING.value)


OVERDUE_US = 1_000_000
"""Waiting time after which another worker may claim a queued job [us]."""


@dataclass(frozen=True)
class ClaimedJob:
    """A job that this worker has taken over.

    Attributes:
        info: the last stored record.
        epoch: fencing number; writes with an older one are refused.
        deaths: number of workers that died while running it.
        portable: whether it can be rebuilt from ``info``.
        cancelled: whether a client has cancelled it.
    """

    info: JobInfo
    epoch: int
    deaths: int
    portable: bool
    cancelled: bool


class JobLog:
    """Reads and writes jobs in the store.

    Args:
        store: an open store.
        worker_id: id of this worker.
    """

    def __init__(self, store: Store, worker_id: str) -> None:
        self._store = store
        self._worker_id = worker_id

    @property
    def worker_id(self) -> str:
        """Id of this worker."""
        return self._worker_id

    async def add(self, job: JobInfo, *, reply: StoredReply | None, portable: bool = False) -> None:
        """Store a new job.

        Args:
            job: the job.
            reply: reply to the request, stored for repeated requests.
            portable: whether any worker can rebuild its work from the record.
        """
        row = _row(job) | {"worker_id": self._worker_id, "created_us": now_us()}
        row["portable"] = int(portable)
        await self._store.write(Write(sa.insert(t.jobs), [row]), *self._notice(), reply=reply)

    async def update(self, job: JobInfo, *, epoch: int) -> None:
        """Store the job's state. Raises FencedError if it was taken over or deleted."""
        mine = (t.jobs.c.job_id == job.job_id) & (t.jobs.c.epoch == epoch)
        change = sa.update(t.jobs).where(mine).values(_row(job))
        await self._store.write(Write(change, fenced=1), *self._notice())

    async def update_progress(self, job: JobInfo, *, epoch: int) -> None:
        """Store the job's progress, unless it has ended."""
        mine = (t.jobs.c.job_id == job.job_id) & (t.jobs.c.epoch == epoch)
        running = t.jobs.c.state == JobState.RUNNING.value
        change = sa.update(t.jobs).where(mine & running).values(_row(job))
        await self._store.write(Write(change), *self._notice())

    async def request_cancel(self, job_id: str) -> None:
        """Request the worker that runs the job to cancel it."""
        change = sa.update(t.jobs).where(t.jobs.c.job_id == job_id).values(cancelled=1)
        await self._store.write(Write(change), *self._notice())

    async def cancelled_or_lost(self, epochs: Mapping[str, int]) -> tuple[set[str], set[str]]:
        """The ids of jobs that clients have cancelled, and of jobs that this worker has lost.

        Args:
            epochs: fencing numbers by job id.
        """
        j = t.jobs.c
        rows = await self._store.read(
            sa.select(j.job_id, j.epoch, j.cancelled).where(j.job_id.in_(epochs))
        )
        kept = {r["job_id"]: r for r in rows if r["epoch"] == epochs[r["job_id"]]}
        return {name for name, row in kept.items() if row["cancelled"]}, set(epochs) - set(kept)

    async def orphaned(self, *, own: bool) -> list[str]:
        """Ids of unfinished jobs of dead workers, or of this worker's earlier runs if ``own``;
        oldest first."""
        return await self._ids(self._is_orphaned(own=own))

    async def claim(self, job_id: str, *, own: bool = False) -> ClaimedJob | None:
        """Take over an orphaned or overdue job, atomically; None if another worker has it."""
        free = self._is_orphaned(own=own) | self._is_overdue()
        return await self._claim((t.jobs.c.job_id == job_id) & free)

    async def claim_orphaned(self) -> ClaimedJob | None:
        """Take over the oldest unfinished job of a dead worker, or return None."""
        return await self._claim(self._is_first_of(self._is_orphaned(own=False)))

    async def claim_overdue(self, kinds: Collection[str]) -> ClaimedJob | None:
        """Take over the oldest overdue portable job of the given kinds, or return None."""
        return await self._claim(self._is_first_of(self._is_overdue() & t.jobs.c.kind.in_(kinds)))

    def _is_first_of(self, free: sa.ColumnElement[bool]) -> sa.ColumnElement[bool]:
        """SQL condition: the first matching job. Concurrent workers get different jobs, because a
        database server skips rows that others have locked."""
        j = t.jobs.c
        first = sa.select(j.job_id).where(free).order_by(j.created_us, j.job_id).limit(1)
        first = first.with_for_update(skip_locked=True).correlate(None)
        return j.job_id == first.scalar_subquery()

    async def _claim(self, condition: sa.ColumnElement[bool]) -> ClaimedJob | None:
        j = t.jobs.c
        died = sa.case((j.state == JobState.RUNNING.value, 1), else_=0)
        values = {"worker_id": self._worker_id, "epoch": j.epoch + 1, "deaths": j.deaths + died}
        claimed = sa.update(t.jobs).where(condition).values(values).returning(t.jobs)
        rows = await self._store.database.write_returning(claimed)
        if not rows:
            return None
        (row,) = rows
        info = JobInfo.model_validate_json(row["document"])
        whether = bool(row["portable"]), bool(row["cancelled"])
        return ClaimedJob(info, row["epoch"], row["deaths"], *whether)

    def _notice(self) -> list[Write]:
        return notice("jobs", on_server=self._store.database.is_server)

    def _is_orphaned(self, *, own: bool) -> sa.ColumnElement[bool]:
        j = t.jobs.c
        mine = j.worker_id == self._worker_id
        gone = mine if own else ~mine & ~is_alive(j.worker_id, self._store)
        return j.state.in_(UNFINISHED) & gone

    def _is_overdue(self) -> sa.ColumnElement[bool]:
        j = t.jobs.c
        waits = (j.state == JobState.QUEUED.value) & (j.portable == 1)
        late = j.created_us < clock_of(self._store) - OVERDUE_US
        return waits & late & (j.worker_id != self._worker_id)

    async def _ids(self, condition: sa.ColumnElement[bool]) -> list[str]:
        j = t.jobs.c
        query = sa.select(j.job_id).where(condition).order_by(j.created_us, j.job_id).limit(100)
        return [row["job_id"] for row in await self._store.read(query)]

    async def remove(self, job_id: str) -> None:
        """Delete a job."""
        await self._store.write(Write(sa.delete(t.jobs).where(t.jobs.c.job_id == job_id)))

    async def get(self, job_id: str) -> JobInfo | None:
        """The job with this id, or None."""
        rows = await self._select(t.jobs.c.job_id == job_id, limit=1)
        return rows[0] if rows else None

    async def newest(self, *, subject: str | None, limit: int) -> list[JobInfo]:
        """Jobs, newest first."""
        everything = sa.true() if subject is None else t.jobs.c.subject == subject
        return await self._select(everything, limit=limit)

    async def count(self) -> int:
        """Number of stored jobs."""
        rows = await self._store.read(sa.select(sa.func.count().label("jobs")).select_from(t.jobs))
        return int(rows[0]["jobs"])

    async def ended_before(self, created_us: int, *, limit: int = 100) -> list[str]:
        """Ids of this worker's finished jobs created before a time."""
        mine = (t.jobs.c.worker_id == self._worker_id) & ~t.jobs.c.state.in_(UNFINISHED)
        query = sa.select(t.jobs.c.job_id).where(mine & (t.jobs.c.created_us < created_us))
        return [row["job_id"] for row in await self._store.read(query.limit(limit))]

    async def _select(self, condition: sa.ColumnElement[bool], *, limit: int) -> list[JobInfo]:
        query = sa.select(t.jobs.c.document).where(condition)
        query = query.order_by(t.jobs.c.created_us.desc(), t.jobs.c.job_id).limit(limit)
        rows = await self._store.read(query)
        return [JobInfo.model_validate_json(row["document"]) for row in rows]


def _row(job: JobInfo) -> dict[str, Any]:
    return {
        "job_id": job.job_id,
        "kind": job.kind,
        "subject": job.subject,
        "state": job.state.value,
        "document": job.model_dump_json(),
    }
