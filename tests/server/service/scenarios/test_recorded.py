"""A scene as it was recorded is looked at as a scenario is, and nobody can change it."""

from __future__ import annotations

import pytest


@pytest.fixture
def recorded(client) -> str:
    return f"/v1/scenarios/recorded.{client.get('/v1/scenes/tiny').json()['content_hash']}"


def test_it_shows_what_a_new_scenario_shows_and_is_in_no_list(client, recorded):
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


def test_it_cannot_be_changed_and_a_fork_of_it_can(client, recorded):
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


def test_no_scene_no_recording(client):
    answer = client.get(f"/v1/scenarios/recorded.{'0' * 64}")
    assert (answer.status_code, answer.json()["code"]) == (404, "UNKNOWN_SCENARIO")
