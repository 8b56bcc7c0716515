"""What an executor is, and the simplest one: task after task in this process."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any, Protocol

MOST_TRIES = 3
"""A task whose worker dies is done again by another; that often it is begun."""


class ExecutorError(RuntimeError):
    """Tasks cannot be done: nobody to do them, or whoever does them dies again and again."""


class Worker(Protocol):
    """Does tasks, one at a time, and keeps in memory what they share."""

    def make(self, task: Any) -> Any:
        """The result of a task; both can be pickled."""
        ...


Recipe = Callable[[int], Worker]
"""Makes a worker that computes with so many threads; it can be pickled, and finds its files on
every machine."""

OnResult = Callable[[str, Any], None]
"""Told the name of a task that is done, and its result, in the caller's process."""


class Executor(Protocol):
    """Does tasks."""

    def run(self, recipe: Recipe, tasks: Mapping[str, Any], on_result: OnResult) -> None:
        """Do all tasks, in any order.

        Args:
            recipe: of the workers.
            tasks: by name.
            on_result: called once for each, as soon as it is done. What it raises ends the run.

        Raises:
            ExecutorError: a task's workers die again and again.
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
    """What each of so many workers on this machine computes with."""
    return max(1, (os.cpu_count() or 1) // max(workers, 1))
