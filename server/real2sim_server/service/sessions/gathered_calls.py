"""Calls that wait for a thread, made in one go.

To wake a thread and be woken by it takes longer than what many calls do there, and leaves caches
cold. What waits when the thread is free is therefore handed over together, with what comes in the
same turn of the event loop: the thread could not have run before that has ended. A call that waits
alone is made alone.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Generic, NamedTuple, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

MOST_TOGETHER = 16
"""The first of them waits for the last: some milliseconds."""


class _Call(NamedTuple, Generic[T, R]):
    """A call that waits: its argument, what is told of its result, and who may give it up."""

    argument: T
    done: Callable[[R | Exception], object]
    outcome: asyncio.Future[R] | None

    @property
    def dropped(self) -> bool:
        return self.outcome is not None and self.outcome.cancelled()


class GatheredCalls(Generic[T, R]):
    """For callers on one event loop.

    Args:
        compute: makes the results of several arguments, or what was raised instead, in their order.
        executor: of one thread, where ``compute`` runs.
        on_result: called on the event loop with an argument and its result, before the caller of
            :meth:`call` is woken.
    """

    def __init__(
        self,
        compute: Callable[[Sequence[T]], Sequence[R | Exception]],
        executor: Executor,
        *,
        on_result: Callable[[T, R], object],
    ) -> None:
        self._compute = compute
        self._executor = executor
        self._on_result = on_result
        self._waiting: deque[_Call[T, R]] = deque()
        self._busy = False

    async def call(self, argument: T) -> R:
        """The result for ``argument``; what waits still when its caller is cancelled is dropped."""
        outcome: asyncio.Future[R] = asyncio.get_running_loop().create_future()
        self._append(_Call(argument, partial(self._settle, argument, outcome), outcome))
        return await outcome

    def begin(self, argument: T, done: Callable[[R | Exception], object]) -> None:
        """Let ``done`` be called on the event loop with the result for ``argument``, or with what
        was raised instead; no task is woken for it. It must not raise."""
        self._append(_Call(argument, done, None))

    def _append(self, call: _Call[T, R]) -> None:
        self._waiting.append(call)
        if not self._busy:
            self._busy = True
            asyncio.get_running_loop().call_soon(self._begin)

    def _begin(self) -> None:
        """Hand over what waits."""
        calls: list[_Call[T, R]] = []
        while self._waiting and len(calls) < MOST_TOGETHER:
            call = self._waiting.popleft()
            if not call.dropped:
                calls.append(call)
        self._busy = bool(calls)
        if not calls:
            return
        loop = asyncio.get_running_loop()
        try:
            self._executor.submit(self._work, calls, loop)
        except RuntimeError as error:  # The executor has been shut down.
            self._end(calls, [error] * len(calls))

    def _work(self, calls: Sequence[_Call[T, R]], loop: asyncio.AbstractEventLoop) -> None:
        results: Sequence[R | Exception]
        try:
            results = self._compute([call.argument for call in calls])
        except Exception as error:
            results = [error] * len(calls)
        # A loop that was closed has no waiters left.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(self._end, calls, results)

    def _end(self, calls: Sequence[_Call[T, R]], results: Sequence[R | Exception]) -> None:
        # Before the answers, so that the other thread has work while these leave.
        self._begin()
        for call, result in zip(calls, results, strict=True):
            call.done(result)

    def _settle(self, argument: T, outcome: asyncio.Future[R], result: R | Exception) -> None:
        if outcome.done():
            return
        if isinstance(result, Exception):
            outcome.set_exception(result)
            return
        try:
            self._on_result(argument, result)
        except Exception as error:
            outcome.set_exception(error)
        else:
            outcome.set_result(result)


def attempt(fn: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R | Exception:
    """What ``fn`` returns, or the exception that it raises."""
    try:
        return fn(*args, **kwargs)
    except Exception as error:
        return error
