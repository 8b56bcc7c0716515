from __future__ import annotations

import asyncio

import pytest

from real2sim_server.service.http.responses import uncancellable


def test_an_uncancellable_change_completes_when_its_caller_is_cancelled():
    async def work() -> list[str]:
        done: list[str] = []
        begun, go_on = asyncio.Event(), asyncio.Event()

        @uncancellable
        async def change() -> None:
            begun.set()
            await go_on.wait()
            done.append("changed")

        caller = asyncio.create_task(change())
        await begun.wait()
        caller.cancel()
        await asyncio.sleep(0)
        assert not caller.done()
        go_on.set()
        with pytest.raises(asyncio.CancelledError):
            await caller
        return done

    assert asyncio.run(work()) == ["changed"]


def test_results_and_exceptions_are_passed_through():
    @uncancellable
    async def divided(a: float, b: float) -> float:
        return a / b

    assert asyncio.run(divided(1, 2)) == 0.5
    with pytest.raises(ZeroDivisionError):
        asyncio.run(divided(1, 0))
