"""Worker threads that run queued jobs by priority: one owns the device, one steps worlds."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import compress
from typing import Any, Generic, TypeVar

import structlog

from . import clock

# --- Queue ---------------------------------------------------------------------------------------


T = TypeVar("T")


class Priority(IntEnum):
    """Priorities of jobs, the most urgent first."""

    DRIVE = 0
    """Steps of sessions: a policy is waiting."""
    VIEW = 1
    """Images for interactive viewers, and other jobs that take milliseconds."""
    BULK = 2
    """Large images, videos, loading of scenes."""


WEIGHTS = {Priority.DRIVE: 16.0, Priority.VIEW: 4.0, Priority.BULK: 1.0}
"""Relative shares of time while every priority has jobs."""


class PriorityQueue(Generic[T]):
    """One first-in, first-out queue per priority, scheduled by weight.

    The next job comes from the priority with the least time per weight so far (stride scheduling,
    Waldspurger & Weihl 1995). An idle priority accumulates no credit. Not thread-safe.

    Args:
        length: maximum number of waiting jobs per priority.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._waiting: dict[Priority, deque[T]] = {priority: deque() for priority in Priority}
        self._running: list[Priority] = []
        self._passed_over = dict.fromkeys(Priority, 0)
        self._had = dict.fromkeys(Priority, 0.0)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def waiting(self, priority: Priority) -> int:
        """Number of waiting jobs of a priority."""
        return len(self._waiting[priority])

    def append(self, job: T, priority: Priority) -> None:
        """Add a job to the end of its queue. The caller checks that there is room."""
        if not self._waiting[priority] and priority not in self._running:
            active = [self._had[other] for other in Priority if self._is_active(other)]
            self._had[priority] = max([self._had[priority], *([min(active)] if active else [])])
        self._waiting[priority].append(job)

    def begin_next(self) -> T | None:
        """Start the next job and return it, or None if none waits. Call :meth:`end` after it."""
        return self._begin(priority for priority in Priority if self._waiting[priority])

    def begin_more_urgent(self) -> T | None:
        """Like :meth:`begin_next`, but only for higher priorities than that of the running job.

        Skips priorities that have used up their share.
        """
        present = self._running[-1]
        return self._begin(
            priority
            for priority in Priority
            if priority < present
            and self._waiting[priority]
            and self._had[priority] <= self._had[present]
        )

    def begin_with(self, joins: Callable[[T], bool]) -> list[T]:
        """Take the jobs that run together with the job started last, in order of arrival.

        Only jobs of the same priority join. They may overtake an earlier job once; after that,
        no later job overtakes it again.

        Args:
            joins: returns whether a waiting job joins; called once per job, in order.
        """
        priority = self._running[-1]
        waiting, passed_over = self._waiting[priority], self._passed_over[priority]
        joined: list[T] = []
        stayed: list[T] = []
        behind = 0
        for place, job in enumerate(waiting):
            if joins(job):
                joined.append(job)
                behind = len(stayed)
            elif place < passed_over:
                behind = passed_over - len(joined)
                break
            else:
                stayed.append(job)
        if joined:
            taken = set(map(id, joined))
            self._waiting[priority] = deque(job for job in waiting if id(job) not in taken)
            self._passed_over[priority] = behind
        return joined

    def charge(self, seconds: float) -> None:
        """Charge time to the priority of the job started last."""
        priority = self._running[-1]
        self._had[priority] += seconds / WEIGHTS[priority]

    def end(self) -> None:
        """Mark the job started last as ended."""
        self._running.pop()

    def discard(self, unwanted: Callable[[T], bool]) -> None:
        """Drop waiting jobs."""
        for priority, jobs in self._waiting.items():
            if any(map(unwanted, jobs)):
                kept = [not unwanted(job) for job in jobs]
                self._passed_over[priority] = sum(kept[: self._passed_over[priority]])
                self._waiting[priority] = deque(compress(jobs, kept))

    def take_all(self) -> list[T]:
        """Remove and return all waiting jobs."""
        jobs = [job for priority in Priority for job in self._waiting[priority]]
        for priority, waiting in self._waiting.items():
            waiting.clear()
            self._passed_over[priority] = 0
        return jobs

    def _is_active(self, priority: Priority) -> bool:
        return bool(self._waiting[priority]) or priority in self._running

    def _begin(self, candidates: Iterable[Priority]) -> T | None:
        priority = min(
            candidates, key=lambda priority: (self._had[priority], priority), default=None
        )
        if priority is None:
            return None
        self._running.append(priority)
        self._passed_over[priority] = max(0, self._passed_over[priority] - 1)
        return self._waiting[priority].popleft()


R = TypeVar("R")

IDLE_TICK_S = 0.25
NICENESS = 3
"""Niceness of the engine thread. Kernels use every core; the event loop must be scheduled first."""
SWITCH_INTERVAL_S = 0.0005
"""Maximum time for which a thread that runs Python code blocks the event loop [s]. Python's default
is 0.005."""

log = structlog.get_logger(__name__)


class EngineError(RuntimeError):
    """The engine cannot accept or finish a job."""


class QueueFullError(EngineError):
    """The queue is full."""


class EngineStoppedError(EngineError):
    """The engine is stopping or was never started."""


class DeviceLostError(EngineError):
    """The device reported an error that only a new process can recover from."""


@dataclass(frozen=True, eq=False)
class Batchable:
    """How a job is batched. Jobs with the same ``compute`` and ``key`` may run in one call.

    Attributes:
        compute: maps arguments to results or exceptions, in the same order.
        argument: argument of this job.
        key: compared by identity.
        share: share of a batch that this job takes; a batch holds at most 1.
    """

    compute: Callable[[Sequence[Any]], Sequence[Any]]
    argument: object
    key: object
    share: float


@dataclass(eq=False)
class _EngineJob:
    run: Callable[[], Any]
    label: str
    future: Future[Any]
    batch: Batchable | None = None
    queued_at: float = field(default_factory=lambda: clock.monotonic())  # noqa: PLW0108
    on_end: Callable[[str, float, float], None] | None = None


class Engine:
    """Runs jobs one after another on a dedicated thread.

    All computation runs here, so kernels never compete for cores and the event loop never waits for
    them. A job is a plain function; its exceptions are raised in the caller. Jobs are scheduled as
    :class:`.PriorityQueue` describes. A long job calls :meth:`yield_to_urgent` between its parts,
    which runs more urgent jobs. Waiting jobs that can be batched run in one call; no job waits for
    a batch to fill.

    Args:
        name: name of the thread.
        queue_length: maximum number of waiting jobs per priority.
        threads: threads of torch and numba, 0 for one per core. None for an engine that runs no
            parallel kernels; its thread keeps its priority.
        on_job: called on the engine thread after each job with its label, the time it waited [s]
            and the time it ran [s].

    Attributes:
        on_failure: called on the engine thread when the device is lost.
        on_queued: called when a job is queued; returns a function that is called like ``on_job``
            after that job, or None.
    """

    def __init__(
        self,
        *,
        name: str = "engine",
        queue_length: int = 64,
        threads: int | None = 0,
        on_job: Callable[[str, float, float], None] | None = None,
    ) -> None:
        self.queue_length = queue_length
        self.on_failure: Callable[[], object] = lambda: None
        self.on_queued: Callable[[], Callable[[str, float, float], None] | None] | None = None
        self._threads = threads
        self._on_job = on_job
        self._jobs: PriorityQueue[_EngineJob] = PriorityQueue(queue_length)
        self._began = 0.0
        self._changed = threading.Condition()
        self._accepting = False
        self._running: str | None = None
        self._last_tick = clock.monotonic()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    # --- lifecycle --------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread and set the thread counts of torch and numba."""
        sys.setswitchinterval(min(SWITCH_INTERVAL_S, sys.getswitchinterval()))
        self._accepting = True
        self._last_tick = clock.monotonic()
        self._thread.start()
        if self._threads is not None:
            self.call_sync(set_thread_counts, self._threads, label="threads")

    def stop(self, *, drain: bool = True, timeout_s: float | None = None) -> None:
        """Refuse new jobs and end the thread. Without ``drain``, waiting jobs are dropped.

        Raises:
            TimeoutError: a job is still running after ``timeout_s``.
        """
        with self._changed:
            self._accepting = False
            dropped = [] if drain else self._jobs.take_all()
            self._changed.notify_all()
        _fail(dropped, EngineStoppedError("the worker stopped before this job's turn"))
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                raise TimeoutError(f"job {self._running!r} still runs after {timeout_s:g} s")

    # --- jobs -------------------------------------------------------------------------------

    async def call(
        self,
        fn: Callable[..., T],
        *args: Any,
        label: str = "work",
        priority: Priority = Priority.VIEW,
        **kwargs: Any,
    ) -> T:
        """Run ``fn(*args, **kwargs)`` on the engine thread and await its result.

        If the awaiting task is cancelled, a waiting job is dropped; a running one finishes and its
        result is discarded.

        Args:
            fn: function to run.
            args, kwargs: its arguments.
            label: name for metrics and messages.
            priority: priority of the job.

        Raises:
            QueueFullError: ``queue_length`` jobs of this priority are waiting.
            EngineStoppedError: the engine is not running, or stopped before the job started.
            DeviceLostError: an earlier job lost the device.
        """
        job = self._submit(lambda: fn(*args, **kwargs), label, priority)
        result: T = await self._outcome(job)
        return result

    async def call_together(
        self,
        compute: Callable[[Sequence[T]], Sequence[R | Exception]],
        argument: T,
        *,
        key: object,
        share: float,
        label: str,
        priority: Priority,
    ) -> R:
        """Await the result of ``compute`` for ``argument``, batched with other waiting calls.

        Waiting calls of the same priority, ``compute`` and ``key`` run in the same batch. A batch
        overtakes each earlier job at most once.

        Args:
            compute: maps arguments to results or exceptions, in the same order.
            argument: argument of this call.
            key: compared by identity.
            share: share of a batch that this call takes, in (0, 1].
            label, priority: as for :meth:`call`.

        Raises:
            QueueFullError, EngineStoppedError, DeviceLostError: as for :meth:`call`.
        """
        batch = Batchable(compute, argument, key, share)
        job = self._submit(lambda: compute([argument])[0], label, priority, batch)
        result: R = await self._outcome(job)
        return result

    def call_sync(
        self,
        fn: Callable[..., T],
        *args: Any,
        label: str = "work",
        timeout_s: float | None = None,
        **kwargs: Any,
    ) -> T:
        """Like :meth:`call`, for callers without an event loop.

        Runs ``fn`` immediately if called on the engine thread.

        Raises:
            TimeoutError: no result after ``timeout_s``.
        """
        if threading.current_thread() is self._thread:
            return fn(*args, **kwargs)
        job = self._submit(lambda: fn(*args, **kwargs), label, Priority.VIEW)
        try:
            result: T = job.future.result(timeout_s)
        except TimeoutError:
            if not job.future.done():
                self._drop(job)
            raise
        return result

    def yield_to_urgent(self) -> None:
        """Run waiting jobs that are more urgent than the current one.

        A long job calls this between its parts. Does nothing on other threads.
        """
        if threading.current_thread() is not self._thread:
            return
        self._charge()
        while (job := self._next_more_urgent()) is not None:
            self._start(job)
            del job
        self._began = clock.monotonic()

    def note_error(self, error: BaseException) -> None:
        """Report an error of work that started here and failed on another thread."""
        if self._failure is None and _loses_device(error):
            self._lose_device(error)

    # --- state ------------------------------------------------------------------------------

    @property
    def alive(self) -> bool:
        """Whether the thread is running and the device works."""
        return self._thread.is_alive() and self._failure is None

    @property
    def failure(self) -> BaseException | None:
        """The error that lost the device, or None."""
        return self._failure

    @property
    def seconds_since_tick(self) -> float:
        """Time since the thread last polled the queue [s]; grows while a job runs."""
        return clock.monotonic() - self._last_tick

    @property
    def queue_depth(self) -> int:
        """Number of waiting jobs."""
        with self._changed:
            self._discard_cancelled()
            return len(self._jobs)

    @property
    def running(self) -> str | None:
        """Label of the running job, or None."""
        return self._running

    # --- internals --------------------------------------------------------------------------

    async def _outcome(self, job: _EngineJob) -> Any:
        try:
            return await asyncio.wrap_future(job.future)
        except asyncio.CancelledError:
            self._drop(job)
            raise

    def _submit(
        self,
        run: Callable[[], Any],
        label: str,
        priority: Priority,
        batch: Batchable | None = None,
    ) -> _EngineJob:
        job = _EngineJob(run, label, Future(), batch)
        if self.on_queued is not None:
            job.on_end = self.on_queued()
        with self._changed:
            if self._failure is not None:
                raise DeviceLostError(f"the device was lost: {self._failure}")
            if not self._accepting:
                raise EngineStoppedError("the engine does not take jobs: it is stopping")
            if self._jobs.waiting(priority) >= self.queue_length:
                self._discard_cancelled()
            if self._jobs.waiting(priority) >= self.queue_length:
                raise QueueFullError(
                    f"{self._jobs.waiting(priority)} jobs wait for the engine, {self.queue_length} "
                    f"may; it runs {self._running!r}"
                )
            self._jobs.append(job, priority)
            self._changed.notify()
        return job

    def _drop(self, job: _EngineJob) -> None:
        job.future.cancel()
        with self._changed:
            self._discard_cancelled()

    def _discard_cancelled(self) -> None:
        self._jobs.discard(lambda job: job.future.cancelled())

    def _work(self) -> None:
        try:
            if self._threads is not None:
                lower_priority(NICENESS)
            while (job := self._next()) is not None:
                self._start(job)
                # An idle engine must not keep the job's arguments and result alive.
                del job
        except BaseException as error:
            # Fail the waiting jobs and end the worker: without this thread nothing would run.
            log.exception("engine ended")
            self._lose_device(error)

    def _next(self) -> _EngineJob | None:
        with self._changed:
            while True:
                self._last_tick = clock.monotonic()
                if (job := self._jobs.begin_next()) is not None:
                    return job
                if not self._accepting:
                    return None
                self._changed.wait(IDLE_TICK_S)

    def _next_more_urgent(self) -> _EngineJob | None:
        with self._changed:
            self._last_tick = clock.monotonic()
            return self._jobs.begin_more_urgent()

    def _start(self, job: _EngineJob) -> None:
        """Run a job and its batch unless cancelled, and charge the time."""
        self._began = clock.monotonic()
        try:
            jobs = [j for j in self._joined(job) if j.future.set_running_or_notify_cancel()]
            if jobs:
                self._run(jobs)
        finally:
            self._charge()
            with self._changed:
                self._jobs.end()

    def _joined(self, first: _EngineJob) -> list[_EngineJob]:
        """The job and the waiting jobs that run in its batch."""
        batch = first.batch
        if batch is None:
            return [first]
        left = 1.0 - batch.share

        def joins(job: _EngineJob) -> bool:
            nonlocal left
            other = job.batch
            if other is None or other.key is not batch.key or other.compute != batch.compute:
                return False
            left -= other.share
            return left > -1e-9

        with self._changed:
            return [first, *self._jobs.begin_with(joins)]

    def _charge(self) -> None:
        now = clock.monotonic()
        spent, self._began = now - self._began, now
        with self._changed:
            self._jobs.charge(spent)

    def _run(self, jobs: Sequence[_EngineJob]) -> None:
        started = clock.monotonic()
        interrupted, self._running = self._running, jobs[0].label
        try:
            results = _results(jobs)
        except BaseException as error:
            if _loses_device(error):
                self._lose_device(error)
            for job in jobs:
                job.future.set_exception(error)
        else:
            for job, result in zip(jobs, results, strict=True):
                self._hand_over(job, result)
        finally:
            self._running = interrupted
        # Let the awaiting thread run before metrics are updated.
        time.sleep(0)
        for job in jobs:
            for callback in (self._on_job, job.on_end):
                if callback is not None:
                    callback(job.label, started - job.queued_at, clock.monotonic() - started)

    def _hand_over(self, job: _EngineJob, result: Any) -> None:
        if job.batch is None or not isinstance(result, Exception):
            job.future.set_result(result)
            return
        self.note_error(result)
        job.future.set_exception(result)

    def _lose_device(self, error: BaseException) -> None:
        log.error("device lost", error=str(error))
        with self._changed:
            self._failure = error
            self._accepting = False
            waiting = self._jobs.take_all()
        _fail(waiting, DeviceLostError(f"the device was lost: {error}"))
        self.on_failure()


def _results(jobs: Sequence[_EngineJob]) -> Sequence[Any]:
    if len(jobs) == 1:
        return [jobs[0].run()]
    batch = [job.batch for job in jobs if job.batch is not None]
    return batch[0].compute([member.argument for member in batch])


def set_thread_counts(threads: int) -> None:
    """Set the thread counts of torch and numba in this process; 0 means one per core."""
    import numba
    import torch

    available = numba.get_num_threads()
    count = threads or available
    numba.set_num_threads(min(count, available))
    torch.set_num_threads(count)


def lower_priority(niceness: int) -> None:
    """Raise the niceness of the calling thread and the threads it will start (Linux only).

    Never lowers it: only the superuser may.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        if os.getpriority(os.PRIO_PROCESS, thread) < niceness:
            # A sandbox may forbid this; the niceness then stays unchanged.
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, niceness)


def _fail(jobs: Iterable[_EngineJob], error: EngineError) -> None:
    for job in jobs:
        if job.future.set_running_or_notify_cancel():
            job.future.set_exception(error)


def _loses_device(error: BaseException) -> bool:
    """Whether CUDA is unusable after this error. Running out of memory is recoverable."""
    torch = sys.modules.get("torch")
    if torch is None or isinstance(error, torch.OutOfMemoryError):
        return False
    accelerator_error = getattr(torch, "AcceleratorError", None)
    if accelerator_error is not None and isinstance(error, accelerator_error):
        return True
    return isinstance(error, RuntimeError) and "CUDA error" in str(error)
