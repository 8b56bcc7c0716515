"""Jobs in the store: a row each, rewritten when a job changes state."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from real2sim_proto.jobs import JobInfo, JobState

from . import tables as t
from .store import Store, StoredReply, Write, now_us

UNFINISHED = (JobState.QUEUED.value, JobState.RUNNING.value)


class JobLog:
    """Jobs beyond the life of the process.

    Args:
        store: open while this is used.
        worker_id: whose jobs they are.
    """

    def __init__(self, store: Store, worker_id: str) -> None:
        self._store = store
        self._worker_id = worker_id

    async def add(self, job: JobInfo, *, reply: StoredReply | None) -> None:
        """Put a new job on record, with the answer to the request for it."""
        row = _row(job) | {"worker_id": self._worker_id, "created_us": now_us()}
        await self._store.write(Write(sa.insert(t.jobs), [row]), reply=reply)

    async def update(self, job: JobInfo) -> None:
        """Keep what the job is now."""
        change = sa.update(t.jobs).where(t.jobs.c.job_id == job.job_id).values(_row(job))
        await self._store.write(Write(change))

    async def remove(self, job_id: str) -> None:
        """Forget a job."""
        await self._store.write(Write(sa.delete(t.jobs).where(t.jobs.c.job_id == job_id)))

    async def get(self, job_id: str) -> JobInfo | None:
        """The job of that id."""
        rows = await self._select(t.jobs.c.job_id == job_id, limit=1)
        return rows[0] if rows else None

    async def newest(self, *, subject: str | None, limit: int) -> list[JobInfo]:
        """Jobs, newest first."""
        everything = sa.true() if subject is None else t.jobs.c.subject == subject
        return await self._select(everything, limit=limit)

    async def count(self) -> int:
        """Jobs on record."""
        rows = await self._store.read(sa.select(sa.func.count().label("jobs")).select_from(t.jobs))
        return int(rows[0]["jobs"])

    async def unfinished(self) -> list[JobInfo]:
        """Jobs that this worker has not ended."""
        own = t.jobs.c.worker_id == self._worker_id
        return await self._select(own & t.jobs.c.state.in_(UNFINISHED), limit=100_000)

    async def ended_before(self, created_us: int, *, limit: int = 100) -> list[str]:
        """Ids of ended jobs of this worker that were begun before."""
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
