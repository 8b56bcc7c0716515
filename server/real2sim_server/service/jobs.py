"""Background jobs with progress, cancellation and stored results."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import shutil
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from real2sim_proto import ErrorCode, Problem
from real2sim_proto.jobs import JobFile, JobInfo, JobKind, JobState

from .accounts import ACCOUNT, owner_name
from .clock import now_us
from .http.requests import IdempotentRequest
from .http.responses import ServiceError, problem_of, service_error
from .library.scenes import Quota
from .scenario_cache import iso_time
from .storage.job_log import ClaimedJob, JobLog
from .storage.store import FencedError, StoreError, StoreTroubleError

# --- Ends of jobs --------------------------------------------------------------------------------


def ended(info: JobInfo, state: JobState, *, error: Problem | None = None) -> JobInfo:
    """The job record in its final state."""
    return info.model_copy(
        update={"state": state, "finished_at": iso_time(now_us()), "error": error}
    )


def interruption() -> Problem:
    """The error of a job whose worker stopped."""
    failure = ServiceError(
        ErrorCode.DRAINING, "the worker stopped before this job was done", hint="start it again"
    )
    return problem_of(failure, path="", request_id=None)


def too_many_deaths(deaths: int) -> Problem:
    """The error of a job during which ``deaths`` workers died."""
    failure = ServiceError(
        ErrorCode.JOB_FAILED,
        f"{deaths} workers died while they ran this job; it is not started again",
        hint="check the workers' logs, and split the job into smaller ones",
    )
    return problem_of(failure, path="", request_id=None)


MAX_QUEUED_JOBS = 32
"""Maximum number of waiting jobs; more are refused."""

MAX_EVENTS = 256
"""Events kept per job for clients that reconnect."""

UNKNOWN_EVENTS = 1_000_000
"""Increment of the event number when a job is taken over; it must exceed every number that was sent
but not stored."""

STORE_RETRY_S = 1.0
"""Interval between attempts to store a job's state while the store fails [s]."""

POLL_S = 1.0
"""Interval between polls for orphaned jobs and for cancellations of own jobs [s]."""

FOLLOW_S = 0.5
"""Interval between polls of a job that another worker runs [s]."""

MAX_DEATHS = 3
"""Number of workers that may die during a job before the job fails."""

MAX_FINISHED_JOBS = 64
"""Finished jobs kept in memory; older ones are read from the store."""

CONCURRENCY = {"physics": 1, "exports": 2, "drives": 8, "sweeps": 1}
"""Queues and how many of their jobs run at once. Physics uses all cores."""

QUEUE_OF: Mapping[str, str] = {
    "load_scene": "physics",
    "simulate": "physics",
    "calibrate": "physics",
    "export": "exports",
    "drive": "drives",
    "sweep": "sweeps",
}

log = structlog.get_logger(__name__)


class JobCancelled(Exception):
    """The job was cancelled; raised inside its work."""


@dataclass(frozen=True)
class JobResult:
    """The result of a job.

    Attributes:
        values: JSON values for the job's record.
        files: media types by file name, relative to the job's folder.
    """

    values: dict[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


class JobContext:
    """Lets the work of a job report progress and notice cancellation. Thread-safe."""

    def __init__(self, folder: Path, report: Callable[[float, str], None]) -> None:
        self.folder = folder
        self._report = report
        self._cancelled = threading.Event()

    def progress(self, share: float, stage: str = "") -> None:
        """Report progress from 0 to 1 and the current stage.

        Raises:
            JobCancelled: the job was cancelled.
        """
        self.check()
        self._report(min(1.0, max(0.0, share)), stage)

    def cancelled(self) -> bool:
        """Whether the job was cancelled."""
        return self._cancelled.is_set()

    def check(self) -> None:
        """Raise JobCancelled if the job was cancelled."""
        if self._cancelled.is_set():
            raise JobCancelled

    def cancel(self) -> None:
        """Request the work to end."""
        self._cancelled.set()


Work = Callable[[JobContext], Awaitable[JobResult]]

Rebuild = Callable[[JobInfo], Awaitable[Work]]
"""Creates the work of a job from its record, on any worker."""


@dataclass(eq=False)
class _Job:
    info: JobInfo
    context: JobContext
    work: Work
    epoch: int = 0
    portable: bool = False
    lost: bool = False
    stored_event: int = 0
    task: asyncio.Task[None] | None = None
    events: deque[JobInfo] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    changed: asyncio.Condition = field(default_factory=asyncio.Condition)


@dataclass(frozen=True)
class NewJob:
    """A job to start.

    Attributes:
        kind: kind of the job.
        subject: scene, session or sweep that it works on.
        request: body of the request, stored with the job.
        who: end user named by the client.
        light: whether it starts immediately, without a queue.
        portable: any worker can rebuild its work from the record, see ``Jobs.rebuild``.
    """

    kind: JobKind
    subject: str
    request: Mapping[str, Any] = field(default_factory=dict)
    who: str = ""
    light: bool = False
    portable: bool = False


class Jobs:
    """All jobs of a worker. Use on the event loop only.

    Heavy jobs wait in a queue per kind of work, see ``CONCURRENCY``. Light jobs start at once.

    Args:
        job_log: stores the jobs.
        quota: limits of jobs and their files; each job has a subfolder in its folder.
        on_end: called with the kind and the final state of each job.

    Attributes:
        rebuild: creates the work of a portable job from its record.
        fetch: downloads the files of another worker's job; returns whether it succeeded.
        listen: returns a sleep function that wakes early when another worker writes.
        on_forget: called with the id of each forgotten job.
    """

    def __init__(
        self, job_log: JobLog, quota: Quota, *, on_end: Callable[[str, str], None] | None = None
    ) -> None:
        self._log = job_log
        self._on_end = on_end
        self._quota = quota
        self._folder = quota.folder
        self._jobs: OrderedDict[str, _Job] = OrderedDict()
        self._slots = {queue: asyncio.Semaphore(many) for queue, many in CONCURRENCY.items()}
        self._closing = False
        self.rebuild: Rebuild | None = None
        self.fetch: Callable[[str], Awaitable[bool]] | None = None
        self.listen: Callable[[], Callable[[float], Awaitable[None]]] = lambda: asyncio.sleep
        self.on_forget: Callable[[str], Awaitable[None]] | None = None

    @property
    def quota(self) -> Quota:
        """Limits of jobs and their files."""
        return self._quota

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Jobs]:
        """Resume unfinished jobs of earlier runs and dead workers while the context is open.

        Jobs that cannot be resumed are marked as interrupted. On exit, see :meth:`leave`.
        """
        await self._take_over_own()
        supervisor = asyncio.create_task(self._supervise(), name="jobs")
        try:
            yield self
        finally:
            self._closing = True
            supervisor.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await supervisor
            await self.leave()

    async def leave(self) -> None:
        """Stop all jobs. Portable ones go back to the queue, others are marked as interrupted."""
        self._closing = True
        tasks = [job.task for job in self._jobs.values() if job.task and not job.task.done()]
        for job in self._jobs.values():
            job.context.cancel()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def unfinished(self) -> Counter[str]:
        """Number of unfinished jobs by owner."""
        return Counter(job.info.owner for job in self._jobs.values() if not job.info.over)

    # --- life -------------------------------------------------------------------------------

    async def start(
        self, new: NewJob, work: Work, *, idempotent: IdempotentRequest | None = None
    ) -> JobInfo:
        """Store a job and start it.

        Args:
            new: the job.
            work: coroutine function that runs on the event loop; it moves computation to threads.
            idempotent: key under which the reply is stored.

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
        account = ACCOUNT.get()
        if account is not None:
            account.check_jobs(self.unfinished()[account.name])
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
            worker=self._log.worker_id,
            request=dict(new.request),
            created_at=iso_time(now_us()),
        )
        reply = (
            idempotent.reply(info, status=202, headers=accepted_headers(info))
            if idempotent
            else None
        )
        portable = new.portable and self.rebuild is not None
        await self._log.add(info, reply=reply, portable=portable)
        job = self._hold(info, work, portable=portable)
        await self._begin(job, light=new.light)
        return info

    async def cancel(self, job_id: str) -> JobInfo | None:
        """Cancel an unfinished job, or forget a finished one.

        Returns:
            The job as it is now; None if forgotten.

        Raises:
            ServiceError: UNKNOWN_JOB.
        """
        info = await self.get(job_id)
        job = self._jobs.get(job_id)
        if job is None and not info.over:
            await self._log.request_cancel(job_id)
            return await self.wait(job_id, 3 * POLL_S)
        if job is None or info.over:
            self._jobs.pop(job_id, None)
            await self._log.remove(job_id)
            if self.on_forget is not None:
                await self.on_forget(job_id)
            await asyncio.to_thread(shutil.rmtree, self._folder / job_id, ignore_errors=True)
            return None
        self._cancel(job)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(2.0):
                await self._wait_until_over(job)
        return job.info

    async def get(self, job_id: str) -> JobInfo:
        """The current record of a job. Raises ServiceError: UNKNOWN_JOB."""
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
        """A file of a job's result. Raises ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, NOT_FOUND."""
        info = await self.get(job_id)
        require_success(info)
        await self.bring_files(info)
        for file in info.files:
            if file.name == name and (path := self._folder / job_id / name).is_file():
                return path, file
            if file.name == name:
                raise ServiceError(
                    ErrorCode.NOT_FOUND,
                    f"{name!r} of job {job_id!r} is stored by worker {info.worker!r}",
                    hint="request it from that worker",
                )
        names = ", ".join(f.name for f in info.files) or "none"
        raise ServiceError(
            ErrorCode.NOT_FOUND, f"job {job_id!r} has no file {name!r}; it has: {names}"
        )

    async def bring_files(self, info: JobInfo) -> None:
        """Fetch the files of another worker's job, if workers share files."""
        here = (self._folder / info.job_id).is_dir()
        if not here and info.files and self.fetch is not None:
            await self.fetch(info.job_id)

    async def wait(self, job_id: str, seconds: float) -> JobInfo:
        """Wait up to ``seconds`` for a job to finish. Raises ServiceError: UNKNOWN_JOB."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                if (job := self._jobs.get(job_id)) is not None:
                    await self._wait_until_over(job)
                pause = self.listen()
                while not (await self.get(job_id)).over:
                    await pause(FOLLOW_S)
        return await self.get(job_id)

    async def events(self, job_id: str, *, after: int) -> AsyncIterator[JobInfo]:
        """Records of a job with event numbers above ``after``, until it finishes.

        Raises:
            ServiceError: UNKNOWN_JOB.
        """
        pause = self.listen()
        while True:
            if (job := self._jobs.get(job_id)) is None:
                # The job is finished, or another worker runs it.
                events = [await self.get(job_id)]
                over = events[0].over
                await pause(0 if over else FOLLOW_S)
            else:
                await _next_event(job, after)
                events, over = list(job.events), job.info.over
            for event in [e for e in events if e.event > after]:
                after = event.event
                yield event
            if over and events[-1].event <= after:
                return

    async def forget_before(self, created_us: int) -> int:
        """Forget finished jobs created before a time, with their files; returns their number."""
        forgotten = 0
        while found := await self._log.ended_before(created_us):
            for job_id in found:
                await self.cancel(job_id)
            forgotten += len(found)
        return forgotten

    # --- inside -----------------------------------------------------------------------------

    async def _supervise(self) -> None:
        pause = self.listen()
        while not self._closing:
            await pause(POLL_S)
            try:
                await self._poll_own()
                while (claimed := await self._log.claim_orphaned()) is not None:
                    await self._resume_fenced(claimed)
                kinds = [kind for kind, queue in QUEUE_OF.items() if self._has_room(queue)]
                # Claim one at a time and leave the others to other idle workers.
                if kinds and (claimed := await self._log.claim_overdue(kinds)) is not None:
                    await self._resume_fenced(claimed)
            except StoreError:
                continue  # the store logs its own errors
            except Exception:
                log.exception("supervising jobs failed")

    async def _poll_own(self) -> None:
        """Apply cancellations from other workers, release lost jobs and store progress."""
        held = {key: job for key, job in self._jobs.items() if not (job.info.over or job.lost)}
        if not held:
            return
        epochs = {key: job.epoch for key, job in held.items()}
        cancelled, lost = await self._log.cancelled_or_lost(epochs)
        for job_id in cancelled:
            self._cancel(held[job_id])
        for job_id in lost:
            await self._release(held[job_id])
        for job in held.values():
            if job.info.state is JobState.RUNNING and job.info.event > job.stored_event:
                info = job.info
                await self._log.update_progress(info, epoch=job.epoch)
                job.stored_event = info.event

    async def _take_over_own(self) -> None:
        for job_id in await self._log.orphaned(own=True):
            if (claimed := await self._log.claim(job_id, own=True)) is not None:
                await self._resume_fenced(claimed)

    async def _resume_fenced(self, claimed: ClaimedJob) -> None:
        with contextlib.suppress(FencedError):
            await self._resume(claimed)

    async def _resume(self, claimed: ClaimedJob) -> None:
        """Restart a claimed job, or store the reason for its end."""
        newest = {"event": claimed.info.event + UNKNOWN_EVENTS, "attempt": claimed.deaths + 1}
        info = claimed.info.model_copy(update=newest | {"worker": self._log.worker_id})
        again = self.rebuild
        if claimed.cancelled:
            last = ended(info, JobState.CANCELLED)
        elif claimed.deaths >= MAX_DEATHS:
            last = ended(info, JobState.FAILED, error=too_many_deaths(claimed.deaths))
        elif not claimed.portable or again is None:
            last = ended(info, JobState.INTERRUPTED, error=interruption())
        else:
            log.warning("job taken over", job_id=info.job_id, kind=info.kind, deaths=claimed.deaths)
            await self._restart(info, again, claimed.epoch)
            return
        await self._log.update(last, epoch=claimed.epoch)
        await asyncio.to_thread(shutil.rmtree, self._folder / info.job_id, ignore_errors=True)
        log.warning("orphaned job ended", job_id=info.job_id, state=last.state.value)

    async def _restart(self, info: JobInfo, again: Rebuild, epoch: int) -> None:
        begun = {"state": JobState.QUEUED, "progress": 0.0, "stage": "", "started_at": None}
        info = info.model_copy(update=begun)

        async def work(context: JobContext) -> JobResult:
            return await (await again(info))(context)

        await self._log.update(info, epoch=epoch)
        job = self._hold(info, work, epoch=epoch, portable=True)
        await self._begin(job, light=False)

    async def _begin(self, job: _Job, *, light: bool) -> None:
        running = self._run(job, light=light)
        job.task = asyncio.create_task(running, name=job.info.job_id)
        # A task that is cancelled before its first step would never store the job's end.
        await asyncio.sleep(0)

    def _has_room(self, queue: str) -> bool:
        return not self._slots[queue].locked()

    def _cancel(self, job: _Job) -> None:
        job.context.cancel()
        if job.info.state is JobState.QUEUED and job.task:
            job.task.cancel()

    async def _release(self, job: _Job) -> None:
        """Stop a job that another worker has taken over; its readers follow the stored record."""
        log.warning("job taken over by another worker", job_id=job.info.job_id)
        job.lost = True
        job.context.cancel()
        if job.task is not None and job.task is not asyncio.current_task():
            job.task.cancel()
        if self._jobs.get(job.info.job_id) is job:
            del self._jobs[job.info.job_id]
        await _notify_readers(job)

    def _hold(self, info: JobInfo, work: Work, *, epoch: int = 0, portable: bool = False) -> _Job:
        loop = asyncio.get_running_loop()

        def report(share: float, stage: str) -> None:
            loop.call_soon_threadsafe(self._report, job, share, stage)

        context = JobContext(self._folder / info.job_id, report)
        job = _Job(info, context, work, epoch=epoch, portable=portable)
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
                async with self._slots[QUEUE_OF[job.info.kind]]:
                    await self._work(job)
        except asyncio.CancelledError:
            # The job was cancelled in the queue or taken over, or the worker stops.
            if job.lost:
                return
            if self._closing and job.portable:
                await asyncio.shield(self._leave(job))
                return
            state = JobState.INTERRUPTED if self._closing else JobState.CANCELLED
            error = interruption() if self._closing else None
            with contextlib.suppress(FencedError):
                await asyncio.shield(self._become(job, ended(job.info, state, error=error)))
        except FencedError:
            await self._release(job)

    async def _leave(self, job: _Job) -> None:
        """Put a job back in the queue for another worker or the next run."""
        waits = {"state": JobState.QUEUED, "stage": "", "started_at": None}
        with contextlib.suppress(FencedError):
            await self._become(job, job.info.model_copy(update=waits))

    async def _work(self, job: _Job) -> None:
        started = {"state": JobState.RUNNING, "started_at": iso_time(now_us())}
        await self._become(job, job.info.model_copy(update=started))
        try:
            job.context.check()
            result = await job.work(job.context)
            files = await asyncio.to_thread(_files, job.context.folder, result.files)
            done = {"result": result.values, "files": files, "progress": 1.0, "stage": ""}
            last = ended(job.info.model_copy(update=done), JobState.SUCCEEDED)
        except JobCancelled:
            last = ended(job.info, JobState.CANCELLED)
        except Exception as error:
            failure = service_error(error)
            if failure.status == 500:
                log.error("job failed", job_id=job.info.job_id, exc_info=error)
            problem = problem_of(failure, path=f"/v1/jobs/{job.info.job_id}", request_id=None)
            last = ended(job.info, JobState.FAILED, error=problem)
        if last.state is not JobState.SUCCEEDED:
            await asyncio.to_thread(shutil.rmtree, job.context.folder, ignore_errors=True)
        await self._become(job, last)

    async def _become(self, job: _Job, info: JobInfo) -> None:
        info = info.model_copy(update={"event": job.info.event + 1})
        # Store before publishing: states that clients have seen must survive a crash.
        while True:
            try:
                await self._log.update(info, epoch=job.epoch)
                break
            except StoreTroubleError as error:
                if self._closing:
                    # The next run finds the job unfinished and marks it.
                    log.error("job not stored", job_id=info.job_id, reason=error.reason)
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
            await job.changed.wait_for(lambda: job.info.over or job.lost)


async def _next_event(job: _Job, after: int) -> None:
    """Wait for an event with a number above ``after``, or until the job's events end here."""
    async with job.changed:
        await job.changed.wait_for(lambda: job.info.event > after or job.info.over or job.lost)


async def _notify_readers(job: _Job) -> None:
    async with job.changed:
        job.changed.notify_all()


def accepted_headers(info: JobInfo) -> dict[str, str]:
    """Headers of the reply that starts a job."""
    return {"Location": f"/v1/jobs/{info.job_id}"}


def require_success(info: JobInfo) -> None:
    """Check that a job succeeded.

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


def _files(folder: Path, names: Mapping[str, str]) -> list[JobFile]:
    return [
        JobFile(name=name, media_type=media_type, bytes=(folder / name).stat().st_size)
        for name, media_type in names.items()
    ]
