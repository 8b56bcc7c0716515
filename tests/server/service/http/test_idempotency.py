from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from real2sim_proto import ErrorCode

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


def test_a_creation_sent_twice_makes_one_scenario(client):
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


def test_the_key_of_another_request_is_refused(client, url):
    client.post(f"{url}/operations", json=MOVE, headers=KEY)
    other = {"operations": [MOVE["operations"][0] | {"x": 2.0}]}
    problem = client.post(f"{url}/operations", json=other, headers=KEY)
    assert problem.status_code == 422
    assert problem.json()["code"] == ErrorCode.IDEMPOTENCY_CONFLICT
    stale = client.post(f"{url}/operations", json=MOVE, headers=KEY | {"If-Match": '"r1"'})
    assert stale.json()["code"] == ErrorCode.IDEMPOTENCY_CONFLICT


def test_the_same_key_at_another_call_is_another_request(client, url):
    assert client.post(f"{url}/operations", json=MOVE, headers=KEY).json()["revision"] == 1
    assert client.post(f"{url}/undo", headers=KEY).json()["revision"] == 2


def test_a_refused_request_may_be_sent_again(client, url):
    unknown = {"operations": [{"op": "restore", "object_id": "twin"}]}
    assert client.post(f"{url}/operations", json=unknown, headers=KEY).status_code == 404
    copy = {"operations": [{"op": "duplicate", "object_id": "post", "new_id": "twin"}]}
    client.post(f"{url}/operations", json=copy)
    client.post(f"{url}/operations", json={"operations": [{"op": "delete", "object_id": "twin"}]})
    assert client.post(f"{url}/operations", json=unknown, headers=KEY).status_code == 200


def test_a_dry_run_is_not_remembered(client, url):
    for expected in (0, 1):
        answer = client.post(f"{url}/operations", json=MOVE | {"dry_run": True}, headers=KEY)
        assert answer.json()["revision"] == expected
        client.post(f"{url}/operations", json=MOVE)


def test_answers_are_remembered_over_a_restart(start_worker, run_worker):
    with run_worker() as first:
        url = first.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
        answer = first.post(f"{url}/operations", json=MOVE, headers=KEY)
    second = start_worker()
    assert second.post(f"{url}/operations", json=MOVE, headers=KEY).json() == answer.json()
    assert second.get(url).json()["revision"] == 1


def test_requests_that_arrive_together_under_one_key_take_effect_once(client, url):
    with ThreadPoolExecutor(8) as pool:
        answers = list(
            pool.map(
                lambda _: client.post(f"{url}/operations", json=MOVE, headers=KEY).json(), range(8)
            )
        )
    assert all(answer == answers[0] for answer in answers)
    assert client.get(url).json()["revision"] == 1


def test_a_key_that_is_too_long_is_refused(client, url):
    headers = {"Idempotency-Key": "k" * 201}
    problem = client.post(f"{url}/undo", headers=headers).json()
    assert problem["code"] == ErrorCode.INVALID_REQUEST
