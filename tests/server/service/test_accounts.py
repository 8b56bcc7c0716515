"""Named tokens: limits, accounting and revocation."""

from __future__ import annotations

import contextlib
import json
import os
import re
from pathlib import Path

import pytest
from starlette.websockets import WebSocketDisconnect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_server.service import accounts as accounts_module
from real2sim_server.service.accounts import (
    Account,
    Accounts,
    Limit,
    Meter,
    OverLimitError,
    RevokedError,
    TokenFileError,
    TokenLimits,
    add_token,
    read_token_file,
    remove_token,
)

SINGLE = "a long enough secret"


# --- limits -----------------------------------------------------------------------------------


def test_a_meter_allows_a_burst_of_one_second_then_refills(manual_clock):
    meter = Meter(10.0)
    assert [meter.take() for _ in range(10)] == [0.0] * 10
    assert meter.take() == pytest.approx(0.1)
    manual_clock.advance(0.11)
    assert meter.take() == 0


def test_a_meter_below_one_per_second_allows_one_at_a_time(manual_clock):
    meter = Meter(0.5)
    assert meter.take() == 0
    assert meter.take() == pytest.approx(2.0)
    manual_clock.advance(2.0)
    assert meter.take() == 0


def test_an_account_over_its_limit_reports_which_limit(manual_clock):
    account = Account("alice", TokenLimits(requests_per_second=2))
    account.admit()
    account.admit()
    with pytest.raises(OverLimitError) as error:
        account.admit()
    assert error.value.limit is Limit.REQUESTS
    assert error.value.retry_after_s > 0
    assert (account.requests, account.refusals[Limit.REQUESTS]) == (2, 1)


def test_changed_limits_do_not_count_earlier_requests(manual_clock):
    account = Account("alice")
    for _ in range(9):
        account.admit()
    account.limit(TokenLimits(requests_per_second=1))
    account.admit()


# --- the file ---------------------------------------------------------------------------------


def test_the_token_file_contains_no_token_and_is_private(tmp_path):
    path = tmp_path / "tokens.json"
    token = add_token(path, "alice", TokenLimits(sessions=2))
    assert token not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    assert Accounts(token=None, file=path).of_token(token).limits.sessions == 2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "JSON"),
        ("[]", "object"),
        ('{"tokens": [{"name": "a"}]}', "hash"),
        ('{"tokens": [{"name": "a", "hash": "x"}]}', "hash"),
        ('{"tokens": [], "more": 1}', "more"),
        ('{"tokens": [{"name": "default", "hash": "%s"}]}' % ("0" * 64), "REAL2SIM_TOKEN"),
        ('{"tokens": [{"name": "a b", "hash": "%s"}]}' % ("0" * 64), "name"),
        (json.dumps({"tokens": [{"name": n, "hash": "0" * 64} for n in "ab"]}), "same hash"),
        ("[" * 100_000, "JSON"),
    ],
)
def test_an_invalid_token_file_is_refused_with_the_reason(tmp_path, text, reason):
    path = tmp_path / "tokens.json"
    path.write_text(text)
    with pytest.raises(TokenFileError, match=reason):
        read_token_file(path)


def test_duplicate_and_unknown_token_names_are_refused(tmp_path):
    path = tmp_path / "tokens.json"
    add_token(path, "alice", TokenLimits())
    with pytest.raises(TokenFileError, match="already"):
        add_token(path, "alice", TokenLimits())
    remove_token(path, "alice")
    with pytest.raises(TokenFileError, match="no token"):
        remove_token(path, "alice")


def test_a_reload_applies_a_valid_file_and_ignores_a_broken_one(tmp_path):
    path = tmp_path / "tokens.json"
    alice = add_token(path, "alice", TokenLimits())
    accounts = Accounts(token=SINGLE, file=path)
    account = accounts.of_token(alice)
    bob = add_token(path, "bob", TokenLimits())
    assert accounts.of_token(bob) is None
    accounts.reload()
    assert accounts.of_token(bob).name == "bob"
    assert accounts.of_token(alice) is account
    path.write_text("{")
    accounts.reload()
    assert accounts.of_token(bob).name == "bob"
    path.unlink()
    accounts.reload()
    assert accounts.of_token(alice) is account
    add_token(path, "carol", TokenLimits())
    accounts.reload()
    assert accounts.of_token(alice) is None
    with pytest.raises(RevokedError):
        account.admit()
    assert accounts.of_token(SINGLE).name == "default"


# --- REST ---------------------------------------------------------------------------------------


@pytest.fixture
def tokens_file(tmp_path) -> Path:
    return tmp_path / "tokens.json"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def figure(client, name: str, token: str) -> float:
    text = client.get("/metrics", headers=bearer(SINGLE)).text
    found = re.search(rf'^real2sim_token_{name}\{{token="{token}"\}} (\S+)$', text, re.M)
    return float(found.group(1))


def test_a_worker_with_named_tokens_requires_one(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    assert client.get("/v1/server").status_code == 401
    assert client.get("/v1/server", headers=bearer("guess")).status_code == 401
    assert client.get("/v1/server", headers=bearer(alice)).status_code == 200


def test_metrics_count_requests_and_sessions_per_token(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(token=SINGLE, tokens_file=tokens_file)
    for _ in range(3):
        client.get("/v1/scenes/tiny/render?width=64", headers=bearer(alice))
    made = client.post("/v1/sessions?scene=tiny", json={"reset": {}}, headers=bearer(alice)).json()
    assert made["owner"] == "alice"
    # The session's own token counts for its owner.
    client.get(f"/v1/sessions/{made['session_id']}/state", headers=bearer(made["token"]))
    assert figure(client, "requests_total", "alice") == 5
    assert figure(client, "sessions", "alice") == 1
    assert figure(client, "sessions", "default") == 0


def test_a_token_over_its_rate_gets_429_without_affecting_others(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits(requests_per_second=0.1))
    client = start_worker(token=SINGLE, tokens_file=tokens_file)
    assert client.get("/v1/server", headers=bearer(alice)).status_code == 200
    refused = client.get("/v1/server", headers=bearer(alice))
    assert refused.status_code == 429
    problem = refused.json()
    assert (problem["code"], problem["retryable"]) == ("TOO_MANY_REQUESTS", True)
    assert 1 <= int(refused.headers["Retry-After"]) <= 10
    assert client.get("/v1/server", headers=bearer(SINGLE)).status_code == 200
    text = client.get("/metrics", headers=bearer(SINGLE)).text
    assert 'real2sim_token_refusals_total{limit="requests",token="alice"} 1.0' in text


def test_the_session_limit_of_a_token_includes_forks(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits(sessions=1))
    bob = add_token(tokens_file, "bob", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    url = "/v1/sessions?scene=tiny"
    first = client.post(url, json={"reset": {}}, headers=bearer(alice)).json()
    path = f"/v1/sessions/{first['session_id']}"
    for refused in (
        client.post(url, headers=bearer(alice)),
        client.post(f"{path}/fork", headers=bearer(alice)),
        client.post(f"{path}/fork", headers=bearer(first["token"])),
    ):
        assert (refused.status_code, refused.json()["code"]) == (429, "TOO_MANY_SESSIONS")
    assert client.post(url, headers=bearer(bob)).status_code == 201
    assert client.delete(path, headers=bearer(alice)).status_code == 204
    assert client.post(url, headers=bearer(alice)).status_code == 201


def test_a_job_has_the_owner_of_its_token(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    body = {"scene": "tiny", "camera": "front", "fps": 2, "width": 64}
    assert client.post("/v1/exports", json=body, headers=bearer(alice)).json()["owner"] == "alice"


def test_idempotency_keys_are_separate_per_token(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    bob = add_token(tokens_file, "bob", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    made = [
        client.post(
            "/v1/sessions?scene=tiny", headers=bearer(token) | {"Idempotency-Key": "1"}
        ).json()
        for token in (alice, bob, alice)
    ]
    assert made[0]["session_id"] == made[2]["session_id"] != made[1]["session_id"]


def test_session_owners_survive_a_worker_restart(start_worker, run_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits(sessions=1))
    with run_worker(tokens_file=tokens_file) as client:
        made = client.post(
            "/v1/sessions?scene=tiny", json={"reset": {}}, headers=bearer(alice)
        ).json()
    client = start_worker(tokens_file=tokens_file)
    path = f"/v1/sessions/{made['session_id']}"
    assert client.get(path, headers=bearer(made["token"])).json()["owner"] == "alice"
    assert client.post("/v1/sessions?scene=tiny", headers=bearer(alice)).status_code == 429


# --- sockets ----------------------------------------------------------------------------------


def hello(**fields) -> bytes:
    said = {"v": 1, "type": "hello", "id": 1, "protocols": [DRIVE_SUBPROTOCOL]}
    return encode(said | fields)


def answer(drive) -> dict:
    while (said := decode(drive.receive_bytes()))["type"] == "progress":
        pass
    return said


@contextlib.contextmanager
def driving(client, made, **fields):
    url = f"/v1/sessions/{made['session_id']}/drive"
    with client.websocket_connect(url, subprotocols=[DRIVE_SUBPROTOCOL]) as drive:
        drive.send_bytes(hello(**fields))
        assert answer(drive)["type"] == "welcome"
        yield drive


def test_drive_messages_over_the_rate_limit_are_refused(start_worker, tokens_file, manual_clock):
    # The session creation, the hello and the reset are within the limit.
    alice = add_token(tokens_file, "alice", TokenLimits(requests_per_second=3))
    client = start_worker(token=SINGLE, tokens_file=tokens_file)
    made = client.post("/v1/sessions?scene=tiny", headers=bearer(alice)).json()
    with driving(client, made, token=made["token"]) as drive:
        told = []
        for k in range(6):
            drive.send_bytes(encode({"v": 1, "type": "reset", "id": k, "spec": {}}))
            told.append(answer(drive))
        refused = [said for said in told if said["type"] == "error"]
        assert refused
        assert {said["code"] for said in refused} == {"TOO_MANY_REQUESTS"}
        assert all(said["retryable"] and not said["fatal"] for said in refused)
        assert all(said["retry_after_s"] == 1 for said in refused)
        manual_clock.advance(0.5)
        drive.send_bytes(encode({"v": 1, "type": "reset", "id": 9, "spec": {}}))
        assert answer(drive)["type"] == "obs"


def test_removing_a_token_disconnects_its_sockets_and_closes_its_sessions(
    start_worker, tokens_file, monkeypatch
):
    monkeypatch.setattr(accounts_module, "RELOAD_S", 0.05)
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(token=SINGLE, tokens_file=tokens_file)
    made = client.post("/v1/sessions?scene=tiny", headers=bearer(alice)).json()
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}, headers=bearer(alice)).json()
    view_url = f"/v1/scenarios/{scenario['scenario_id']}/view"
    with (
        driving(client, made, token=made["token"], role="observer") as drive,
        client.websocket_connect(view_url) as view,
    ):
        view.send_json({"type": "hello", "token": alice})
        assert view.receive_json() == {"type": "welcome"}
        remove_token(tokens_file, "alice")
        assert answer(drive)["code"] == "UNAUTHORIZED"
        with pytest.raises(WebSocketDisconnect):
            drive.receive_bytes()
        with pytest.raises(WebSocketDisconnect) as closed:
            view.receive_json()
        assert closed.value.code == 4401
    path = f"/v1/sessions/{made['session_id']}"
    for token in (alice, made["token"]):
        assert client.get(path, headers=bearer(token)).status_code == 401
    assert client.get(path, headers=bearer(SINGLE)).status_code == 200


def test_view_messages_over_the_rate_limit_are_refused(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits(requests_per_second=2))
    client = start_worker(tokens_file=tokens_file)
    made = client.post("/v1/scenarios", json={"scene": "tiny"}, headers=bearer(alice)).json()
    with client.websocket_connect(f"/v1/scenarios/{made['scenario_id']}/view") as view:
        view.send_json({"type": "hello", "token": alice})
        assert view.receive_json() == {"type": "welcome"}
        codes = []
        for k in range(4):
            view.send_json({"seq": k, "camera": "nobody", "t_us": 0, "width": 16})
            codes.append(view.receive_json()["code"])
        assert "TOO_MANY_REQUESTS" in codes


# --- the command ------------------------------------------------------------------------------


def test_the_token_command_adds_lists_and_removes_tokens(tmp_path, start_worker, capsys):
    from real2sim_server.cli import store as command

    path = tmp_path / "tokens.json"
    command.add("alice", file=path, sessions=1)
    printed = capsys.readouterr().out.strip()
    client = start_worker(tokens_file=path)
    assert client.get("/v1/server", headers=bearer(printed)).status_code == 200
    command.list_(file=path)
    listed = capsys.readouterr().out
    assert "alice" in listed
    assert "sessions: 1" in listed
    assert printed not in listed
    command.remove("alice", file=path)
    assert read_token_file(path).tokens == ()
    assert os.listdir(tmp_path).count("tokens.json") == 1
