"""Tasks done on a Ray cluster, of this machine or of many.

A worker is an actor. Where it or its machine dies, Ray begins it anew and the task that it was at
is done again, which costs that task's time only. Results come back by value, so that the machines
need no disk in common.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from .executor import MOST_TRIES, ExecutorError, OnResult, Recipe, threads_of


class RayCluster:
    """So many workers, each an actor of Ray.

    Args:
        workers: how many.
        address: of an existing cluster, ``auto`` for that of the environment; None starts one on
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
        """See :class:`~.executor.Executor`."""
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
        made = self._ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=MOST_TRIES - 1)(
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
                    f"{name or 'a worker'}: its actor died {MOST_TRIES} times ({error})"
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
        """Whether it has been made: an answer at all says so."""
        return True

    def make(self, task: Any) -> Any:
        """The result of a task."""
        return self._worker.make(task)
