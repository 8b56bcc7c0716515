from __future__ import annotations

import asyncio
import threading
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import SceneState
from real2sim_server.scene.io import read_scene_summary, save_scene
from real2sim_server.service.engine import Engine
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.library import scenes as scene_cache_module
from real2sim_server.service.library.scenes import MemoryBudget, SceneCache, SceneCatalog

NAMES = ("a", "b", "c")


@pytest.fixture
def folder(tmp_path, tiny_scene):
    for name in NAMES:
        save_scene(replace(tiny_scene, name=name), tmp_path / f"{name}.r2s")
    return tmp_path


@pytest.fixture
def one_scene(folder) -> int:
    return read_scene_summary(folder / "a.r2s").nbytes


def run(folder, work, *, budget_bytes: int = 10**9):
    """Run ``work(scene_cache)`` with a separate engine."""

    @asynccontextmanager
    async def running():
        engine = Engine()
        engine.start()
        scene_cache = SceneCache(SceneCatalog(folder), engine, budget=MemoryBudget(budget_bytes))
        try:
            yield scene_cache
        finally:
            scene_cache.close()
            await asyncio.to_thread(engine.stop)

    async def inside():
        async with running() as scene_cache:
            return await work(scene_cache)

    return asyncio.run(inside())


def resident(scene_cache) -> list[str]:
    return [name for name in NAMES if scene_cache.state(name) is SceneState.RESIDENT]


def test_a_scene_is_loaded_on_first_use(folder):
    async def work(scene_cache):
        await scene_cache.refresh()
        before = scene_cache.state("a")
        scene = await scene_cache.get("a")
        return before, scene_cache.state("a"), len(scene.objects)

    assert run(folder, work) == (SceneState.AVAILABLE, SceneState.RESIDENT, 3)


def test_all_users_share_one_scene_object_loaded_once(folder, monkeypatch):
    loads = []
    load = scene_cache_module.load_scene
    monkeypatch.setattr(
        scene_cache_module, "load_scene", lambda path: loads.append(path) or load(path)
    )

    async def work(scene_cache):
        return await asyncio.gather(*(scene_cache.get("a") for _ in range(5)))

    scenes = run(folder, work)
    assert all(scene is scenes[0] for scene in scenes)
    assert len(loads) == 1


def test_the_state_is_loading_while_a_scene_is_read(folder):
    async def work(scene_cache):
        task = asyncio.create_task(scene_cache.get("a"))
        states = set()
        while not task.done():
            states.add(scene_cache.state("a"))
            await asyncio.sleep(0)
        return states

    assert SceneState.LOADING in run(folder, work)


def test_cancelling_one_waiter_does_not_cancel_the_load(folder):
    async def work(scene_cache):
        first = asyncio.create_task(scene_cache.get("a"))
        second = asyncio.create_task(scene_cache.get("a"))
        while scene_cache.state("a") is not SceneState.LOADING:
            await asyncio.sleep(0)
        first.cancel()
        return await second

    assert run(folder, work).name == "a"


def test_the_least_recently_used_scene_is_evicted(folder, one_scene):
    async def work(scene_cache):
        for name in ("a", "b", "a", "c"):
            await scene_cache.get(name)
        return resident(scene_cache)

    assert run(folder, work, budget_bytes=2 * one_scene) == ["a", "c"]


def test_a_pinned_scene_is_never_evicted(folder, one_scene):
    async def work(scene_cache):
        await scene_cache.pin("a")
        for name in ("b", "c"):
            await scene_cache.get(name)
        return resident(scene_cache)

    assert run(folder, work, budget_bytes=2 * one_scene) == ["a", "c"]


def test_a_scene_is_refused_with_its_size_if_all_others_are_pinned(folder, one_scene):
    async def work(scene_cache):
        await scene_cache.pin("a")
        with pytest.raises(ServiceError) as caught:
            await scene_cache.get("b")
        return caught.value, resident(scene_cache)

    error, left = run(folder, work, budget_bytes=one_scene + 10)
    assert error.code is ErrorCode.OUT_OF_MEMORY
    assert error.extra["needed_bytes"] == one_scene
    assert left == ["a"]


def test_an_unpinned_scene_can_be_evicted(folder, one_scene):
    async def work(scene_cache):
        async with scene_cache.pinned("a"):
            pass
        await scene_cache.get("b")
        return resident(scene_cache)

    assert run(folder, work, budget_bytes=one_scene + 10) == ["b"]


def test_a_scene_over_the_budget_is_refused_and_evicts_nothing(folder, one_scene, tiny_scene):
    big = replace(tiny_scene, name="big", background=tiny_scene.background.with_sh_degree(3))
    save_scene(big, folder / "big.r2s")

    async def work(scene_cache):
        await scene_cache.get("a")
        with pytest.raises(ServiceError, match=f"the budget is {one_scene + 10}") as caught:
            await scene_cache.get("big")
        return caught.value.code, resident(scene_cache)

    assert run(folder, work, budget_bytes=one_scene + 10) == (ErrorCode.OUT_OF_MEMORY, ["a"])


def test_loads_in_progress_count_against_the_budget(folder, one_scene, monkeypatch):
    go_on, load = threading.Event(), scene_cache_module.load_scene
    monkeypatch.setattr(
        scene_cache_module, "load_scene", lambda path: go_on.wait(60) and load(path)
    )

    async def work(scene_cache):
        asked = [asyncio.create_task(scene_cache.get(name)) for name in NAMES]
        (refused,), loading = await asyncio.wait(asked, return_when=asyncio.FIRST_COMPLETED)
        go_on.set()
        await asyncio.gather(*loading)
        return refused.exception()

    assert run(folder, work, budget_bytes=2 * one_scene).code == ErrorCode.OUT_OF_MEMORY


def test_a_scene_in_use_is_not_unloaded(folder):
    async def work(scene_cache):
        await scene_cache.pin("a")
        with pytest.raises(ServiceError, match="1 sessions use scene 'a'") as caught:
            await scene_cache.unload("a")
        scene_cache.unpin("a")
        await scene_cache.unload("a")
        return caught.value.code, scene_cache.state("a")

    assert run(folder, work) == (ErrorCode.SCENE_IN_USE, SceneState.AVAILABLE)


def test_an_unknown_scene_is_refused_with_the_available_names(folder):
    async def work(scene_cache):
        await scene_cache.get("zzz")

    with pytest.raises(ServiceError, match="there are: a, b, c") as caught:
        run(folder, work)
    assert caught.value.code is ErrorCode.UNKNOWN_SCENE


def test_a_corrupt_bundle_is_detected_on_load_and_others_still_load(folder):
    tensors = folder / "a.r2s" / "background.safetensors"
    content = bytearray(tensors.read_bytes())
    content[-5] ^= 0xFF
    tensors.write_bytes(content)

    async def work(scene_cache):
        await scene_cache.refresh()
        before = scene_cache.state("a")
        with pytest.raises(ServiceError) as caught:
            await scene_cache.get("a")
        await scene_cache.get("b")
        return before, caught.value.code, scene_cache.state("a")

    broken = (SceneState.AVAILABLE, ErrorCode.SCENE_BROKEN, SceneState.BROKEN)
    assert run(folder, work) == broken


def test_a_scene_added_later_is_found(folder, tiny_scene):
    async def work(scene_cache):
        await scene_cache.refresh()
        save_scene(replace(tiny_scene, name="late"), folder / "late.r2s")
        return await scene_cache.get("late")

    assert run(folder, work).name == "late"
