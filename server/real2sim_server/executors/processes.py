"""Tasks done by processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from .executor import MOST_TRIES, ExecutorError, OnResult, Recipe, Worker, threads_of

_worker: Worker | None = None


class Processes:
    """So many processes, each a worker; all begin anew where one dies.

    Args:
        workers: processes; they share the cores.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """See :class:`~.executor.Executor`."""
        left, fruitless = dict(tasks), 0
        while left:
            before = len(left)
            self._done(recipe, left, on_result)
            # Which task a process died of is not known; some must have been done in between.
            fruitless = fruitless + 1 if len(left) == before else 0
            if fruitless >= MOST_TRIES:
                raise ExecutorError(
                    f"{next(iter(left))}: its processes died {fruitless} times; is there enough "
                    "memory for so many workers?"
                )

    def _done(self, recipe: Recipe, left: dict[str, Any], on_result: OnResult) -> None:
        """Take from ``left`` what is done, until all is or a process has died."""
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
