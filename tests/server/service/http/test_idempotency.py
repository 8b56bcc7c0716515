from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from real2sim_proto import ErrorCode
from real2sim_server.scene.io import write_splats

KEY = {"Idempotency-Key": "7f3c"}
MOVE = {"operations": [{"op": "translate", "object_id": "post", "x": 1.0}]}


@pytest.fixture
def url(client) -> str:
    return client.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]


def test_an_edit_sent_twice_takes_effect_once_and_gets_the_same_answer(client, url):
    first = client.post(f"{url}/operations", json=MOVE, headers=KEY)
    second = client.post(f"{url}/operations", json=MOVE, headers=KEY)
    assert first.json() == second.json()
    assert first.headers["ETag"] == second.headers["ETag"]
    assert "Idempotent-Replayed" not in first.headers
    assert second.headers["Idempotent-Replayed"] == "true"
    assert client.get(url).json()["revision"] == 1


def test_a_creation_sent_twice_creates_one_scenario(client):
    answers = [client.post("/v1/scenarios", json={"scene": "tiny"}, headers=KEY) for _ in "ab"]
    assert [a.status_code for a in answers] == [201, 201]
    assert answers[0].headers["Location"] == answers[1].headers["Location"]
    assert len(client.get("/v1/scenarios").json()["scenarios"]) == 1


@pytest.mark.parametrize("name", ["undo", "redo"])
def test_undo_and_redo_sent_twice_take_effect_once(client, url, name):
    for _ in range(2):
        client.post(f"{url}/operations", json=MOVE)
    if name == "redo":
        client.post(f"{url}/undo")
        client.post(f"{url}/undo")
    before = client.get(url).json()["revision"]
    for _ in range(2):
        assert client.post(f"{url}/{name}", headers=KEY).json()["revision"] == before + 1


def test_a_key_used_by_a_different_request_is_refused(client, url):
    client.post(f"{url}/operations", json=MOVE, headers=KEY)
    other = {"operations": [MOVE["operations"][0] | {"x": 2.0}]}
    problem = client.post(f"{url}/operations", json=other, headers=KEY)
    assert problem.status_code == 422
    assert problem.json()["code"] == ErrorCode.IDEMPOTENCY_CONFLICT
    stale = client.post(f"{url}/operations", json=MOVE, headers=KEY | {"If-Match": '"r1"'})
    assert stale.json()["code"] == ErrorCode.IDEMPOTENCY_CONFLICT


def test_the_same_key_can_be_used_on_different_routes(client, url):
    assert client.post(f"{url}/operations", json=MOVE, headers=KEY).json()["revision"] == 1
    assert client.post(f"{url}/undo", headers=KEY).json()["revision"] == 2


def test_a_refused_request_can_be_retried_with_the_same_key(client, url):
    unknown = {"operations": [{"op": "restore", "object_id": "twin"}]}
    assert client.post(f"{url}/operations", json=unknown, headers=KEY).status_code == 404
    copy = {"operations": [{"op": "duplicate", "object_id": "post", "new_id": "twin"}]}
    client.post(f"{url}/operations", json=copy)
    client.post(f"{url}/operations", json={"operations": [{"op": "delete", "object_id": "twin"}]})
    assert client.post(f"{url}/operations", json=unknown, headers=KEY).status_code == 200


def test_dry_runs_are_not_stored(client, url):
    for expected in (0, 1):
        answer = client.post(f"{url}/operations", json=MOVE | {"dry_run": True}, headers=KEY)
        assert answer.json()["revision"] == expected
        client.post(f"{url}/operations", json=MOVE)


def test_stored_answers_survive_a_restart(start_worker, run_worker):
    with run_worker() as first:
        url = first.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
        answer = first.post(f"{url}/operations", json=MOVE, headers=KEY)
    second = start_worker()
    assert second.post(f"{url}/operations", json=MOVE, headers=KEY).json() == answer.json()
    assert second.get(url).json()["revision"] == 1


def test_concurrent_requests_with_one_key_take_effect_once(client, url):
    with ThreadPoolExecutor(8) as pool:
        answers = list(
            pool.map(
                lambda _: client.post(f"{url}/operations", json=MOVE, headers=KEY).json(), range(8)
            )
        )
    assert all(answer == answers[0] for answer in answers)
    assert client.get(url).json()["revision"] == 1


def test_a_key_over_the_length_limit_is_refused(client, url):
    headers = {"Idempotency-Key": "k" * 201}
    problem = client.post(f"{url}/undo", headers=headers).json()
    assert problem["code"] == ErrorCode.INVALID_REQUEST


# --- sessions, assets, scenes -------------------------------------------------------------------


@pytest.fixture
def session(client) -> dict:
    """Path of a session with a started episode, and its authorization headers."""
    body = {"reset": {"seed": 0, "dt_us": 50_000, "action": "control"}}
    info = client.post("/v1/sessions?scene=tiny", json=body).json()
    token = {"Authorization": f"Bearer {info['token']}"}
    return {"path": f"/v1/sessions/{info['session_id']}", "token": token, "info": info}


def test_a_step_sent_twice_advances_the_clock_once(client, session):
    first, second = (
        client.post(f"{session['path']}/step", json={"n": 3}, headers=session["token"] | KEY)
        for _ in "ab"
    )
    assert first.json() == second.json()
    assert second.headers["Idempotent-Replayed"] == "true"
    state = client.get(f"{session['path']}/state", headers=session["token"])
    assert state.json()["step"] == first.json()["step"] == 3


def test_a_reset_sent_twice_starts_one_episode(client, session):
    headers = session["token"] | KEY
    client.post(f"{session['path']}/reset", json={"seed": 5}, headers=headers)
    client.post(f"{session['path']}/step", json={"n": 2}, headers=session["token"])
    client.post(f"{session['path']}/reset", json={"seed": 5}, headers=headers)
    state = client.get(f"{session['path']}/state", headers=session["token"])
    assert state.json()["step"] == 2


def test_a_fork_sent_twice_creates_one_session(client, session):
    headers = session["token"] | KEY
    answers = [client.post(f"{session['path']}/fork", headers=headers) for _ in "ab"]
    assert [a.status_code for a in answers] == [201, 201]
    assert answers[0].json() == answers[1].json()
    assert len(client.get("/v1/sessions").json()["sessions"]) == 2


def test_the_stored_answer_of_a_step_survives_a_restart(run_worker):
    with run_worker() as client:
        info = client.post("/v1/sessions?scene=tiny", json={"reset": {}}).json()
        path = f"/v1/sessions/{info['session_id']}"
        headers = {"Authorization": f"Bearer {info['token']}"} | KEY
        first = client.post(f"{path}/step", json={"n": 25}, headers=headers).json()
    with run_worker() as client:
        again = client.post(f"{path}/step", json={"n": 25}, headers=headers)
        assert again.json() == first
        assert again.headers["Idempotent-Replayed"] == "true"


def test_a_step_that_cannot_be_stored_does_not_advance_the_session(client, session, monkeypatch):
    store = client.app.state.worker.store

    async def fail(*_args, **_kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(store, "append_session_entries", fail)
    request = {"json": {"n": 30}, "headers": session["token"] | KEY}
    assert client.post(f"{session['path']}/step", **request).status_code >= 500
    monkeypatch.undo()
    assert client.post(f"{session['path']}/step", **request).json()["step"] == 30


def test_an_asset_cut_sent_twice_creates_one_asset(client):
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "red"}
    answers = [client.post("/v1/assets", json=cut, headers=KEY) for _ in "ab"]
    assert [a.status_code for a in answers] == [201, 201]
    assert answers[0].json() == answers[1].json()
    assert client.post("/v1/assets", json=cut).json()["code"] == ErrorCode.ALREADY_EXISTS


@pytest.mark.parametrize(("path", "name"), [("/v1/assets", "assets"), ("/v1/scenes", "scenes")])
def test_an_upload_sent_twice_with_different_boundaries_takes_effect_once(
    client, tmp_path, tiny_scene, path, name
):
    write_splats(tiny_scene.objects["car_red"].cloud, tmp_path / "car.ply")
    content = (tmp_path / "car.ply").read_bytes()
    before = len(client.get(path).json()[name])
    answers = [client.post(path, files={"file": ("car.ply", content)}, headers=KEY) for _ in "ab"]
    assert [a.status_code for a in answers] == [201, 201], answers[1].text
    assert answers[0].json() == answers[1].json()
    assert len(client.get(path).json()[name]) == before + 1
    other = client.post(path, files={"file": ("car.ply", content + b"\0")}, headers=KEY)
    assert other.json()["code"] == ErrorCode.IDEMPOTENCY_CONFLICT


# --- a crash between files and their answer -------------------------------------------------------


def test_a_request_interrupted_before_its_answer_was_stored_can_be_repeated(
    client, tmp_path, tiny_scene, monkeypatch
):
    (tmp_path / "import").mkdir()
    file = tmp_path / "import" / "car.ply"
    write_splats(tiny_scene.objects["car_red"].cloud, file)
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "cut"}
    for key, path, request in (
        ("cut", "/v1/assets", {"json": cut}),
        ("upload", "/v1/assets", {"files": {"file": ("car.ply", file.read_bytes())}}),
        ("import", "/v1/scenes", {"json": {"path": "car.ply"}}),
    ):
        headers = {"Idempotency-Key": key}
        before = len(client.get(path).json()[path[4:]])
        with monkeypatch.context() as patch:
            patch.setattr(client.app.state.worker.store, "write", _fail)
            assert client.post(path, headers=headers, **request).status_code >= 500
        again = client.post(path, headers=headers, **request)
        assert again.status_code == 201, again.text
        assert client.get(again.headers["Location"]).status_code == 200
        assert len(client.get(path).json()[path[4:]]) == before + 1
        # A request with another key gets a name conflict.
        other = client.post(path, headers={"Idempotency-Key": f"{key} 2"}, **request)
        assert other.json()["code"] == ErrorCode.ALREADY_EXISTS
    assert not list(tmp_path.rglob(".made_by"))


async def _fail(*_args, **_options):
    raise OSError("the machine goes down")
