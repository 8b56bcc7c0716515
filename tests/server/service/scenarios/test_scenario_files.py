"""Forks, files and author names in the history."""

from __future__ import annotations

import json

import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.scenarios import ScenarioDocument, ScenarioInfo

MOVE = {"op": "translate", "object_id": "post", "x": 1.5}
COPY = {"op": "duplicate", "object_id": "car_red", "new_id": "twin", "y": 6.0}


@pytest.fixture
def edited(client) -> str:
    """A scenario with two edits, one of them undone and redone."""
    scenario = client.post("/v1/scenarios", json={"scene": "tiny", "name": "cut-in"}).json()
    url = f"/v1/scenarios/{scenario['scenario_id']}"
    for operation in (MOVE, COPY):
        client.post(f"{url}/operations", json={"operations": [operation]})
    client.post(f"{url}/undo")
    client.post(f"{url}/redo")
    return url


def described(client, url) -> dict:
    info = client.get(url).json()
    return {k: v for k, v in info.items() if k not in {"scenario_id", "created_at"}}


def test_the_history_records_author_kind_and_time(client):
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    url = f"/v1/scenarios/{scenario}"
    headers = {"X-Real2Sim-Client": "anna"}
    client.post(f"{url}/operations", json={"operations": [MOVE]}, headers=headers)
    client.post(f"{url}/undo", headers={"X-Real2Sim-Client": "bert"})
    entries = client.get(f"{url}/operations").json()["entries"]
    assert [(e["who"], e["kind"]) for e in entries] == [("anna", "edit"), ("bert", "undo")]
    assert all(e["created_at"].endswith("+00:00") for e in entries)


def test_an_invalid_author_name_is_refused(client):
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    answer = client.post(f"/v1/scenarios/{scenario}/undo", headers={"X-Real2Sim-Client": "a" * 81})
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST


def test_a_fork_copies_the_history_and_evolves_independently(client, edited):
    answer = client.post(f"{edited}/fork", json={"name": "other"})
    fork = ScenarioInfo.model_validate(answer.json())
    fork_url = answer.headers["Location"]
    assert answer.status_code == 201
    assert (fork.name, fork.revision, fork.can_undo) == ("other", 4, True)
    assert described(client, fork_url) | {"name": "cut-in"} == described(client, edited)

    client.post(f"{fork_url}/undo")
    assert client.get(edited).json()["revision"] == 4


def test_a_fork_can_start_at_an_earlier_revision(client, edited):
    fork = client.post(f"{edited}/fork", json={"revision": 1}).json()
    assert (fork["revision"], fork["name"]) == (1, "cut-in")
    assert "twin" not in [o["object_id"] for o in fork["objects"]]


def test_a_fork_beyond_the_history_is_refused(client, edited):
    answer = client.post(f"{edited}/fork", json={"revision": 5})
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST


def test_an_exported_scenario_is_imported_with_its_history(client, edited):
    answer = client.get(f"{edited}/export")
    document = ScenarioDocument.model_validate(answer.json())
    assert answer.headers["Content-Disposition"].endswith('.scenario.json"')
    assert len(document.scene_hash) == 64
    imported = client.post("/v1/scenarios/import", json=answer.json())
    url = imported.headers["Location"]
    assert imported.status_code == 201
    assert described(client, url) == described(client, edited)
    assert client.get(f"{url}/operations").json() == client.get(f"{edited}/operations").json()
    assert client.post(f"{url}/undo").status_code == 200


def test_a_scenario_imported_by_another_worker_survives_a_restart(
    client, edited, run_worker, tmp_path
):
    document = client.get(f"{edited}/export").json()
    with run_worker(data_dir=tmp_path / "elsewhere") as other:
        url = other.post("/v1/scenarios/import", json=document).headers["Location"]
    with run_worker(data_dir=tmp_path / "elsewhere") as other:
        assert described(other, url) == described(client, edited)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"scene_hash": "0" * 64}, ErrorCode.UNKNOWN_SCENE),
        ({"version": 2}, ErrorCode.INVALID_REQUEST),
        ({"format": "something else"}, ErrorCode.INVALID_REQUEST),
        ({"assets": {"van": "0" * 64}}, ErrorCode.UNKNOWN_ASSET),
    ],
)
def test_an_incompatible_file_is_refused(client, edited, change, code):
    document = client.get(f"{edited}/export").json()
    answer = client.post("/v1/scenarios/import", json=document | change)
    assert answer.json()["code"] == code
    assert len(client.get("/v1/scenarios").json()["scenarios"]) == 1


@pytest.mark.parametrize("broken", ["gap", "unknown", "target"])
def test_a_file_with_a_broken_history_is_refused(client, edited, broken):
    document = client.get(f"{edited}/export").json()
    entries = document["entries"]
    match broken:
        case "gap":
            del entries[1]
        case "unknown":
            entries[0]["operations"][0]["object_id"] = "nobody"
        case "target":
            entries[2]["target"] = 1
    answer = client.post("/v1/scenarios/import", json=document)
    assert answer.status_code in {404, 412, 422}, answer.text
    assert json.loads(answer.text)["code"] != ErrorCode.INTERNAL
