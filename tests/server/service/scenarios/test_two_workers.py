"""Two workers on one database. An edit acknowledged by one is visible at the other."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from real2sim_server.scene.io import save_scene
from real2sim_server.service.app import create_app
from real2sim_server.settings import Settings

from ..postgres import Postgres

MOVE = {"op": "translate", "object_id": "post", "x": 0.5}
DELETE = {"op": "delete", "object_id": "car_red"}


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def workers(request, tmp_path_factory, tiny_scene) -> Iterator[list[TestClient]]:
    folder = tmp_path_factory.mktemp("shared")
    save_scene(tiny_scene, folder / "scenes" / "tiny.r2s")
    if request.param == "sqlite":
        url = f"sqlite:///{folder / 'shared.db'}"
    else:
        server: Postgres = request.getfixturevalue("postgres")
        url = server.new_database()
    with ExitStack() as stack:
        yield [
            stack.enter_context(
                TestClient(create_app(_settings(folder, name, url)), base_url="http://127.0.0.1")
            )
            for name in ("w0", "w1")
        ]


def _settings(folder: Path, name: str, url: str) -> Settings:
    return Settings(
        worker_id=name,
        data_dir=folder / name,
        scenes_dir=folder / "scenes",
        store_url=url,
        port=0,
        backend="cpu",
        log_level="error",
        drain_seconds=0,
    )


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


def test_an_acknowledged_edit_is_visible_on_every_worker_at_once(workers, scenario):
    for n in range(6):
        writer, reader = workers[n % 2], workers[1 - n % 2]
        assert edit(writer, scenario, MOVE).json()["revision"] == n + 1
        assert reader.get(scenario).json()["revision"] == n + 1
        assert len(reader.get(f"{scenario}/operations").json()["entries"]) == n + 1


def test_undo_reverts_an_edit_of_the_other_worker(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    assert workers[1].post(f"{scenario}/undo").json()["revision"] == 2
    shown = [o["object_id"] for o in workers[0].get(scenario).json()["objects"]]
    assert "car_red" in shown


def test_a_session_starts_from_the_edits_of_the_other_worker(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    made = workers[1].post("/v1/sessions", params={"scenario": scenario.split("/")[-1]}, json={})
    headers = {"Authorization": f"Bearer {made.json()['token']}"}
    state = workers[1].get(f"/v1/sessions/{made.json()['session_id']}/state", headers=headers)
    assert "car_red" not in [a["object_id"] for a in state.json()["agents"]]


def test_a_stale_edit_is_refused_with_the_edits_of_the_other_worker(workers, scenario):
    assert edit(workers[0], scenario, DELETE).status_code == 200
    refused = edit(workers[1], scenario, MOVE, **{"If-Match": '"r0"'})
    assert refused.status_code == 412
    assert [e["revision"] for e in refused.json()["missed"]] == [1]


def test_a_scenario_that_the_other_worker_has_deleted_is_gone(workers, scenario):
    assert workers[0].delete(scenario).status_code == 204
    assert workers[1].get(scenario).json()["code"] == "UNKNOWN_SCENARIO"
    assert edit(workers[1], scenario, MOVE).json()["code"] == "UNKNOWN_SCENARIO"


def looking_too_early(worker, monkeypatch) -> None:
    """Make the worker look for a stored answer before the other worker has stored it."""
    store = worker.app.state.worker.store
    given, looks = store.reply, []

    async def reply(key: str):
        looks.append(key)
        return None if len(looks) == 1 else await given(key)

    monkeypatch.setattr(store, "reply", reply)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("{scenario}/operations", {"operations": [MOVE]}),
        ("/v1/scenarios", {"scene": "tiny"}),
        ("/v1/sessions?scene=tiny", None),
        ("/v1/exports", {"scene": "tiny", "camera": "front", "fps": 1, "width": 64}),
    ],
    ids=["edit", "scenario", "session", "job"],
)
def test_a_request_sent_to_both_workers_takes_effect_once(
    workers, scenario, monkeypatch, path, body
):
    path, key = path.format(scenario=scenario), {"Idempotency-Key": scenario}
    first = workers[0].post(path, json=body, headers=key)
    before = all_there_is(workers[1], scenario)
    looking_too_early(workers[1], monkeypatch)
    second = workers[1].post(path, json=body, headers=key)
    assert (second.status_code, second.json()) == (first.status_code, first.json())
    assert second.headers["Idempotent-Replayed"] == "true"
    assert all_there_is(workers[1], scenario) == before


def all_there_is(worker, scenario) -> tuple[int, ...]:
    """Revisions of the scenario, and the number of scenarios, sessions and jobs of a worker."""
    lists = (worker.get(f"/v1/{name}").json()[name] for name in ("scenarios", "sessions", "jobs"))
    return worker.get(scenario).json()["revision"], *map(len, lists)


def test_concurrent_edits_on_both_workers_are_all_kept_in_one_order(workers, scenario):
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


def test_a_rename_is_visible_on_every_worker_at_once(workers, scenario):
    assert workers[0].patch(scenario, json={"name": "in the rain"}).json()["name"] == "in the rain"
    assert workers[1].get(scenario).json()["name"] == "in the rain"
    assert workers[1].patch(scenario, json={"name": ""}).status_code == 422
    unknown = workers[1].patch("/v1/scenarios/nobody", json={"name": "x"})
    assert unknown.json()["code"] == "UNKNOWN_SCENARIO"
