"""The recorded scene can be viewed like a scenario but is read-only."""

from __future__ import annotations

import pytest


@pytest.fixture
def recorded(client) -> str:
    return f"/v1/scenarios/recorded.{client.get('/v1/scenes/tiny').json()['content_hash']}"


def test_the_recording_equals_a_new_scenario_and_is_not_listed(client, recorded):
    told = client.get(recorded).json()
    assert client.get("/v1/scenarios").json()["scenarios"] == []
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()
    there = client.get(f"/v1/scenarios/{made['scenario_id']}").json()
    same = {"scene", "revision", "objects", "start_us", "end_us", "can_undo"}
    assert {k: told[k] for k in same} == {k: there[k] for k in same}
    pictures = [
        client.get(f"{path}/preview", params={"camera": "front", "codec": "png"}).content
        for path in (recorded, f"/v1/scenarios/{made['scenario_id']}")
    ]
    assert pictures[0] == pictures[1]
    assert client.get(f"{recorded}/operations").json()["entries"] == []


def test_the_recording_is_read_only_but_its_fork_is_not(client, recorded):
    edit = {"operations": [{"op": "delete", "object_id": "car_red"}]}
    refused = [
        client.post(f"{recorded}/operations", json=edit),
        client.post(f"{recorded}/undo"),
        client.patch(recorded, json={"name": "mine"}),
        client.delete(recorded),
    ]
    for answer in refused:
        assert (answer.status_code, answer.json()["code"]) == (422, "INVALID_OPERATION")
        assert "fork" in answer.json()["hint"]
    assert "car_red" in [o["object_id"] for o in client.get(recorded).json()["objects"]]
    forked = client.post(f"{recorded}/fork", json={"name": "mine"}).json()["scenario_id"]
    assert client.post(f"/v1/scenarios/{forked}/operations", json=edit).status_code == 200


def test_a_recording_of_an_unknown_scene_is_not_found(client):
    answer = client.get(f"/v1/scenarios/recorded.{'0' * 64}")
    assert (answer.status_code, answer.json()["code"]) == (404, "UNKNOWN_SCENARIO")
