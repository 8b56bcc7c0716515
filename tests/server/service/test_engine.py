from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time

import pytest
import torch

from real2sim_server.service.engine import (
    NICENESS,
    DeviceLostError,
    Engine,
    EngineStoppedError,
    Priority,
    QueueFullError,
)
from tests.waiting import LIMIT_S, wait_until, wait_until_async


@pytest.fixture
def make_engine():
    engines = []

    def make(**options) -> Engine:
        engine = Engine(**options)
        engine.start()
        engines.append(engine)
        return engine

    yield make
    for engine in engines:
        engine.stop(drain=False, timeout_s=LIMIT_S)


class Gate:
    """A job that occupies the engine until it is opened."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        self._opened = threading.Event()

    def job(self) -> str:
        self.entered.set()
        assert self._opened.wait(LIMIT_S)
        return "through"

    def open(self) -> None:
        self._opened.set()


async def until_entered(gate: Gate) -> None:
    assert await asyncio.to_thread(gate.entered.wait, LIMIT_S)


def test_a_call_returns_what_the_function_returns(make_engine):
    engine = make_engine()
    assert asyncio.run(engine.call(divmod, 7, 2)) == (3, 1)
    assert engine.call_sync(int, "ff", base=16) == 255


def test_an_engine_goes_on_when_the_loop_that_asked_is_gone(make_engine):
    engine, gate = make_engine(), Gate()

    async def ask_and_leave() -> None:
        # Held by nobody else, and never cancelled, as when a loop is stopped at once.
        asyncio.ensure_future(engine.call(gate.job))  # noqa: RUF006
        await until_entered(gate)

    loop = asyncio.new_event_loop()
    loop.run_until_complete(ask_and_leave())
    loop.close()
    gate.open()
    assert engine.call_sync(int, "7") == 7


def test_all_jobs_run_on_the_same_thread_and_none_on_the_callers(make_engine):
    engine = make_engine()

    async def ask() -> list[int]:
        return await asyncio.gather(*(engine.call(threading.get_ident) for _ in range(5)))

    idents = set(asyncio.run(ask()))
    assert len(idents) == 1
    assert threading.get_ident() not in idents


def test_jobs_run_in_the_order_they_came(make_engine):
    engine = make_engine()
    order: list[int] = []

    async def ask() -> None:
        await asyncio.gather(*(engine.call(order.append, i) for i in range(50)))

    asyncio.run(ask())
    assert order == list(range(50))


def test_exceptions_travel_to_the_caller_and_the_engine_goes_on(make_engine):
    engine = make_engine()
    with pytest.raises(ZeroDivisionError):
        asyncio.run(engine.call(divmod, 1, 0))
    assert engine.call_sync(abs, -1) == 1


def test_a_cancelled_caller_takes_the_waiting_job_along(make_engine):
    engine, gate, ran = make_engine(), Gate(), []

    async def ask() -> None:
        first = asyncio.create_task(engine.call(gate.job))
        await until_entered(gate)
        second = asyncio.create_task(engine.call(ran.append, "second"))
        await asyncio.sleep(0)
        assert engine.queue_depth == 1
        second.cancel()
        with pytest.raises(asyncio.CancelledError):
            await second
        assert engine.queue_depth == 0
        gate.open()
        assert await first == "through"
        await engine.call(ran.append, "third")

    asyncio.run(ask())
    assert ran == ["third"]


def test_a_running_job_finishes_although_its_caller_was_cancelled(make_engine):
    engine, gate, ran = make_engine(), Gate(), []

    def job() -> None:
        gate.job()
        ran.append("finished")

    async def ask() -> None:
        task = asyncio.create_task(engine.call(job))
        await until_entered(gate)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        gate.open()
        await engine.call(lambda: None)

    asyncio.run(ask())
    assert ran == ["finished"]


def test_a_full_queue_refuses_at_once_and_names_the_limit(make_engine):
    engine, gate = make_engine(queue_length=2), Gate()

    async def ask() -> None:
        tasks = [asyncio.create_task(engine.call(gate.job))]
        await until_entered(gate)
        tasks += [asyncio.create_task(engine.call(lambda: None)) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(QueueFullError, match="2 jobs wait for the engine, 2 may"):
            await engine.call(lambda: None)
        gate.open()
        await asyncio.gather(*tasks)
        await engine.call(lambda: None)

    asyncio.run(ask())


def test_stop_finishes_what_waits(make_engine):
    engine, gate = make_engine(), Gate()

    async def ask() -> list[object]:
        tasks = [asyncio.create_task(engine.call(gate.job))]
        await until_entered(gate)
        tasks.append(asyncio.create_task(engine.call(lambda: "waited")))
        await asyncio.sleep(0)
        stopping = asyncio.create_task(asyncio.to_thread(engine.stop))
        gate.open()
        await stopping
        return await asyncio.gather(*tasks)

    assert asyncio.run(ask()) == ["through", "waited"]
    assert not engine.alive


def test_stop_without_draining_refuses_what_waits(make_engine):
    engine, gate = make_engine(), Gate()

    async def ask() -> None:
        first = asyncio.create_task(engine.call(gate.job))
        await until_entered(gate)
        second = asyncio.create_task(engine.call(lambda: None))
        await asyncio.sleep(0)
        stopping = asyncio.create_task(asyncio.to_thread(engine.stop, drain=False))
        with pytest.raises(EngineStoppedError):
            await second
        gate.open()
        await stopping
        assert await first == "through"

    asyncio.run(ask())


def test_a_stopped_engine_refuses_jobs(make_engine):
    engine = make_engine()
    engine.stop()
    with pytest.raises(EngineStoppedError):
        engine.call_sync(lambda: None)


def test_stop_says_which_job_does_not_end(make_engine):
    engine, gate = make_engine(), Gate()
    caller = threading.Thread(target=engine.call_sync, args=(gate.job,), kwargs={"label": "slow"})
    caller.start()
    assert gate.entered.wait(LIMIT_S)
    with pytest.raises(TimeoutError, match="'slow' still runs"):
        engine.stop(timeout_s=0.05)
    gate.open()
    caller.join(LIMIT_S)


def test_a_job_may_call_the_engine_without_waiting_for_itself(make_engine):
    engine = make_engine()
    assert engine.call_sync(lambda: engine.call_sync(lambda: "inner")) == "inner"


def test_call_sync_gives_up_after_its_timeout(make_engine):
    engine, gate = make_engine(), Gate()
    with pytest.raises(TimeoutError):
        engine.call_sync(gate.job, timeout_s=0.05)
    gate.open()


def test_the_heartbeat_ages_only_while_a_job_runs(make_engine, manual_clock):
    engine, gate = make_engine(), Gate()
    manual_clock.advance(10.0)
    wait_until(lambda: engine.seconds_since_tick == 0.0, "the next tick of an idle engine")

    async def ask() -> None:
        task = asyncio.create_task(engine.call(gate.job, label="long"))
        await until_entered(gate)
        manual_clock.advance(10.0)
        assert engine.seconds_since_tick == pytest.approx(10.0)
        assert engine.running == "long"
        gate.open()
        await task

    asyncio.run(ask())


def test_a_sticky_device_error_ends_the_engine_and_refuses_all_others(make_engine):
    engine, gate, told = make_engine(), Gate(), []
    engine.on_failure = lambda: told.append(True)

    def lose() -> None:
        gate.job()
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    async def ask() -> None:
        first = asyncio.create_task(engine.call(lose))
        await until_entered(gate)
        second = asyncio.create_task(engine.call(lambda: None))
        await asyncio.sleep(0)
        gate.open()
        with pytest.raises(RuntimeError, match="illegal memory access"):
            await first
        with pytest.raises(DeviceLostError):
            await second
        with pytest.raises(DeviceLostError):
            await engine.call(lambda: None)

    asyncio.run(ask())
    assert told == [True]
    assert not engine.alive


def test_running_out_of_device_memory_does_not_end_the_engine(make_engine):
    engine = make_engine()

    def allocate() -> None:
        raise torch.OutOfMemoryError("CUDA error: out of memory")

    with pytest.raises(torch.OutOfMemoryError):
        engine.call_sync(allocate)
    assert engine.alive


def test_jobs_are_reported_with_their_label_and_durations():
    reports: list[tuple[str, float, float]] = []
    engine = Engine(on_job=lambda *report: reports.append(report))
    engine.start()
    engine.call_sync(time.sleep, 0.02, label="nap")
    engine.stop()
    label, waited, ran = reports[-1]
    assert label == "nap"
    assert ran >= 0.02
    assert waited >= 0


def test_a_long_job_gives_way_to_a_step_between_its_pieces(make_engine):
    engine, order = make_engine(), []
    piece, asked = threading.Event(), threading.Event()

    def film() -> None:
        order.append("film begins")
        piece.set()
        assert asked.wait(LIMIT_S)
        engine.yield_to_urgent()
        order.append("film ends")

    async def ask() -> None:
        filming = asyncio.ensure_future(engine.call(film, priority=Priority.BULK))
        assert await asyncio.to_thread(piece.wait, 10)
        others = [
            asyncio.ensure_future(engine.call(order.append, priority.name, priority=priority))
            for priority in (Priority.BULK, Priority.DRIVE)
        ]
        await asyncio.sleep(0)
        asked.set()
        await asyncio.gather(filming, *others)

    asyncio.run(ask())
    assert order == ["film begins", "DRIVE", "film ends", "BULK"]


def test_a_step_that_fails_leaves_the_job_that_gave_way(make_engine):
    engine, piece, asked = make_engine(), threading.Event(), threading.Event()

    def film() -> str:
        piece.set()
        assert asked.wait(LIMIT_S)
        engine.yield_to_urgent()
        return "filmed"

    async def ask() -> None:
        filming = asyncio.ensure_future(engine.call(film, priority=Priority.BULK, label="film"))
        assert await asyncio.to_thread(piece.wait, 10)
        step = asyncio.ensure_future(engine.call(divmod, 1, 0, priority=Priority.DRIVE))
        await asyncio.sleep(0)
        asked.set()
        with pytest.raises(ZeroDivisionError):
            await step
        assert await filming == "filmed"

    asyncio.run(ask())
    assert engine.running is None


def test_giving_way_on_another_thread_runs_nothing(make_engine):
    engine, gate, ran = make_engine(), Gate(), []

    async def ask() -> None:
        first = asyncio.ensure_future(engine.call(gate.job, priority=Priority.BULK))
        await until_entered(gate)
        step = asyncio.ensure_future(engine.call(ran.append, "step", priority=Priority.DRIVE))
        await asyncio.sleep(0)
        engine.yield_to_urgent()
        assert ran == []
        gate.open()
        await asyncio.gather(first, step)

    asyncio.run(ask())
    assert ran == ["step"]


def test_a_full_lane_leaves_room_in_the_others(make_engine):
    engine, gate = make_engine(queue_length=1), Gate()

    async def ask() -> None:
        first = asyncio.ensure_future(engine.call(gate.job, priority=Priority.BULK))
        await until_entered(gate)
        bulk = asyncio.ensure_future(engine.call(int, priority=Priority.BULK))
        await asyncio.sleep(0)
        with pytest.raises(QueueFullError):
            await engine.call(int, priority=Priority.BULK)
        step = asyncio.ensure_future(engine.call(int, "5", priority=Priority.DRIVE))
        await asyncio.sleep(0)
        gate.open()
        assert await step == 5
        await asyncio.gather(first, bulk)

    asyncio.run(ask())


def test_an_engine_whose_thread_ends_tells_those_who_wait(monkeypatch):
    def fail(_niceness: int) -> None:
        raise PermissionError("may not lower its niceness")

    monkeypatch.setattr("real2sim_server.service.engine.lower_priority", fail)
    engine, ended = Engine(), threading.Event()
    engine.on_failure = ended.set
    with pytest.raises(DeviceLostError, match="niceness"):
        engine.start()
    assert ended.wait(LIMIT_S)
    assert not engine.alive


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads are Linux's")
def test_an_engine_starts_at_a_niceness_that_it_may_not_lower():
    code = (
        "import os\n"
        f"os.nice({NICENESS + 1})\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "from real2sim_server.service.engine import Engine\n"
        "engine = Engine()\n"
        "engine.start()\n"
        "print(engine.call_sync(lambda: 'works', timeout_s=120))\n"
        "engine.stop()\n"
    )
    # While everything can still be read.
    import_first = "import numba, torch, real2sim_server.service.engine\nnumba.get_num_threads()\n"
    done = subprocess.run(
        [sys.executable, "-c", import_first + code],
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    assert done.stdout == "works\n", done.stderr[-2000:]


class Gathered:
    """Computes results of arguments that it was given in one go."""

    def __init__(self) -> None:
        self.calls: list[list[int]] = []

    def compute(self, arguments):
        self.calls.append(list(arguments))
        return [ZeroDivisionError() if n == 0 else 1 / n for n in arguments]


def waiting_together(engine, gate, calls):
    """Outcomes of calls that wait while the engine is busy."""

    async def ask():
        busy = asyncio.create_task(engine.call(gate.job))
        await until_entered(gate)
        tasks = [asyncio.ensure_future(call) for call in calls]
        await wait_until_async(
            lambda: engine.queue_depth == len(calls) or any(task.done() for task in tasks),
            "all calls to be queued",
        )
        gate.open()
        await busy
        return await asyncio.gather(*tasks, return_exceptions=True)

    return asyncio.run(ask())


def test_calls_of_one_key_that_wait_together_are_made_in_one_go_within_their_shares(make_engine):
    engine, gathered, key = make_engine(), Gathered(), object()
    options = {"share": 0.4, "label": "drive", "priority": Priority.DRIVE}
    calls = [
        engine.call_together(gathered.compute, n, key=key if n != 2 else object(), **options)
        for n in (1, 2, 4, 5)
    ]
    assert waiting_together(engine, Gate(), calls) == [1, 0.5, 0.25, 0.2]
    assert gathered.calls == [[1, 4], [2], [5]]


def test_what_is_raised_for_one_of_several_calls_reaches_its_caller_alone(make_engine):
    engine, gathered, key = make_engine(), Gathered(), object()
    options = {"share": 0.1, "label": "drive", "priority": Priority.DRIVE, "key": key}
    calls = [engine.call_together(gathered.compute, n, **options) for n in (2, 0, 4)]
    first, second, third = waiting_together(engine, Gate(), calls)
    assert (first, third) == (0.5, 0.25)
    assert isinstance(second, ZeroDivisionError)
    assert gathered.calls == [[2, 0, 4]]
    with pytest.raises(ZeroDivisionError):
        asyncio.run(engine.call_together(gathered.compute, 0, **options))
