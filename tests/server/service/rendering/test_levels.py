"""Detail levels for small images: their memory, and their construction off the engine thread."""

from __future__ import annotations

import asyncio
import threading

import pytest

from real2sim_proto.episode import SensorSpec
from real2sim_server.edit import ScenarioState, instances_at_start
from real2sim_server.render import levels_bytes, scene_levels_bytes, select_backend
from real2sim_server.render._cpu import detail_levels
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.library.scenes import MemoryBudget
from real2sim_server.service.render_background import DetailLevels

from ...conftest import make_tiny_scene
from ..waiting import wait_ready

SMALL = {"action": "control", "sensors": [{"camera": "front", "detail": "auto"}]}


@pytest.fixture
def makers(monkeypatch) -> list[str]:
    """Names of the threads that built detail levels."""
    names: list[str] = []
    make = detail_levels.make_hierarchy

    def noted(*cloud):
        names.append(threading.current_thread().name)
        return make(*cloud)

    monkeypatch.setattr(detail_levels, "make_hierarchy", noted)
    return names


def make_ready(scene, levels: DetailLevels, **sensor: object) -> None:
    spec = SensorSpec(camera="front", **({"detail": "auto"} | sensor))
    camera = scene.rig["front"].resized(spec.width or scene.rig["front"].width)
    things = instances_at_start(scene, ScenarioState.of(scene))
    try:
        asyncio.run(levels.ready([spec], [camera], lambda: things))
    finally:
        levels.close()


@pytest.mark.network
def test_a_session_with_a_small_camera_builds_levels_off_the_engine_thread(client, makers):
    wait_ready(client)
    client.portal.call(client.app.state.worker.renderer.small_images.ready)
    makers.clear()
    made = client.post("/v1/sessions", params={"scene": "tiny"}, json={"reset": SMALL})
    assert made.status_code == 201, made.text
    assert len(makers) == 4
    assert all(name.startswith("levels") for name in makers)
    session, token = made.json()["session_id"], made.json()["token"]
    worker = client.app.state.worker
    held = worker.renderer.levels.held_bytes
    assert held > 0
    free = worker.scene_cache.budget.total_bytes - worker.scene_cache.budget.free_bytes
    assert free >= held + worker.scene_cache.resident_bytes
    seen = client.post(
        f"/v1/sessions/{session}/step",
        json={"plan": {"kind": "control", "acceleration": 1.0, "steering": 0.0}},
        headers={"Authorization": f"Bearer {token}"},
    )
    assert seen.status_code == 200, seen.text
    assert len(makers) == 4


@pytest.mark.network
def test_an_edit_of_a_running_world_builds_levels_off_the_engine_thread(client, makers):
    wait_ready(client)
    made = client.post("/v1/sessions", params={"scene": "tiny"}, json={"reset": SMALL}).json()
    session = f"/v1/sessions/{made['session_id']}"
    headers = {"Authorization": f"Bearer {made['token']}"}
    makers.clear()
    region = {"op": "erase_region", "pose": {"position": [8, 0, 0]}, "size": [4, 4, 4]}
    edited = client.post(f"{session}/operations", json={"operations": [region]}, headers=headers)
    assert edited.status_code == 200, edited.text
    assert len(makers) == 1
    assert makers[0].startswith("levels")
    view = {"sensors": SMALL["sensors"]}
    assert client.post(f"{session}/render", json=view, headers=headers).status_code == 200
    assert len(makers) == 1


def test_level_memory_is_counted_per_scene(tiny_scene, makers):
    budget = MemoryBudget(10**9)
    levels = DetailLevels(select_backend("cpu"), budget)
    before = levels_bytes()
    known = scene_levels_bytes(tiny_scene)
    make_ready(tiny_scene, levels)
    assert scene_levels_bytes(tiny_scene) > 0
    assert levels_bytes() - before == scene_levels_bytes(tiny_scene) - known
    assert budget.free_bytes == 10**9 - levels_bytes()


@pytest.mark.parametrize("sensor", [{"detail": "full"}, {"width": 1000}])
def test_full_detail_and_large_images_need_no_levels(makers, sensor):
    make_ready(make_tiny_scene(), DetailLevels(select_backend("cpu")), **sensor)
    assert makers == []


def test_levels_over_the_memory_budget_are_refused(makers):
    levels = DetailLevels(select_backend("cpu"), MemoryBudget(1000))
    with pytest.raises(ServiceError, match="small images") as refused:
        make_ready(make_tiny_scene(), levels)
    assert refused.value.code == "OUT_OF_MEMORY"
    assert makers == []
    assert levels.held_bytes == levels_bytes()
