"""Calls that wait for a thread are made in one go, and know nothing of each other."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from real2sim_server.service.sessions.gathered_calls import MOST_TOGETHER, GatheredCalls, attempt
from tests.waiting import LIMIT_S


class Work:
    """Doubles numbers, refuses negative ones, and begins when it is let."""

    def __init__(self) -> None:
        self.groups: list[list[int]] = []
        self.begun, self.let = threading.Event(), threading.Event()
        self.shown: list[tuple[int, int]] = []

    def __call__(self, numbers: Sequence[int]) -> list[int | Exception]:
        self.begun.set()
        assert self.let.wait(LIMIT_S)
        self.groups.append(list(numbers))
        return [attempt(self._double, number) for number in numbers]

    def _double(self, number: int) -> int:
        if number < 0:
            raise ValueError(f"{number} is negative")
        return 2 * number


def run(work: Work, numbers: Sequence[int], *, cancel: Sequence[int] = ()) -> list[Any]:
    """What the calls have led to; all wait while the first is made."""

    async def main() -> list[Any]:
        with ThreadPoolExecutor(1) as executor:
            calls = GatheredCalls(
                work, executor, on_result=lambda n, result: work.shown.append((n, result))
            )
            tasks = [asyncio.create_task(calls.call(numbers[0]))]
            assert await asyncio.to_thread(work.begun.wait, LIMIT_S)
            tasks += [asyncio.create_task(calls.call(number)) for number in numbers[1:]]
            await asyncio.sleep(0)
            for k in cancel:
                tasks[k].cancel()
            await asyncio.sleep(0)
            work.let.set()
            return await asyncio.gather(*tasks, return_exceptions=True)

    return asyncio.run(main())


def test_what_waits_is_made_together() -> None:
    work = Work()
    assert run(work, [1, 2, 3, 4]) == [2, 4, 6, 8]
    assert work.groups == [[1], [2, 3, 4]]
    assert work.shown == [(1, 2), (2, 4), (3, 6), (4, 8)]


def test_what_comes_in_one_turn_of_the_loop_is_made_together() -> None:
    work = Work()
    work.let.set()
    told: list[int | Exception] = []

    async def main() -> list[int]:
        with ThreadPoolExecutor(1) as executor:
            calls = GatheredCalls(work, executor, on_result=lambda *_: None)
            calls.begin(1, told.append)
            calls.begin(-1, told.append)
            return await asyncio.gather(calls.call(2), calls.call(3))

    assert asyncio.run(main()) == [4, 6]
    assert work.groups == [[1, -1], [2, 3]]
    assert told[0] == 2
    assert isinstance(told[1], ValueError)


def test_no_more_than_some_are_made_together() -> None:
    work = Work()
    numbers = list(range(2 * MOST_TOGETHER))
    assert run(work, numbers) == [2 * n for n in numbers]
    assert max(map(len, work.groups)) == MOST_TOGETHER


def test_one_that_fails_disturbs_no_other() -> None:
    found = run(Work(), [1, -2, 3])
    assert found[0] == 2
    assert isinstance(found[1], ValueError)
    assert found[2] == 6


def test_one_that_is_given_up_while_it_waits_is_not_made() -> None:
    work = Work()
    found = run(work, [1, 2, 3], cancel=[1])
    assert isinstance(found[1], asyncio.CancelledError)
    assert work.groups == [[1], [3]]


def test_an_error_of_the_whole_is_that_of_each() -> None:
    def broken(_numbers: Sequence[int]) -> list[int | Exception]:
        raise RuntimeError("no thread")

    async def main() -> list[Any]:
        with ThreadPoolExecutor(1) as executor:
            calls = GatheredCalls(broken, executor, on_result=lambda *_: None)
            return await asyncio.gather(calls.call(1), calls.call(2), return_exceptions=True)

    assert [str(error) for error in asyncio.run(main())] == ["no thread"] * 2


def test_what_refuses_the_result_is_raised_to_its_caller() -> None:
    def refuse(number: int, _result: int) -> None:
        if number == 1:
            raise OSError("socket gone")

    async def main() -> list[Any]:
        with ThreadPoolExecutor(1) as executor:
            calls = GatheredCalls(list, executor, on_result=refuse)
            return await asyncio.gather(calls.call(1), calls.call(2), return_exceptions=True)

    first, second = asyncio.run(main())
    assert isinstance(first, OSError)
    assert second == 2


def test_attempt_gives_what_was_raised() -> None:
    assert isinstance(attempt(int, "x"), ValueError)
    with pytest.raises(KeyboardInterrupt):
        attempt(_interrupt)


def _interrupt() -> None:
    raise KeyboardInterrupt
