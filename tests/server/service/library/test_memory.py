"""The memory budget shared by scenes and assets."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from real2sim_proto import ErrorCode
from real2sim_server.scene import Asset, GaussianCloud
from real2sim_server.scene.io import read_scene_summary, save_asset, save_scene
from real2sim_server.service.engine import Engine
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.library.assets import AssetLibrary
from real2sim_server.service.library.scenes import MemoryBudget, SceneCache, SceneCatalog
from tests.waiting import wait_until_async


@pytest.fixture
def folder(tmp_path, tiny_scene):
    """Three assets of the same size."""
    for name in ("a", "b", "c"):
        cloud = tiny_scene.objects["car_red"].cloud
        asset = Asset(name, "car", (4.0, 2.0, 1.5), cloud, {"ambient": [0.2, 0.2, 0.2]})
        save_asset(asset, tmp_path / f"{name}.r2a")
    return tmp_path


@pytest.fixture
def one_asset(folder) -> int:
    return AssetLibrary(folder).get("a").nbytes


def test_the_least_recently_used_asset_is_evicted(folder, one_asset):
    budget = MemoryBudget(2 * one_asset)
    library = AssetLibrary(folder, budget)
    for name in ("a", "b", "a", "c"):
        library.find(name)
    assert library.held_bytes == 2 * one_asset
    assert sorted(library._alive) == ["a", "c"]


def test_an_asset_in_use_stays_in_memory_and_is_returned_again(folder, one_asset):
    library = AssetLibrary(folder, MemoryBudget(2 * one_asset))
    shown = library.find("a")
    for name in ("b", "c", "b"):
        library.find(name)
    assert library.held_bytes == 2 * one_asset
    assert library.find("a") is shown


def test_an_asset_over_the_budget_is_refused_with_its_size(folder, one_asset):
    library = AssetLibrary(folder, MemoryBudget(2 * one_asset))
    shown = [library.find("a"), library.find("b")]
    with pytest.raises(ServiceError, match="asset 'c' needs") as caught:
        library.find("c")
    assert caught.value.code is ErrorCode.OUT_OF_MEMORY
    assert caught.value.extra["needed_bytes"] == one_asset
    shown.pop()
    assert library.find("c") is not None


def test_relit_asset_colours_count_against_the_budget(folder, one_asset, tiny_scene):
    library = AssetLibrary(folder, MemoryBudget(10 * one_asset))
    asset = library.get("a")
    lit = asset.cloud_in(tiny_scene)
    assert library.held_bytes == one_asset + lit.sh.nbytes


def test_listing_assets_loads_none(folder):
    library = AssetLibrary(folder, MemoryBudget(1))
    assert [info.asset_id for info in library.list()] == ["a", "b", "c"]
    assert library.held_bytes == 0


def test_scenes_and_assets_evict_each_other(tiny_scene, tmp_path):
    scenes, assets = tmp_path / "scenes", tmp_path / "assets"
    save_scene(replace(tiny_scene, name="street"), scenes / "street.r2s")
    needed = read_scene_summary(scenes / "street.r2s").nbytes
    car = tiny_scene.objects["car_red"].cloud
    large = GaussianCloud.concatenate([car] * (needed // car.nbytes))
    save_asset(Asset("large", "car", (4.0, 2.0, 1.5), large), assets / "large.r2a")

    async def inside():
        engine = Engine()
        engine.start()
        budget = MemoryBudget(needed)
        cache = SceneCache(SceneCatalog(scenes), engine, budget=budget)
        library = AssetLibrary(assets, budget)

        def find() -> None:
            assert library.find("large") is not None

        try:
            await asyncio.to_thread(find)
            await cache.get("street")
            after_scene = (library.held_bytes, cache.held_bytes > 0)
            await asyncio.to_thread(find)
            after_asset = (large.nbytes, 0)
            await wait_until_async(
                lambda: (library.held_bytes, cache.held_bytes) == after_asset, "the scene to go"
            )
            return after_scene
        finally:
            cache.close()
            await asyncio.to_thread(engine.stop)

    assert asyncio.run(inside()) == (0, True)
