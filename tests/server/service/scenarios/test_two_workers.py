"""Two workers on one database: what one has acknowledged, the other shows."""

from __future__ import annotations

import threading

import pytest

from ..postgres import Postgres

MOVE = {"op": "translate", "object_id": "post", "x": 0.5}
DELETE = {"op": "delete", "object_id": "car_red"}


@pytest.fixture(params=["sqlite", "postgresql"])
def workers(request, start_worker, tmp_path):
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path / 'shared.db'}"
    else:
        server: Postgres = request.getfixturevalue("postgres")
        url = server.new_database()
    return [
        start_worker(worker_id=name, data_dir=tmp_path / name, store_url=url)
        for name in ("w0", "w1")
    ]


@pytest.fixture
def scenario(workers) -> str:
    """Path of a scenario that both workers have in memory."""
    url = workers[0].post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
    for worker in workers:
        assert worker.get(url).json()["revision"] == 0
    return url


def edit(worker, url, *operations, **headers):
    body = {"operations": list(operations)}
    return worker.post(f"{url}/operations", json=body, headers=headers)


def test_an_acknowledged_edit_is_seen_by_every_worker_at_once(workers, scenario):
    for n in range(6):
        writer, reader = workers[n % 2], workers[1 - n % 2]
        assert edit(writer, scenario, MOVE).json()["revision"] == n + 1
        assert reader.get(scenario).json()["revision"] == n + 1
        assert len(reader.get(f"{scenario}/operations").json()["entries"]) == n + 1


def test_undo_takes_back_what_the_other_worker_did(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    assert workers[1].post(f"{scenario}/undo").json()["revision"] == 2
    shown = [o["object_id"] for o in workers[0].get(scenario).json()["objects"]]
    assert "car_red" in shown


def test_a_session_begins_from_what_the_other_worker_has_edited(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    made = workers[1].post("/v1/sessions", params={"scenario": scenario.split("/")[-1]}, json={})
    headers = {"Authorization": f"Bearer {made.json()['token']}"}
    state = workers[1].get(f"/v1/sessions/{made.json()['session_id']}/state", headers=headers)
    assert "car_red" not in [a["object_id"] for a in state.json()["agents"]]


def test_a_stale_edit_is_told_what_the_other_worker_did(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    refused = edit(workers[1], scenario, MOVE, **{"If-Match": '"r0"'})
    assert refused.status_code == 412
    assert [e["revision"] for e in refused.json()["missed"]] == [1]


def test_a_scenario_that_the_other_worker_has_deleted_is_gone(workers, scenario):
    assert workers[0].delete(scenario).status_code == 204
    assert workers[1].get(scenario).json()["code"] == "UNKNOWN_SCENARIO"
    assert edit(workers[1], scenario, MOVE).json()["code"] == "UNKNOWN_SCENARIO"


def test_edits_at_both_workers_at_once_are_all_kept_in_one_order(workers, scenario):
    answers: list[list[int]] = [[], []]

    def author(n: int) -> None:
        for _ in range(8):
            answer = edit(workers[n], scenario, MOVE)
            if answer.status_code == 200:
                answers[n].append(answer.json()["revision"])

    threads = [threading.Thread(target=author, args=(n,)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers[0] + answers[1]) == list(range(1, 17))
    assert [worker.get(scenario).json()["revision"] for worker in workers] == [16, 16]
