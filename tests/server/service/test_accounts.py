"""Named tokens: who takes how much, and where it ends."""

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


def test_a_meter_lets_a_second_at_once_and_then_as_much_as_leaks(manual_clock):
    meter = Meter(10.0)
    assert [meter.take() for _ in range(10)] == [0.0] * 10
    assert meter.take() == pytest.approx(0.1)
    manual_clock.advance(0.11)
    assert meter.take() == 0


def test_a_meter_below_one_lets_one_at_a_time(manual_clock):
    meter = Meter(0.5)
    assert meter.take() == 0
    assert meter.take() == pytest.approx(2.0)
    manual_clock.advance(2.0)
    assert meter.take() == 0


def test_who_has_had_enough_is_told_of_what(manual_clock):
    account = Account("alice", TokenLimits(requests_per_second=2))
    account.admit()
    account.admit()
    with pytest.raises(OverLimitError) as error:
        account.admit()
    assert error.value.limit is Limit.REQUESTS
    assert error.value.retry_after_s > 0
    assert (account.requests, account.refusals[Limit.REQUESTS]) == (2, 1)


def test_other_limits_do_not_count_what_was_taken_before(manual_clock):
    account = Account("alice")
    for _ in range(9):
        account.admit()
    account.limit(TokenLimits(requests_per_second=1))
    account.admit()


# --- the file ---------------------------------------------------------------------------------


def test_the_file_holds_no_token_and_is_for_its_owner(tmp_path):
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
def test_a_file_that_says_something_else_is_refused_with_the_reason(tmp_path, text, reason):
    path = tmp_path / "tokens.json"
    path.write_text(text)
    with pytest.raises(TokenFileError, match=reason):
        read_token_file(path)


def test_names_are_given_once_and_removed_once(tmp_path):
    path = tmp_path / "tokens.json"
    add_token(path, "alice", TokenLimits())
    with pytest.raises(TokenFileError, match="already"):
        add_token(path, "alice", TokenLimits())
    remove_token(path, "alice")
    with pytest.raises(TokenFileError, match="no token"):
        remove_token(path, "alice")


def test_a_changed_file_counts_at_once_and_a_broken_one_changes_nothing(tmp_path):
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


# --- by REST ----------------------------------------------------------------------------------


@pytest.fixture
def tokens_file(tmp_path) -> Path:
    return tmp_path / "tokens.json"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def figure(client, name: str, token: str) -> float:
    text = client.get("/metrics", headers=bearer(SINGLE)).text
    found = re.search(rf'^real2sim_token_{name}\{{token="{token}"\}} (\S+)$', text, re.M)
    return float(found.group(1))


def test_a_worker_with_named_tokens_wants_one(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    assert client.get("/v1/server").status_code == 401
    assert client.get("/v1/server", headers=bearer("guess")).status_code == 401
    assert client.get("/v1/server", headers=bearer(alice)).status_code == 200


def test_what_each_token_takes_is_told_by_its_name(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(token=SINGLE, tokens_file=tokens_file)
    for _ in range(3):
        client.get("/v1/scenes/tiny/render?width=64", headers=bearer(alice))
    made = client.post("/v1/sessions?scene=tiny", json={"reset": {}}, headers=bearer(alice)).json()
    assert made["owner"] == "alice"
    # The session's own token is that of its owner.
    client.get(f"/v1/sessions/{made['session_id']}/state", headers=bearer(made["token"]))
    assert figure(client, "requests_total", "alice") == 5
    assert figure(client, "sessions", "alice") == 1
    assert figure(client, "sessions", "default") == 0


def test_over_its_rate_a_token_gets_429_and_others_go_on(start_worker, tokens_file):
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


def test_sessions_of_a_token_are_limited_forks_among_them(start_worker, tokens_file):
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


def test_jobs_keep_their_owner(start_worker, tokens_file):
    alice = add_token(tokens_file, "alice", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    body = {"scene": "tiny", "camera": "front", "fps": 2, "width": 64}
    assert client.post("/v1/exports", json=body, headers=bearer(alice)).json()["owner"] == "alice"


def test_keys_of_one_token_are_not_those_of_another(start_worker, tokens_file):
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


def test_owners_outlive_the_worker(start_worker, run_worker, tokens_file):
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


def test_messages_of_the_drive_socket_count_and_are_refused_over_the_limit(
    start_worker, tokens_file, manual_clock
):
    # The session, the hello and the reset are let in.
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


def test_who_holds_a_removed_token_is_disconnected_and_their_sessions_are_closed_to_them(
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


def test_the_view_socket_is_refused_over_the_limit(start_worker, tokens_file):
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


def test_the_command_prints_a_token_once_that_a_worker_takes(tmp_path, start_worker, capsys):
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
