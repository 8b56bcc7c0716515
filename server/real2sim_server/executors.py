"""Executors of many independent tasks: this process, processes, or a Ray cluster.

A task gives the same result on any worker, and runs again if its worker dies. Data sets build their
clips with executors, and sweeps drive their episodes.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

EXECUTORS = ("processes", "ray")

MAX_TRIES = 3
"""Maximum number of starts of a task; if its worker dies, it runs again on another."""


class ExecutorError(RuntimeError):
    """Tasks cannot run: no workers are available, or workers die repeatedly."""


class Worker(Protocol):
    """Runs tasks, one at a time, and holds their shared data in memory."""

    def make(self, task: Any) -> Any:
        """The result of a task; both can be pickled."""
        ...


Recipe = Callable[[int], Worker]
"""Makes a worker that uses the given number of threads; it can be pickled, and finds its files on
every machine.
"""

OnResult = Callable[[str, Any], None]
"""Told the name of a task that is done, and its result, in the caller's process."""


class Executor(Protocol):
    """Does tasks."""

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """Run all tasks, in any order.

        Args:
            recipe: of the workers.
            tasks: by name.
            on_result: called once per task when it is done. An exception from it ends the run.

        Raises:
            ExecutorError: a task's workers die repeatedly.
        """
        ...


class InProcess:
    """One task after the other, in this process, with all its threads."""

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """See :class:`Executor`."""
        if not tasks:
            return
        worker = recipe(threads_of(1))
        for name, task in tasks.items():
            on_result(name, worker.make(task))


def threads_of(workers: int) -> int:
    """Number of threads for each of ``workers`` workers on this machine."""
    return max(1, (os.cpu_count() or 1) // max(workers, 1))


_worker: Worker | None = None


class Processes:
    """Processes of this machine, each a worker; all restart if one dies.

    Args:
        workers: number of processes; they share the cores.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """See :class:`Executor`."""
        left, fruitless = dict(tasks), 0
        while left:
            before = len(left)
            self._done(recipe, left, on_result)
            # The task that killed a process is unknown; between failures, some tasks must have
            # finished.
            fruitless = fruitless + 1 if len(left) == before else 0
            if fruitless >= MAX_TRIES:
                raise ExecutorError(
                    f"{next(iter(left))}: its processes died {fruitless} times; use fewer "
                    "workers if memory is short"
                )

    def _done(self, recipe: Recipe, left: dict[str, Any], on_result: OnResult) -> None:
        """Remove finished tasks from ``left``, until all are done or a process has died."""
        workers = min(self._workers, len(left))
        with ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(recipe, threads_of(self._workers)),
        ) as pool:
            waiting: dict[Future[Any], str] = {}
            try:
                for name, task in left.items():
                    waiting[pool.submit(_make, task)] = name
                for done in as_completed(list(waiting)):
                    result, name = done.result(), waiting[done]
                    on_result(name, result)
                    del left[name]
            except BrokenProcessPool:
                return
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise


def _begin(recipe: Recipe, threads: int) -> None:
    global _worker  # noqa: PLW0603, a process of the pool has one
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = recipe(threads)


def _end_with_parent() -> None:
    """A pool's processes wait for work for ever where their parent was killed."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _make(task: Any) -> Any:
    assert _worker is not None
    return _worker.make(task)


class RayCluster:
    """Workers that are actors of a Ray cluster, on one or many machines.

    If a worker or its machine dies, Ray restarts it and its current task runs again. Results are
    returned by value, so the machines need no shared disk.

    Args:
        workers: number of workers.
        address: of an existing cluster, ``auto`` for the one of the environment; None starts one on
            this machine, which ends with the run.

    Raises:
        ExecutorError: Ray is not installed.
    """

    def __init__(self, workers: int, *, address: str | None = None) -> None:
        try:
            import ray
        except ImportError as error:
            raise ExecutorError(
                f"the executor 'ray' needs the ray extra: pip install 'real2sim[ray]' ({error})"
            ) from error
        self._ray: Any = ray
        self._workers = workers
        self._address = address

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """See :class:`Executor`."""
        if not tasks:
            return
        ray, begun = self._ray, not self._ray.is_initialized()
        if begun:
            self._connect()
        try:
            hosts = self._hosts(recipe, min(self._workers, len(tasks)))
            try:
                self._do_all(hosts, tasks, on_result)
            finally:
                for actor in hosts:
                    ray.kill(actor)
        finally:
            if begun:
                ray.shutdown()

    def _connect(self) -> None:
        quiet = {"logging_level": "warning", "log_to_driver": False}
        try:
            if self._address is None:
                cpus = max(self._workers, os.cpu_count() or 1)
                self._ray.init(num_cpus=cpus, include_dashboard=False, **quiet)
            else:
                self._ray.init(address=self._address, **quiet)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ExecutorError(f"no Ray cluster at {self._address!r}: {error}") from error

    def _hosts(self, recipe: Recipe, count: int) -> list[Any]:
        threads = threads_of(count) if self._address is None else 1
        made = self._ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=MAX_TRIES - 1)(
            HostedWorker
        )
        return [made.remote(recipe, threads) for _ in range(count)]

    def _do_all(self, hosts: Sequence[Any], tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """Give each actor one task at a time, the next when it has done it. Actors that the
        cluster has no room for get none, and are not waited for."""
        ray = self._ray
        left: list[str] = list(tasks)[::-1]
        at_work: dict[Any, tuple[Any, str | None]]
        at_work = {actor.is_ready.remote(): (actor, None) for actor in hosts}
        while left or any(name is not None for _, name in at_work.values()):
            [done], _ = ray.wait(list(at_work), num_returns=1)
            actor, name = at_work.pop(done)
            try:
                result = ray.get(done)
            except ray.exceptions.RayActorError as error:
                raise ExecutorError(
                    f"{name or 'a worker'}: its actor died {MAX_TRIES} times ({error})"
                ) from error
            if left:
                following = left.pop()
                at_work[actor.make.remote(tasks[following])] = (actor, following)
            if name is not None:
                on_result(name, result)


class HostedWorker:
    """A worker as an actor.

    Args:
        recipe: makes it.
        threads: that it computes with.
    """

    def __init__(self, recipe: Recipe, threads: int) -> None:
        self._worker = recipe(threads)

    def is_ready(self) -> bool:
        """Whether the worker was created: any answer means yes."""
        return True

    def make(self, task: Any) -> Any:
        """The result of a task."""
        return self._worker.make(task)


def executor_of(name: str, *, workers: int, address: str | None = None) -> Executor:
    """The executor with that name.

    Args:
        name: from EXECUTORS; ``processes`` with one worker runs everything in this process.
        workers: at least 1.
        address: of an existing Ray cluster, ``auto`` for the one of the environment; None for one
            on this machine.

    Raises:
        ExecutorError: an unknown name, no worker, or Ray is not installed.
    """
    if workers < 1:
        raise ExecutorError(f"{workers} workers; at least 1 does the work")
    if name == "processes":
        return InProcess() if workers == 1 else Processes(workers)
    if name == "ray":
        return RayCluster(workers, address=address)
    raise ExecutorError(f"executor {name!r}; allowed are {', '.join(EXECUTORS)}")
