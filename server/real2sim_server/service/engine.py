"""A thread that runs jobs in turn: the one that owns the device, and the one of worlds."""

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

# Several kinds of jobs wait; each kind gets its share of the engine.

T = TypeVar("T")


class Lane(IntEnum):
    """Kinds of jobs, the most urgent first."""

    DRIVE = 0
    """Steps of sessions: somebody's vehicle waits."""
    VIEW = 1
    """Pictures that somebody looks at, and whatever else takes milliseconds."""
    BULK = 2
    """Large pictures, films, loading."""


WEIGHTS = {Lane.DRIVE: 16.0, Lane.VIEW: 4.0, Lane.BULK: 1.0}
"""Time that lanes get, in proportion, while all of them have work."""


class Lanes(Generic[T]):
    """Queues by lane. The next job is of the lane that has had least time for its weight (stride
    scheduling, Waldspurger & Weihl 1995), within a lane the first that came.

    A lane that was idle begins where the others are: it saves up nothing. Not safe to use on
    several threads at once.

    Args:
        length: jobs that may wait in each lane.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._waiting: dict[Lane, deque[T]] = {lane: deque() for lane in Lane}
        self._running: list[Lane] = []
        self._passed_over = dict.fromkeys(Lane, 0)
        self._had = dict.fromkeys(Lane, 0.0)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def waiting(self, lane: Lane) -> int:
        """Jobs that wait in a lane."""
        return len(self._waiting[lane])

    def append(self, job: T, lane: Lane) -> None:
        """Put a job at the end of a lane; whether there is room is for the caller to ask."""
        if not self._waiting[lane] and lane not in self._running:
            active = [self._had[other] for other in Lane if self._is_active(other)]
            self._had[lane] = max([self._had[lane], *([min(active)] if active else [])])
        self._waiting[lane].append(job)

    def begin_next(self) -> T | None:
        """The job whose turn it is, now running; None where none waits. Let :meth:`end` follow."""
        return self._begin(lane for lane in Lane if self._waiting[lane])

    def begin_more_urgent(self) -> T | None:
        """Like :meth:`begin_next`, but only of lanes more urgent than that of the running job, and
        not beyond what they may have."""
        present = self._running[-1]
        return self._begin(
            lane
            for lane in Lane
            if lane < present and self._waiting[lane] and self._had[lane] <= self._had[present]
        )

    def begin_with(self, joins: Callable[[T], bool]) -> list[T]:
        """Jobs of the lane of the job begun last that are run with it, in the order they came.

        They leave others behind that came before them. A job is left behind once at most: then it
        is run before any that came later.

        Args:
            joins: whether a job is run with it; asked for each in turn.
        """
        lane = self._running[-1]
        waiting, passed_over = self._waiting[lane], self._passed_over[lane]
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
            self._waiting[lane] = deque(job for job in waiting if id(job) not in taken)
            self._passed_over[lane] = behind
        return joined

    def charge(self, seconds: float) -> None:
        """Count time to the lane of the job begun last."""
        lane = self._running[-1]
        self._had[lane] += seconds / WEIGHTS[lane]

    def end(self) -> None:
        """The job begun last has ended."""
        self._running.pop()

    def discard(self, unwanted: Callable[[T], bool]) -> None:
        """Drop waiting jobs."""
        for lane, jobs in self._waiting.items():
            if any(map(unwanted, jobs)):
                kept = [not unwanted(job) for job in jobs]
                self._passed_over[lane] = sum(kept[: self._passed_over[lane]])
                self._waiting[lane] = deque(compress(jobs, kept))

    def take_all(self) -> list[T]:
        """All that wait, which wait no more."""
        jobs = [job for lane in Lane for job in self._waiting[lane]]
        for lane, waiting in self._waiting.items():
            waiting.clear()
            self._passed_over[lane] = 0
        return jobs

    def _is_active(self, lane: Lane) -> bool:
        return bool(self._waiting[lane]) or lane in self._running

    def _begin(self, candidates: Iterable[Lane]) -> T | None:
        lane = min(candidates, key=lambda lane: (self._had[lane], lane), default=None)
        if lane is None:
            return None
        self._running.append(lane)
        self._passed_over[lane] = max(0, self._passed_over[lane] - 1)
        return self._waiting[lane].popleft()


R = TypeVar("R")

IDLE_TICK_S = 0.25
NICENESS = 3
"""Kernels use every core; without a little less weight for them the event loop waits its turn
behind them for a scheduler slice. On two busy cores this brought its lag down from 7 ms to 4 ms at
the 95th percentile."""
SWITCH_INTERVAL_S = 0.0005
"""How soon a thread that runs Python bytecode hands over to the event loop. The interpreter's
default of 5 ms would by itself be the whole of the lag we allow the loop."""

log = structlog.get_logger(__name__)


class EngineError(RuntimeError):
    """The engine cannot take or finish a job."""


class QueueFullError(EngineError):
    """Too many jobs wait already."""


class EngineStoppedError(EngineError):
    """The engine is stopping, or was never started."""


class DeviceLostError(EngineError):
    """The device reported an error after which nothing on it works; only a new process helps."""


@dataclass(frozen=True, eq=False)
class Companions:
    """With what a job may be done in one go: with those that have the same ``compute`` and ``key``.

    Attributes:
        compute: makes the results of several arguments, or what was raised instead, in their order.
        argument: of this job.
        key: compared by identity.
        share: of what may be done in one go; that of all jobs together is at most 1.
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
    companions: Companions | None = None
    queued_at: float = field(default_factory=lambda: clock.monotonic())  # noqa: PLW0108
    on_end: Callable[[str, float, float], None] | None = None


class Engine:
    """Runs jobs one after the other on a thread of its own.

    Everything that computes runs here, so that kernels never compete for cores and the event loop
    never waits for them. Jobs are plain functions; their exceptions travel to the caller. Jobs of a
    lane run in the order they came, lanes take turns, see :class:`.Lanes`. A long job calls
    :meth:`give_way` between its pieces, and more urgent ones run there and then. Jobs that can be
    done in one go are, where they wait together; none waits for one to come.

    Args:
        name: of the thread.
        queue_length: jobs that may wait in each lane.
        threads: of torch and numba, 0 for one per core; None for a thread that runs no kernels on
            every core, and that gives way to nobody.
        on_job: called on the engine thread after each job with its label, the seconds it waited
            and the seconds it ran.

    Attributes:
        on_failure: called on the engine thread when the device is lost.
        on_queued: asked by whoever queues a job; its answer is called as ``on_job`` after that job.
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
        self._jobs: Lanes[_EngineJob] = Lanes(queue_length)
        self._began = 0.0
        self._changed = threading.Condition()
        self._accepting = False
        self._running: str | None = None
        self._last_tick = clock.monotonic()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    # --- life -------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread and set the thread counts of torch and numba once and for all."""
        sys.setswitchinterval(min(SWITCH_INTERVAL_S, sys.getswitchinterval()))
        self._accepting = True
        self._last_tick = clock.monotonic()
        self._thread.start()
        if self._threads is not None:
            self.call_sync(set_thread_counts, self._threads, label="threads")

    def stop(self, *, drain: bool = True, timeout_s: float | None = None) -> None:
        """Take no more jobs and end the thread; without ``drain``, waiting jobs are dropped.

        Raises:
            TimeoutError: a job still runs after ``timeout_s``.
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

    # --- work -------------------------------------------------------------------------------

    async def call(
        self,
        fn: Callable[..., T],
        *args: Any,
        label: str = "work",
        lane: Lane = Lane.VIEW,
        **kwargs: Any,
    ) -> T:
        """``fn(*args, **kwargs)`` on the engine thread, awaited.

        When the awaiting task is cancelled, a job that still waits is dropped; one that runs
        finishes, and its result is thrown away.

        Args:
            fn: with ``args`` and ``kwargs``.
            label: for metrics and messages.
            lane: with what it takes turns.

        Raises:
            QueueFullError: ``queue_length`` jobs of the lane wait already.
            EngineStoppedError: the engine does not run, or stopped before the job's turn.
            DeviceLostError: an earlier job lost the device.
        """
        job = self._submit(lambda: fn(*args, **kwargs), label, lane)
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
        lane: Lane,
    ) -> R:
        """The result that ``compute`` has for ``argument``, awaited as by :meth:`call`.

        What waits with it in its lane, of the same ``compute`` and ``key``, is handed over in the
        same call; those whose turn it was before wait for it once at most.

        Args:
            compute: makes the results of several arguments, or what was raised instead, in order.
            argument: of this call.
            key: compared by identity.
            share: of what may be done in one go, above 0; at most 1 comes together.
            label, lane: as of :meth:`call`.

        Raises:
            QueueFullError, EngineStoppedError, DeviceLostError: as :meth:`call`.
        """
        companions = Companions(compute, argument, key, share)
        job = self._submit(lambda: compute([argument])[0], label, lane, companions)
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
        """Like :meth:`call` for callers without an event loop; on the engine thread, just runs.

        Raises:
            TimeoutError: no result after ``timeout_s``.
        """
        if threading.current_thread() is self._thread:
            return fn(*args, **kwargs)
        job = self._submit(lambda: fn(*args, **kwargs), label, Lane.VIEW)
        try:
            result: T = job.future.result(timeout_s)
        except TimeoutError:
            if not job.future.done():
                self._drop(job)
            raise
        return result

    def give_way(self) -> None:
        """Run what is more urgent than the running job and whose turn it is.

        For long jobs, between two of their pieces. Does nothing on other threads.
        """
        if threading.current_thread() is not self._thread:
            return
        self._charge()
        while (job := self._next_more_urgent()) is not None:
            self._start(job)
            del job
        self._began = clock.monotonic()

    def note_error(self, error: BaseException) -> None:
        """Something that began here has failed on another thread: the device may be lost."""
        if self._failure is None and _loses_device(error):
            self._lose_device(error)

    # --- state ------------------------------------------------------------------------------

    @property
    def alive(self) -> bool:
        """Whether the thread runs and the device is not lost."""
        return self._thread.is_alive() and self._failure is None

    @property
    def failure(self) -> BaseException | None:
        """The error that lost the device, if one did."""
        return self._failure

    @property
    def seconds_since_tick(self) -> float:
        """Time since the thread last looked for a job; grows while one runs [s]."""
        return clock.monotonic() - self._last_tick

    @property
    def queue_depth(self) -> int:
        """Jobs that wait."""
        with self._changed:
            self._discard_cancelled()
            return len(self._jobs)

    @property
    def running(self) -> str | None:
        """Label of the job under way."""
        return self._running

    # --- inside -----------------------------------------------------------------------------

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
        lane: Lane,
        companions: Companions | None = None,
    ) -> _EngineJob:
        job = _EngineJob(run, label, Future(), companions)
        if self.on_queued is not None:
            job.on_end = self.on_queued()
        with self._changed:
            if self._failure is not None:
                raise DeviceLostError(f"the device was lost: {self._failure}")
            if not self._accepting:
                raise EngineStoppedError("the engine does not take jobs: it is stopping")
            if self._jobs.waiting(lane) >= self.queue_length:
                self._discard_cancelled()
            if self._jobs.waiting(lane) >= self.queue_length:
                raise QueueFullError(
                    f"{self._jobs.waiting(lane)} jobs wait for the engine, {self.queue_length} "
                    f"may; it runs {self._running!r}"
                )
            self._jobs.append(job, lane)
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
                # The job holds arguments and result; an idle engine must not keep them alive.
                del job
        except BaseException as error:
            # Without its thread an engine answers nobody: who waits is told, and the worker ends.
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
        """Run a job that is wanted still, with those that join it, and count its time."""
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
        """A job that begins, and those that are done in one go with it."""
        given = first.companions
        if given is None:
            return [first]
        left = 1.0 - given.share

        def joins(job: _EngineJob) -> bool:
            nonlocal left
            other = job.companions
            if other is None or other.key is not given.key or other.compute != given.compute:
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
        # The awaiting thread has been woken, and gets the interpreter before metrics are updated.
        time.sleep(0)
        for job in jobs:
            for told in (self._on_job, job.on_end):
                if told is not None:
                    told(job.label, started - job.queued_at, clock.monotonic() - started)

    def _hand_over(self, job: _EngineJob, result: Any) -> None:
        if job.companions is None or not isinstance(result, Exception):
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
    given = [job.companions for job in jobs if job.companions is not None]
    return given[0].compute([companions.argument for companions in given])


def set_thread_counts(threads: int) -> None:
    """Set the threads of torch and numba in this process; 0 leaves one per core."""
    import numba
    import torch

    available = numba.get_num_threads()
    count = threads or available
    numba.set_num_threads(min(count, available))
    torch.set_num_threads(count)


def lower_priority(niceness: int) -> None:
    """Of the calling thread and of those that kernels will start from it; Linux can do that.

    Only the superuser may raise a priority: what is lower already stays as it is.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        if os.getpriority(os.PRIO_PROCESS, thread) < niceness:
            # Where a sandbox forbids it, all goes on at one priority.
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, niceness)


def _fail(jobs: Iterable[_EngineJob], error: EngineError) -> None:
    for job in jobs:
        if job.future.set_running_or_notify_cancel():
            job.future.set_exception(error)


def _loses_device(error: BaseException) -> bool:
    """Whether CUDA refuses everything after this error. Running out of memory is not such a one."""
    torch = sys.modules.get("torch")
    if torch is None or isinstance(error, torch.OutOfMemoryError):
        return False
    accelerator_error = getattr(torch, "AcceleratorError", None)
    if accelerator_error is not None and isinstance(error, accelerator_error):
        return True
    return isinstance(error, RuntimeError) and "CUDA error" in str(error)
