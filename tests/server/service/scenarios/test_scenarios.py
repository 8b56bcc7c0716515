from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto import ErrorCode, decode
from real2sim_proto.scenarios import History, OperationResult, ScenarioInfo
from real2sim_server.edit import replay_operations
from real2sim_server.scene.io import save_scene
from real2sim_server.service import scenario_cache
from real2sim_server.service.storage.store import StoreError

DELETE_RED = {"op": "delete", "object_id": "car_red"}
MOVE_POST = {"op": "translate", "object_id": "post", "x": 1.5}
COPY_RED = {"op": "duplicate", "object_id": "car_red", "new_id": "twin", "y": 6.0}


def create(client, **body) -> ScenarioInfo:
    response = client.post("/v1/scenarios", json={"scene": "tiny"} | body)
    assert response.status_code == 201, response.text
    return ScenarioInfo.model_validate(response.json())


def edit(client, scenario, *operations, headers=None, **body):
    url = f"/v1/scenarios/{scenario.scenario_id}/operations"
    return client.post(url, json={"operations": list(operations)} | body, headers=headers or {})


def shown(client, scenario) -> dict[str, dict]:
    info = client.get(f"/v1/scenarios/{scenario.scenario_id}").json()
    return {o["object_id"]: o for o in info["objects"]}


def act(client, scenario, name, **headers):
    return client.post(f"/v1/scenarios/{scenario.scenario_id}/{name}", headers=headers)


def test_a_new_scenario_shows_the_scene_as_recorded(client):
    response = client.post("/v1/scenarios", json={"scene": "tiny", "name": "cut-in"})
    info = ScenarioInfo.model_validate(response.json())
    assert response.headers["Location"] == f"/v1/scenarios/{info.scenario_id}"
    assert response.headers["ETag"] == info.etag == '"r0"'
    assert (info.name, info.scene, info.revision) == ("cut-in", "tiny", 0)
    assert [o.object_id for o in info.objects] == ["car_red", "car_blue", "post"]
    assert not info.can_undo
    assert not info.can_redo


def test_operations_are_applied_and_increase_the_revision(client):
    scenario = create(client)
    response = edit(client, scenario, DELETE_RED, MOVE_POST)
    result = OperationResult.model_validate(response.json())
    assert result.revision == 1
    assert response.headers["ETag"] == result.etag == '"r1"'
    objects = shown(client, scenario)
    assert set(objects) == {"car_blue", "post"}
    assert objects["post"]["trajectory"]["positions"][0] == [11.5, 3.5, 1.0]


def test_an_edit_returns_created_objects_inverse_and_warnings(client):
    scenario = create(client)
    overlapping = COPY_RED | {"y": 1.0}
    result = OperationResult.model_validate(edit(client, scenario, overlapping).json())
    assert result.created == ["twin"]
    assert [o.op for o in result.inverse] == ["delete"]
    assert "overlap" in {w.code for w in result.warnings}
    assert shown(client, scenario)["twin"]["instance_id"] == 4


def test_a_batch_is_applied_completely_or_not_at_all(client):
    scenario = create(client)
    response = edit(client, scenario, MOVE_POST, DELETE_RED | {"object_id": "nobody"})
    assert response.status_code == 404
    assert response.json()["code"] == ErrorCode.UNKNOWN_OBJECT
    assert response.json()["errors"][0]["pointer"] == "/operations/1"
    assert shown(client, scenario)["post"]["trajectory"]["positions"][0] == [10.0, 3.5, 1.0]


def test_a_dry_run_changes_nothing(client):
    scenario = create(client)
    result = edit(client, scenario, COPY_RED, dry_run=True).json()
    assert (result["dry_run"], result["created"], result["revision"]) == (True, ["twin"], 0)
    assert "twin" not in shown(client, scenario)
    assert edit(client, scenario, MOVE_POST).json()["revision"] == 1


def test_an_edit_for_the_current_revision_is_accepted(client):
    scenario = create(client)
    assert edit(client, scenario, MOVE_POST, headers={"If-Match": '"r0"'}).status_code == 200
    assert edit(client, scenario, MOVE_POST, headers={"If-Match": "*"}).status_code == 200


def test_a_stale_edit_is_refused_with_the_missed_operations(client):
    scenario = create(client)
    edit(client, scenario, MOVE_POST)
    edit(client, scenario, DELETE_RED)
    response = edit(client, scenario, MOVE_POST, headers={"If-Match": '"r1"'})
    assert response.status_code == 412
    assert response.headers["ETag"] == '"r2"'
    problem = response.json()
    assert problem["code"] == ErrorCode.STALE_REVISION
    assert problem["revision"] == 2
    assert [e["operations"] for e in problem["missed"]] == [[DELETE_RED]]


@pytest.mark.parametrize("name", ["undo", "redo"])
def test_undo_and_redo_are_refused_when_stale(client, name):
    scenario = create(client)
    edit(client, scenario, MOVE_POST)
    response = act(client, scenario, name, **{"If-Match": '"r0"'})
    assert response.json()["code"] == ErrorCode.STALE_REVISION


@pytest.mark.parametrize("tag", ["r1", "1", '"1"', 'W/"r1"', '"r-1"', '"r1", "r2"'])
def test_an_invalid_if_match_is_refused(client, tag):
    response = edit(client, create(client), MOVE_POST, headers={"If-Match": tag})
    assert response.json()["code"] == ErrorCode.INVALID_REQUEST


def test_undo_and_redo_restore_states(client):
    scenario = create(client)
    edit(client, scenario, DELETE_RED)
    undone = act(client, scenario, "undo").json()
    assert (undone["revision"], undone["etag"]) == (2, '"r2"')
    assert "car_red" in shown(client, scenario)
    assert act(client, scenario, "redo").json()["revision"] == 3
    assert "car_red" not in shown(client, scenario)


def test_a_new_scenario_has_nothing_to_undo_or_redo(client):
    scenario = create(client)
    assert act(client, scenario, "undo").json()["code"] == ErrorCode.NOTHING_TO_UNDO
    assert act(client, scenario, "redo").json()["code"] == ErrorCode.NOTHING_TO_REDO


def test_the_history_lists_every_revision(client):
    scenario = create(client)
    edit(client, scenario, DELETE_RED)
    act(client, scenario, "undo")
    url = f"/v1/scenarios/{scenario.scenario_id}/operations"
    history = History.model_validate(client.get(url).json())
    assert [(e.revision, e.kind, e.target) for e in history.entries] == [
        (1, "edit", None),
        (2, "undo", 1),
    ]
    assert (history.revision, history.can_undo, history.can_redo) == (2, False, True)
    assert [e["revision"] for e in client.get(f"{url}?after=1").json()["entries"]] == [2]


def test_the_list_includes_revision_and_undo_state(client):
    first, second = create(client, name="a"), create(client, name="b")
    edit(client, first, MOVE_POST)
    edit(client, first, DELETE_RED)
    act(client, first, "undo")
    edit(client, second, MOVE_POST)
    listed = client.get("/v1/scenarios").json()["scenarios"]
    assert [(s["name"], s["revision"], s["can_undo"], s["can_redo"]) for s in listed] == [
        ("a", 3, True, True),
        ("b", 1, True, False),
    ]


def test_a_deleted_scenario_is_gone(client):
    scenario = create(client)
    url = f"/v1/scenarios/{scenario.scenario_id}"
    assert client.delete(url).status_code == 204
    for response in (client.get(url), client.delete(url), edit(client, scenario, MOVE_POST)):
        assert response.json()["code"] == ErrorCode.UNKNOWN_SCENARIO
    assert client.get("/v1/scenarios").json()["scenarios"] == []


def test_a_scenario_on_an_unknown_or_broken_scene_is_refused(client, scenes_dir):
    (scenes_dir / "empty.r2s").mkdir()
    unknown = client.post("/v1/scenarios", json={"scene": "zzz"})
    assert unknown.json()["code"] == ErrorCode.UNKNOWN_SCENE
    broken = client.post("/v1/scenarios", json={"scene": "empty"})
    assert broken.json()["code"] == ErrorCode.SCENE_BROKEN


@pytest.mark.parametrize(
    ("operation", "pointer"),
    [
        ({"op": "fly", "object_id": "post"}, "/operations/0"),
        (
            {"op": "rotate", "object_id": "post", "angle": 1, "axis": [0, 0, 0]},
            "/operations/0/axis",
        ),
        (
            {"op": "set_pose", "object_id": "post", "pose": {"position": [1, 2]}},
            "/operations/0/pose/position/2",
        ),
        (
            {
                "op": "set_pose",
                "object_id": "post",
                "pose": {"position": [0, 0, 0], "quaternion": [1, 1, 0, 0]},
            },
            "/operations/0/pose/quaternion",
        ),
    ],
)
def test_invalid_operations_are_refused_with_a_pointer(client, operation, pointer):
    response = edit(client, create(client), operation)
    assert response.status_code == 422
    assert response.json()["errors"][0]["pointer"] == pointer


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e400"])
def test_non_finite_numbers_are_refused(client, value):
    scenario = create(client)
    response = client.post(
        f"/v1/scenarios/{scenario.scenario_id}/operations",
        content=f'{{"operations": [{{"op": "translate", "object_id": "post", "x": {value}}}]}}',
        headers={"Content-Type": "application/json"},
    )
    assert response.json()["code"] == ErrorCode.INVALID_REQUEST


def test_too_many_operations_are_refused(client):
    response = edit(client, create(client), *[MOVE_POST] * 257)
    assert response.json()["code"] == ErrorCode.INVALID_REQUEST


def test_a_preview_shows_the_edits(client):
    scenario = create(client)
    url = f"/v1/scenarios/{scenario.scenario_id}/preview?camera=front&modality=instance"

    def seen() -> set[int]:
        frame = decode(client.get(url, headers={"Accept": "application/msgpack"}).content)
        return set(np.frombuffer(frame["data"], frame["dtype"]).tolist())

    assert seen() >= {1, 2}
    edit(client, scenario, DELETE_RED)
    assert 1 not in seen()
    edit(client, scenario, COPY_RED | {"object_id": "car_blue", "new_id": "t", "x": 4, "y": -3})
    assert 4 in seen()


def test_a_preview_reports_its_revision(client):
    scenario = create(client)
    edit(client, scenario, MOVE_POST)
    response = client.get(f"/v1/scenarios/{scenario.scenario_id}/preview?camera=front&width=48")
    assert response.headers["X-Real2Sim-Revision"] == '"r1"'
    assert response.headers["Content-Type"] == "image/jpeg"


def test_scenarios_survive_a_worker_restart(start_worker, run_worker):
    with run_worker() as first:
        scenario = create(first, name="kept")
        edit(first, scenario, DELETE_RED, MOVE_POST)
        edit(first, scenario, COPY_RED | {"object_id": "car_blue"})
        act(first, scenario, "undo")
        before = first.get(f"/v1/scenarios/{scenario.scenario_id}").json()
    second = start_worker()
    assert second.get(f"/v1/scenarios/{scenario.scenario_id}").json() == before
    assert act(second, scenario, "redo").json()["revision"] == 4
    assert set(shown(second, scenario)) == {"car_blue", "post", "twin"}


@pytest.mark.parametrize("damage", [None, b"no state", b""])
def test_a_snapshot_saves_replaying_but_is_optional(run_worker, start_worker, monkeypatch, damage):
    monkeypatch.setattr(scenario_cache, "INTERVAL", 2)
    with run_worker() as first:
        scenario = create(first)
        for operation in (DELETE_RED, MOVE_POST, COPY_RED | {"object_id": "car_blue"}):
            edit(first, scenario, operation)
        before = first.get(f"/v1/scenarios/{scenario.scenario_id}").json()
        store = first.app.state.worker.store
        first.portal.call(first.app.state.worker.scenarios.flush)
        kept = first.portal.call(store.snapshot, scenario.scenario_id)
        assert kept.revision == 2
        if damage is not None:
            first.portal.call(store.save_snapshot, replace(kept, state=damage))
    replayed = []
    monkeypatch.setattr(
        "real2sim_server.edit.scenario.replay_operations",
        lambda state, operations: (
            replayed.append(operations) or replay_operations(state, operations)
        ),
    )
    second = start_worker()

    assert second.get(f"/v1/scenarios/{scenario.scenario_id}").json() == before
    assert len(replayed) == (1 if damage is None else 3)
    assert [act(second, scenario, "undo").status_code for _ in range(4)] == [200, 200, 200, 409]
    assert set(shown(second, scenario)) == {"car_red", "car_blue", "post"}


def test_an_edit_that_cannot_be_recorded_has_no_effect(client, monkeypatch):
    scenario = create(client)

    def fail(*_args, **_kwargs):
        raise StoreError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(client.app.state.worker.store, "record_revision", fail)
        assert edit(client, scenario, DELETE_RED).status_code == 500
    assert "car_red" in shown(client, scenario)
    assert edit(client, scenario, DELETE_RED).json()["revision"] == 1


def test_concurrent_edits_are_applied_one_after_the_other(client):
    scenario = create(client)
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda _: edit(client, scenario, MOVE_POST).json(), range(16)))
    assert sorted(r["revision"] for r in results) == list(range(1, 17))
    assert shown(client, scenario)["post"]["trajectory"]["positions"][0] == [34.0, 3.5, 1.0]


def test_only_one_of_several_edits_for_one_revision_is_applied(client):
    scenario = create(client)
    headers = {"If-Match": '"r0"'}
    with ThreadPoolExecutor(4) as pool:
        statuses = list(
            pool.map(
                lambda _: edit(client, scenario, MOVE_POST, headers=headers).status_code, "abcd"
            )
        )
    assert sorted(statuses) == [200, 412, 412, 412]


def test_a_cancelled_edit_is_recorded_completely_or_not_at_all(client):
    scenario = create(client)
    worker = client.app.state.worker

    async def cancel_midway(after: int) -> None:
        from real2sim_proto.operations import OPERATIONS
        from real2sim_server.service.http.requests import IdempotentRequest

        operations = OPERATIONS.validate_python([MOVE_POST])
        coroutine = worker.scenarios.edit(
            scenario.scenario_id,
            operations,
            expected=None,
            dry_run=False,
            idempotent=IdempotentRequest(),
        )
        task = asyncio.create_task(coroutine)
        for _ in range(after):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    for after in range(8):
        client.portal.call(cancel_midway, after)
        url = f"/v1/scenarios/{scenario.scenario_id}"
        revision = client.get(url).json()["revision"]
        recorded = client.portal.call(worker.store.scenario_entries, scenario.scenario_id)
        assert len(recorded) == revision
        x = shown(client, scenario)["post"]["trajectory"]["positions"][0][0]
        assert x == pytest.approx(10 + 1.5 * revision)


def test_a_scenario_whose_scene_was_replaced_is_broken(
    start_worker, run_worker, scenes_dir, tiny_scene
):
    with run_worker() as first:
        scenario = create(first)
    other = replace(tiny_scene, objects={"post": tiny_scene.objects["post"]})
    save_scene(other, scenes_dir / "tiny.r2s", overwrite=True)
    second = start_worker()
    problem = second.get(f"/v1/scenarios/{scenario.scenario_id}").json()
    assert problem["code"] == ErrorCode.SCENE_BROKEN
    assert scenario.scene_hash[:12] in problem["detail"]
    assert len(second.get("/v1/scenarios").json()["scenarios"]) == 1
