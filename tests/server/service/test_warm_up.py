from __future__ import annotations

import asyncio
import time

import pytest

from real2sim_proto.episode import EgoSpec
from real2sim_server.service import warm_up
from real2sim_server.service.warm_up import KernelWarmUp
from real2sim_server.world import plans_ahead


async def nothing() -> None:
    pass


def is_waiting(work) -> bool:
    """Whether a coroutine does not end within a moment."""

    async def tried() -> bool:
        done, _ = await asyncio.wait({asyncio.ensure_future(work)}, timeout=0.05)
        return not done

    return asyncio.run(tried())


def test_only_ilqr_plans_ahead():
    trackers = ("pursuit", "lqr", "ilqr", "perfect")
    assert [t for t in trackers if plans_ahead(EgoSpec(tracker=t))] == ["ilqr"]


def test_episodes_with_other_trackers_wait_for_nothing():
    assert not is_waiting(KernelWarmUp().ready(EgoSpec(tracker="lqr")))


def test_an_episode_whose_tracker_plans_ahead_waits_for_its_kernels(monkeypatch):
    monkeypatch.setattr(warm_up, "planning_on_disk", lambda: True)
    ended = []

    def compiling() -> None:
        time.sleep(0.2)
        ended.append("compiled")

    monkeypatch.setattr(warm_up, "warm_up_planning", compiling)

    async def episode_while_compiling() -> None:
        kernels = KernelWarmUp()

        async def begin() -> None:
            await kernels.ready(EgoSpec(tracker="ilqr"))
            ended.append("begun")

        await asyncio.gather(begin(), kernels.run_planning())

    assert is_waiting(KernelWarmUp().ready(EgoSpec(tracker="ilqr")))
    asyncio.run(episode_while_compiling())
    assert ended == ["compiled", "begun"]


@pytest.mark.parametrize("part", ["run", "run_planning"])
def test_where_kernels_fail_nobody_waits_for_them(monkeypatch, part):
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
        await asyncio.wait_for(kernels.ready(EgoSpec(tracker="ilqr")), 1)

    asyncio.run(failed())


def test_on_the_first_run_another_process_compiles_beside_the_renderer(monkeypatch, tmp_path):
    monkeypatch.setattr(warm_up, "kernels_on_disk", lambda: False)
    monkeypatch.setattr(warm_up, "warm_up_world", lambda: None)
    left = tmp_path / "left"
    monkeypatch.setattr(warm_up, "_PROGRAM", f"open({str(left)!r}, 'w').write('done')")

    asyncio.run(KernelWarmUp().run(nothing))

    assert left.read_text() == "done"
