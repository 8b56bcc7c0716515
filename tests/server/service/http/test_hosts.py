from __future__ import annotations

import pytest
from starlette.websockets import WebSocketDisconnect

TOKEN = "a long enough secret"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8600", "localhost:1", "[::1]:8600"])
def test_a_worker_without_a_token_answers_loopback_names(run_worker, host):
    with run_worker() as client:
        assert client.get("/v1/server", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8600", "10.0.0.2", "["])
def test_other_names_for_it_are_refused_with_what_to_do(run_worker, host):
    with run_worker() as client:
        answer = client.get("/v1/server", headers={"Host": host})
    assert answer.status_code == 401
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert "REAL2SIM_TOKEN" in answer.json()["hint"]


def test_pages_of_other_sites_may_not_call_it(run_worker):
    with run_worker() as client:
        answer = client.post("/v1/scenarios", json={}, headers={"Origin": "http://evil.example"})
        own = client.get("/v1/server", headers={"Origin": "http://localhost:8600"})
    assert answer.status_code == 401
    assert own.status_code == 200


def test_pages_of_other_sites_may_not_open_sockets(run_worker):
    with (
        run_worker() as client,
        pytest.raises(WebSocketDisconnect) as refused,
        client.websocket_connect(
            "/v1/scenarios/any/view",
            headers={"Host": "127.0.0.1", "Origin": "http://evil.example"},
        ),
    ):
        pass
    assert refused.value.reason == "foreign host"


def test_a_token_lets_other_names_in(run_worker):
    with run_worker(token=TOKEN) as client:
        headers = {"Host": "sim.example", "Authorization": f"Bearer {TOKEN}"}
        assert client.get("/v1/server", headers=headers).status_code == 200
