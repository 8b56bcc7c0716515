from __future__ import annotations

import pytest

TOKEN = "a long enough secret"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8600", "localhost:1", "[::1]:8600"])
def test_a_worker_without_a_token_answers_loopback_names(run_worker, host):
    with run_worker() as client:
        assert client.get("/v1/server", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8600", "10.0.0.2", "["])
def test_other_host_names_are_refused_with_a_hint(run_worker, host):
    with run_worker() as client:
        answer = client.get("/v1/server", headers={"Host": host})
    assert answer.status_code == 401
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert "REAL2SIM_TOKEN" in answer.json()["hint"]


def test_other_host_names_are_allowed_with_a_token(run_worker):
    with run_worker(token=TOKEN) as client:
        headers = {"Host": "sim.example", "Authorization": f"Bearer {TOKEN}"}
        assert client.get("/v1/server", headers=headers).status_code == 200
