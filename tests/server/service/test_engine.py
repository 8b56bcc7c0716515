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
    """A job that blocks the engine until it is opened."""

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


def test_an_engine_survives_the_end_of_the_calling_event_loop(make_engine):
    engine, gate = make_engine(), Gate()

    async def ask_and_leave() -> None:
        # No other reference, and never cancelled, as when a loop is stopped abruptly.
        asyncio.ensure_future(engine.call(gate.job))  # noqa: RUF006
        await until_entered(gate)

    loop = asyncio.new_event_loop()
    loop.run_until_complete(ask_and_leave())
    loop.close()
    gate.open()
    assert engine.call_sync(int, "7") == 7


def test_all_jobs_run_on_one_thread_other_than_the_callers(make_engine):
    engine = make_engine()

    async def ask() -> list[int]:
        return await asyncio.gather(*(engine.call(threading.get_ident) for _ in range(5)))

    idents = set(asyncio.run(ask()))
    assert len(idents) == 1
    assert threading.get_ident() not in idents


def test_jobs_run_in_submission_order(make_engine):
    engine = make_engine()
    order: list[int] = []

    async def ask() -> None:
        await asyncio.gather(*(engine.call(order.append, i) for i in range(50)))

    asyncio.run(ask())
    assert order == list(range(50))


def test_an_exception_reaches_the_caller_and_the_engine_continues(make_engine):
    engine = make_engine()
    with pytest.raises(ZeroDivisionError):
        asyncio.run(engine.call(divmod, 1, 0))
    assert engine.call_sync(abs, -1) == 1


def test_cancelling_a_caller_removes_its_waiting_job(make_engine):
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


def test_a_running_job_finishes_after_its_caller_was_cancelled(make_engine):
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


def test_a_full_queue_refuses_immediately_with_the_limit(make_engine):
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


def test_stop_finishes_waiting_jobs(make_engine):
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


def test_stop_without_draining_refuses_waiting_jobs(make_engine):
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


def test_a_stop_timeout_names_the_running_job(make_engine):
    engine, gate = make_engine(), Gate()
    caller = threading.Thread(target=engine.call_sync, args=(gate.job,), kwargs={"label": "slow"})
    caller.start()
    assert gate.entered.wait(LIMIT_S)
    with pytest.raises(TimeoutError, match="'slow' still runs"):
        engine.stop(timeout_s=0.05)
    gate.open()
    caller.join(LIMIT_S)


def test_a_job_can_call_the_engine_recursively(make_engine):
    engine = make_engine()
    assert engine.call_sync(lambda: engine.call_sync(lambda: "inner")) == "inner"


def test_call_sync_times_out(make_engine):
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


def test_a_sticky_device_error_stops_the_engine_and_fails_all_jobs(make_engine):
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


def test_running_out_of_device_memory_does_not_stop_the_engine(make_engine):
    engine = make_engine()

    def allocate() -> None:
        raise torch.OutOfMemoryError("CUDA error: out of memory")

    with pytest.raises(torch.OutOfMemoryError):
        engine.call_sync(allocate)
    assert engine.alive


def test_jobs_are_reported_with_label_and_durations():
    reports: list[tuple[str, float, float]] = []
    engine = Engine(on_job=lambda *report: reports.append(report))
    engine.start()
    engine.call_sync(time.sleep, 0.02, label="nap")
    engine.stop()
    label, waited, ran = reports[-1]
    assert label == "nap"
    assert ran >= 0.02
    assert waited >= 0


def test_a_long_job_yields_to_a_drive_step(make_engine):
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


def test_a_failing_step_does_not_affect_the_job_that_yielded(make_engine):
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


def test_yielding_on_another_thread_runs_nothing(make_engine):
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


def test_a_full_priority_queue_leaves_room_in_the_others(make_engine):
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


def test_an_engine_whose_thread_fails_reports_the_failure(monkeypatch):
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
def test_an_engine_starts_if_it_cannot_change_its_niceness():
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
    # Import first: after setuid the files may not be readable.
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
    """Computes a batch of results, and records the batches."""

    def __init__(self) -> None:
        self.calls: list[list[int]] = []

    def compute(self, arguments):
        self.calls.append(list(arguments))
        return [ZeroDivisionError() if n == 0 else 1 / n for n in arguments]


def waiting_together(engine, gate, calls):
    """Results of calls that queue up while the engine is busy."""

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


def test_waiting_calls_with_one_key_are_batched_up_to_their_shares(make_engine):
    engine, gathered, key = make_engine(), Gathered(), object()
    options = {"share": 0.4, "label": "drive", "priority": Priority.DRIVE}
    calls = [
        engine.call_together(gathered.compute, n, key=key if n != 2 else object(), **options)
        for n in (1, 2, 4, 5)
    ]
    assert waiting_together(engine, Gate(), calls) == [1, 0.5, 0.25, 0.2]
    assert gathered.calls == [[1, 4], [2], [5]]


def test_an_error_in_a_batch_reaches_only_its_caller(make_engine):
    engine, gathered, key = make_engine(), Gathered(), object()
    options = {"share": 0.1, "label": "drive", "priority": Priority.DRIVE, "key": key}
    calls = [engine.call_together(gathered.compute, n, **options) for n in (2, 0, 4)]
    first, second, third = waiting_together(engine, Gate(), calls)
    assert (first, third) == (0.5, 0.25)
    assert isinstance(second, ZeroDivisionError)
    assert gathered.calls == [[2, 0, 4]]
    with pytest.raises(ZeroDivisionError):
        asyncio.run(engine.call_together(gathered.compute, 0, **options))
