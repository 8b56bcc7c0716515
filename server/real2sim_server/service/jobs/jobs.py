"""Long work: it answers at once, reports as it goes, can be cancelled, and keeps its result."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import secrets
import shutil
import threading
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from real2sim_proto import ErrorCode, Problem
from real2sim_proto.jobs import JobFile, JobInfo, JobKind, JobState

from ..accounts import PAYER, Payer, owner_name
from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError, problem_of, service_error
from ..library.quotas import Quota
from ..scenarios.replies import iso_time
from ..storage.job_log import JobLog
from ..storage.store import StoreTroubleError, now_us

MAX_QUEUED_JOBS = 32
"""Jobs that may wait for their turn; more are refused."""

MAX_EVENTS = 256
"""Of one job, for readers that come back; older progress is of no use to anybody."""

UNKNOWN_EVENTS = 1_000_000
"""More events than a job has: its end is newer than any progress that was sent but not stored."""

STORE_RETRY_S = 1.0
"""Between tries to put on record what has become of a job, while the store is in trouble."""

MAX_FINISHED_JOBS = 64
"""Ended jobs in memory; others are read from the store."""

JOBS_AT_A_TIME = {"physics": 1, "exports": 2, "drives": 8}
"""Lanes. Physics takes all cores; a video, a data set or a planner waits for none of it."""

LANE_OF: Mapping[str, str] = {
    "load_scene": "physics",
    "simulate": "physics",
    "calibrate": "physics",
    "export": "exports",
    "drive": "drives",
}

log = structlog.get_logger(__name__)


class JobCancelled(Exception):
    """The job was cancelled; raised inside its work."""


@dataclass(frozen=True)
class JobResult:
    """What a job leaves.

    Attributes:
        values: JSON values for its record.
        files: names in its folder, with their media types.
    """

    values: dict[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


class JobContext:
    """A job as its work sees it; safe to use on any thread."""

    def __init__(self, folder: Path, report: Callable[[float, str], None]) -> None:
        self.folder = folder
        self._report = report
        self._cancelled = threading.Event()

    def progress(self, share: float, stage: str = "") -> None:
        """Say how far it is, 0 to 1, and what it is doing.

        Raises:
            JobCancelled: the job was cancelled.
        """
        self.check()
        self._report(min(1.0, max(0.0, share)), stage)

    def cancelled(self) -> bool:
        """Whether the job was cancelled."""
        return self._cancelled.is_set()

    def check(self) -> None:
        """Raises JobCancelled once the job is cancelled."""
        if self._cancelled.is_set():
            raise JobCancelled

    def cancel(self) -> None:
        """Ask the work to end."""
        self._cancelled.set()


Work = Callable[[JobContext], Awaitable[JobResult]]


@dataclass(eq=False)
class _Job:
    info: JobInfo
    context: JobContext
    work: Work
    task: asyncio.Task[None] | None = None
    events: deque[JobInfo] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    changed: asyncio.Condition = field(default_factory=asyncio.Condition)


@dataclass(frozen=True)
class NewJob:
    """What a job is asked to do."""

    kind: JobKind
    subject: str
    request: Mapping[str, Any] = field(default_factory=dict)
    who: str = ""
    light: bool = False


class Jobs:
    """All jobs of a worker. Belongs to the event loop.

    Heavy jobs run in the order they came, as many of a lane at a time as ``JOBS_AT_A_TIME`` says,
    beside those of other lanes; light ones at once.

    Args:
        job_log: keeps them.
        quota: of jobs and their files; below its folder each job has one for its files.
        on_end: told the kind and the last state of each job.
    """

    def __init__(
        self, job_log: JobLog, quota: Quota, *, on_end: Callable[[str, str], None] | None = None
    ) -> None:
        self._log = job_log
        self._on_end = on_end
        self._quota = quota
        self._folder = quota.folder
        self._jobs: OrderedDict[str, _Job] = OrderedDict()
        self._turns = {lane: asyncio.Semaphore(many) for lane, many in JOBS_AT_A_TIME.items()}
        self._closing = False

    @property
    def quota(self) -> Quota:
        """Of jobs and their files."""
        return self._quota

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Jobs]:
        """Marks what an earlier run left unfinished; cancels what is unfinished at the end."""
        for info in await self._log.unfinished():
            ended = _ended(info, JobState.INTERRUPTED, error=_interruption())
            newest = {"event": info.event + UNKNOWN_EVENTS}
            await self._log.update(ended.model_copy(update=newest))
            folder = self._folder / info.job_id
            await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
            log.warning("job interrupted", job_id=info.job_id, kind=info.kind)
        try:
            yield self
        finally:
            self._closing = True
            tasks = [job.task for job in self._jobs.values() if job.task and not job.task.done()]
            for job in self._jobs.values():
                job.context.cancel()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    # --- life -------------------------------------------------------------------------------

    async def start(
        self, new: NewJob, work: Work, *, idempotent: IdempotentRequest | None = None
    ) -> JobInfo:
        """Put a job on record and let it run.

        Args:
            new: what it is.
            work: called on the event loop; hands what computes to threads.
            idempotent: what the answer is stored under.

        Raises:
            ServiceError: QUEUE_FULL, QUOTA_EXCEEDED, or DRAINING.
        """
        if self._closing:
            raise ServiceError(ErrorCode.DRAINING, "the worker is stopping")
        waiting = sum(job.info.state is JobState.QUEUED for job in self._jobs.values())
        if waiting >= MAX_QUEUED_JOBS and not new.light:
            raise ServiceError(
                ErrorCode.QUEUE_FULL,
                f"{waiting} jobs wait already",
                hint="send it again after Retry-After seconds, or cancel one: DELETE /v1/jobs/{id}",
            )
        if not new.light:
            stored = await self._log.count()
            await asyncio.to_thread(self._quota.check, entries=stored)
        info = JobInfo(
            job_id=f"job_{secrets.token_hex(8)}",
            kind=new.kind,
            subject=new.subject,
            state=JobState.QUEUED,
            event=1,
            who=new.who,
            owner=owner_name(),
            request=dict(new.request),
            created_at=iso_time(now_us()),
        )
        reply = (
            idempotent.reply(info, status=202, headers=accepted_headers(info))
            if idempotent
            else None
        )
        await self._log.add(info, reply=reply)
        job = self._hold(info, work)
        job.task = asyncio.create_task(
            self._run(job, light=new.light), name=info.job_id, context=_waiting_context()
        )
        return info

    async def cancel(self, job_id: str) -> JobInfo | None:
        """End a job that is not over, or forget one that is; what it is now, None if forgotten.

        Raises:
            ServiceError: UNKNOWN_JOB.
        """
        info = await self.get(job_id)
        job = self._jobs.get(job_id)
        if info.over or job is None:
            self._jobs.pop(job_id, None)
            await self._log.remove(job_id)
            await asyncio.to_thread(shutil.rmtree, self._folder / job_id, ignore_errors=True)
            return None
        job.context.cancel()
        if job.info.state is JobState.QUEUED and job.task:
            job.task.cancel()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(2.0):
                await self._wait_until_over(job)
        return job.info

    async def get(self, job_id: str) -> JobInfo:
        """The job as it is now. Raises ServiceError: UNKNOWN_JOB."""
        if (job := self._jobs.get(job_id)) is not None:
            return job.info
        if (info := await self._log.get(job_id)) is not None:
            return info
        raise ServiceError(
            ErrorCode.UNKNOWN_JOB, f"no job {job_id!r}", hint="GET /v1/jobs lists them"
        )

    async def list(self, *, subject: str | None = None, limit: int = 100) -> list[JobInfo]:
        """Jobs, newest first."""
        stored = await self._log.newest(subject=subject, limit=limit)
        current = {job_id: job.info for job_id, job in self._jobs.items()}
        return [current.get(info.job_id, info) for info in stored]

    async def file(self, job_id: str, name: str) -> tuple[Path, JobFile]:
        """A file that a job left. Raises ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, NOT_FOUND."""
        info = await self.get(job_id)
        require_success(info)
        for file in info.files:
            if file.name == name and (path := self._folder / job_id / name).is_file():
                return path, file
        names = ", ".join(f.name for f in info.files) or "none"
        raise ServiceError(
            ErrorCode.NOT_FOUND, f"job {job_id!r} left no {name!r}; it left: {names}"
        )

    async def wait(self, job_id: str, seconds: float) -> JobInfo:
        """The job when it is over, or after ``seconds``. Raises ServiceError: UNKNOWN_JOB."""
        job = self._jobs.get(job_id)
        if job is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._wait_until_over(job)
        return await self.get(job_id)

    async def events(self, job_id: str, *, after: int) -> AsyncIterator[JobInfo]:
        """What the job becomes, from behind event ``after`` to its end.

        Raises:
            ServiceError: UNKNOWN_JOB.
        """
        job = self._jobs.get(job_id)
        if job is None:
            info = await self.get(job_id)
            if info.event > after:
                yield info
            return
        while True:
            async with job.changed:
                await job.changed.wait_for(
                    lambda seen=after: job.info.event > seen or job.info.over  # type: ignore[misc]
                )
            for event in [e for e in job.events if e.event > after]:
                after = event.event
                yield event
            if job.info.over and job.info.event <= after:
                return

    async def forget_before(self, created_us: int) -> int:
        """Forget ended jobs that were begun before, with their files; how many."""
        forgotten = 0
        while found := await self._log.ended_before(created_us):
            for job_id in found:
                await self.cancel(job_id)
            forgotten += len(found)
        return forgotten

    # --- inside -----------------------------------------------------------------------------

    def _hold(self, info: JobInfo, work: Work) -> _Job:
        loop = asyncio.get_running_loop()

        def report(share: float, stage: str) -> None:
            loop.call_soon_threadsafe(self._report, job, share, stage)

        job = _Job(info, JobContext(self._folder / info.job_id, report), work)
        job.events.append(info)
        self._jobs[info.job_id] = job
        over = [key for key, other in self._jobs.items() if other.info.over]
        for key in over[: max(0, len(over) - MAX_FINISHED_JOBS)]:
            del self._jobs[key]
        return job

    async def _run(self, job: _Job, *, light: bool) -> None:
        try:
            if light:
                await self._work(job)
            else:
                async with self._turns[LANE_OF[job.info.kind]]:
                    await self._work(job)
        except asyncio.CancelledError:
            # Cancelled while it waited for its turn, or the worker stops.
            state = JobState.INTERRUPTED if self._closing else JobState.CANCELLED
            error = _interruption() if self._closing else None
            await asyncio.shield(self._become(job, _ended(job.info, state, error=error)))

    async def _work(self, job: _Job) -> None:
        started = {"state": JobState.RUNNING, "started_at": iso_time(now_us())}
        await self._become(job, job.info.model_copy(update=started))
        try:
            job.context.check()
            result = await job.work(job.context)
            files = await asyncio.to_thread(_files, job.context.folder, result.files)
            done = {"result": result.values, "files": files, "progress": 1.0, "stage": ""}
            ended = _ended(job.info.model_copy(update=done), JobState.SUCCEEDED)
        except JobCancelled:
            ended = _ended(job.info, JobState.CANCELLED)
        except Exception as error:
            failure = service_error(error)
            if failure.status == 500:
                log.error("job failed", job_id=job.info.job_id, exc_info=error)
            problem = problem_of(failure, path=f"/v1/jobs/{job.info.job_id}", request_id=None)
            ended = _ended(job.info, JobState.FAILED, error=problem)
        if ended.state is not JobState.SUCCEEDED:
            await asyncio.to_thread(shutil.rmtree, job.context.folder, ignore_errors=True)
        await self._become(job, ended)

    async def _become(self, job: _Job, info: JobInfo) -> None:
        info = info.model_copy(update={"event": job.info.event + 1})
        # Stored first: what a client was sent is true after a crash as well.
        while True:
            try:
                await self._log.update(info)
                break
            except StoreTroubleError as error:
                if self._closing:
                    # The next run finds it unfinished, and says so.
                    log.error("job not on record", job_id=info.job_id, reason=error.reason)
                    break
                await asyncio.sleep(STORE_RETRY_S)
        job.info = info
        job.events.append(info)
        if info.over and self._on_end is not None:
            self._on_end(info.kind, info.state.value)
        async with job.changed:
            job.changed.notify_all()

    def _report(self, job: _Job, share: float, stage: str) -> None:
        now = job.info
        if now.over or (round(share, 2) == round(now.progress, 2) and stage == now.stage):
            return
        moved = {"progress": share, "stage": stage, "event": now.event + 1}
        job.info = now.model_copy(update=moved)
        job.events.append(job.info)
        asyncio.ensure_future(_notify_readers(job))  # noqa: RUF006, ends as soon as the readers are woken

    async def _wait_until_over(self, job: _Job) -> None:
        async with job.changed:
            await job.changed.wait_for(lambda: job.info.over)


async def _notify_readers(job: _Job) -> None:
    async with job.changed:
        job.changed.notify_all()


def _waiting_context() -> contextvars.Context:
    """That of the caller, whose account the job waits for: nobody else can send it again."""
    context = contextvars.copy_context()
    payer = PAYER.get()
    if payer is not None:
        context.run(PAYER.set, Payer(payer.account, waits=True))
    return context


def accepted_headers(info: JobInfo) -> dict[str, str]:
    """Headers of the answer that starts a job."""
    return {"Location": f"/v1/jobs/{info.job_id}"}


def require_success(info: JobInfo) -> None:
    """Refuse what needs a job's result while there is none.

    Raises:
        ServiceError: JOB_NOT_DONE or JOB_FAILED.
    """
    if info.state is JobState.SUCCEEDED:
        return
    if info.over:
        raise ServiceError(
            ErrorCode.JOB_FAILED,
            f"job {info.job_id!r} has no result: it is {info.state.value}",
            hint="start it again",
        )
    raise ServiceError(
        ErrorCode.JOB_NOT_DONE,
        f"job {info.job_id!r} is {info.state.value}, {info.progress:.0%} done",
        hint=f"follow GET /v1/jobs/{info.job_id}/events",
    )


def _ended(info: JobInfo, state: JobState, *, error: Problem | None = None) -> JobInfo:
    return info.model_copy(
        update={"state": state, "finished_at": iso_time(now_us()), "error": error}
    )


def _interruption() -> Problem:
    failure = ServiceError(
        ErrorCode.DRAINING, "the worker stopped before this job was done", hint="start it again"
    )
    return problem_of(failure, path="", request_id=None)


def _files(folder: Path, names: Mapping[str, str]) -> list[JobFile]:
    return [
        JobFile(name=name, media_type=media_type, bytes=(folder / name).stat().st_size)
        for name, media_type in names.items()
    ]
