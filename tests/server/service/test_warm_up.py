from __future__ import annotations

import asyncio
import threading
from fnmatch import fnmatch

import pytest

from real2sim_proto.episode import ContactSpec, EgoSpec, ResetSpec, SensorSpec
from real2sim_server._numba import Made
from real2sim_server.service import preflight, warm_up
from real2sim_server.service.warm_up import KernelWarmUp
from real2sim_server.world import plans_ahead
from real2sim_server.world.driving import advance_vehicle
from tests.waiting import LIMIT_S, wait_until_async


def episode(tracker: str) -> ResetSpec:
    return ResetSpec(ego=EgoSpec(tracker=tracker))


async def nothing() -> None:
    pass


def test_only_ilqr_plans_ahead():
    trackers = ("pursuit", "lqr", "ilqr", "perfect")
    assert [t for t in trackers if plans_ahead(EgoSpec(tracker=t))] == ["ilqr"]


def test_episodes_with_other_trackers_do_not_wait_for_kernels():
    asyncio.run(KernelWarmUp().ready(episode("lqr")))


def test_an_episode_with_a_planning_tracker_waits_for_its_kernels(monkeypatch):
    monkeypatch.setattr(warm_up, "planning_on_disk", lambda: True)
    ended, begun, go_on = [], threading.Event(), threading.Event()

    def compiling() -> None:
        begun.set()
        assert go_on.wait(LIMIT_S)
        ended.append("compiled")

    monkeypatch.setattr(warm_up, "warm_up_planning", compiling)

    async def episode_while_compiling() -> None:
        kernels = KernelWarmUp()

        async def begin() -> None:
            await kernels.ready(episode("ilqr"))
            ended.append("begun")

        both = asyncio.gather(begin(), kernels.run_planning())
        await wait_until_async(begun.is_set, "the compiler")
        assert ended == []
        go_on.set()
        await both

    asyncio.run(episode_while_compiling())
    assert ended == ["compiled", "begun"]


@pytest.mark.parametrize("part", ["run", "run_planning"])
def test_episodes_do_not_wait_for_kernels_that_failed(monkeypatch, part):
    def fail() -> None:
        raise RuntimeError("no compiler")

    for name in ("warm_up_world", "warm_up_planning"):
        monkeypatch.setattr(warm_up, name, fail)
    for name in ("kernels_on_disk", "planning_on_disk"):
        monkeypatch.setattr(warm_up, name, lambda: True)
    kernels = KernelWarmUp()

    async def failed() -> None:
        with pytest.raises(RuntimeError, match="no compiler"):
            await (kernels.run(nothing) if part == "run" else kernels.run_planning())
        await kernels.ready(episode("ilqr"))

    asyncio.run(failed())


def test_deformation_kernels_are_compiled_on_the_first_episode_that_may_need_them(monkeypatch):
    made = []
    monkeypatch.setattr(warm_up, "deformation_on_disk", lambda: True)
    monkeypatch.setattr(warm_up, "warm_up_deformation", lambda: made.append("kernels"))
    crash = ResetSpec(sensors=[SensorSpec(camera="front")], on_collision="continue")
    without = [
        crash.model_copy(update=change)
        for change in (
            {"sensors": []},
            {"on_collision": "terminate"},
            {"contact": ContactSpec(dents=False)},
        )
    ]

    async def begin() -> None:
        kernels = KernelWarmUp()
        for spec in without:
            await kernels.ready(spec)
        assert kernels.deformation._making is None
        for _ in range(2):
            await kernels.ready(crash)
        await kernels.deformation.wait()
        assert kernels.deformation.ready

    asyncio.run(begin())
    assert made == ["kernels"]


def test_images_are_rendered_if_deformation_kernels_fail(monkeypatch):
    def fail() -> None:
        raise RuntimeError("no compiler")

    monkeypatch.setattr(warm_up, "deformation_on_disk", lambda: True)
    monkeypatch.setattr(warm_up, "warm_up_deformation", fail)

    async def wait() -> bool:
        kernels = warm_up.DeformationKernels()
        await kernels.wait()
        return kernels.ready

    assert asyncio.run(wait())


def test_the_first_run_compiles_in_a_second_process(monkeypatch, tmp_path):
    monkeypatch.setattr(warm_up, "kernels_on_disk", lambda: False)
    monkeypatch.setattr(warm_up, "warm_up_world", lambda: None)
    left = tmp_path / "left"
    monkeypatch.setattr(preflight, "_PROGRAM", f"open({str(left)!r}, 'w').write('done')")

    asyncio.run(KernelWarmUp().run(nothing))

    assert left.read_text() == "done"


def test_progress_includes_kernels_compiled_by_the_second_process(monkeypatch):
    program = "import sys; print('1 28'); print('2 28', flush=True); sys.stdin.read()"
    monkeypatch.setattr(preflight, "_PROGRAM", program)
    monkeypatch.setattr(warm_up, "kernels_on_disk", lambda: False)
    monkeypatch.setattr(warm_up, "made", Made(3, 12))
    monkeypatch.setattr(warm_up, "warm_up_world", lambda: None)
    kernels, told = KernelWarmUp(), []

    async def drawing() -> None:
        await wait_until_async(lambda: "5 of 40" in (kernels.compiling() or ""), "the count")
        told.append(kernels.compiling())

    asyncio.run(kernels.run(drawing))

    assert told == ["compiling kernels, on the first run only: 5 of 40"]


@pytest.mark.slow
def test_the_second_process_reports_its_compiled_kernels(worker_kernels):
    process = preflight.compile_in_background("warm_up")
    written, _ = process.communicate(timeout=LIMIT_S)
    assert written.split()[-2:] == [b"28", b"28"]


@pytest.mark.parametrize("kept", [[], ["world/entries.advance_vehicle-69.py311.nbi"]])
def test_compilation_starts_before_imports_if_no_kernels_are_cached(monkeypatch, tmp_path, kept):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(preflight, "_PROGRAM", "")
    for name in kept:
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()

    preflight.begin_compiling()

    process = preflight.take_begun()
    assert (process is None) == bool(kept)
    if process is not None:
        process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0


def test_the_cache_file_pattern_matches_numbas_name():
    index = advance_vehicle._cache._impl.filename_base
    assert fnmatch(f"{index}.py311.nbi", preflight.KEPT)


def test_a_worker_that_stops_early_terminates_the_second_process(monkeypatch):
    monkeypatch.setattr(preflight, "_PROGRAM", "import time; time.sleep(3600)")
    process = preflight.compile_in_background("warm_up")
    monkeypatch.setattr(preflight, "_begun", [process])

    async def ended_early() -> None:
        task = asyncio.ensure_future(KernelWarmUp().run(nothing))
        await wait_until_async(lambda: not preflight._begun, "the worker to wait for it")
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(ended_early())
    assert process.returncode is not None
