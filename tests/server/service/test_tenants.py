"""Roles of token holders, their job limits, and the audit log."""

from __future__ import annotations

import json

import pytest

from real2sim_server.cli.store import audit
from real2sim_server.service.accounts import ROLES, TokenLimits, add_token, read_token_file
from real2sim_server.service.http.auth import needed_role

from .test_accounts import bearer
from .waiting import finished

VIDEO = {"scene": "tiny", "camera": "front", "fps": 2, "width": 64}
CUT = {"scene": "tiny", "object_id": "car_red", "asset_id": "red"}


@pytest.fixture
def tokens_file(tmp_path):
    return tmp_path / "tokens.json"


@pytest.fixture
def site(start_worker, tokens_file):
    """A worker, and a token for each role."""
    tokens = {role: add_token(tokens_file, role, TokenLimits(), role=role) for role in ROLES}
    return start_worker(tokens_file=tokens_file), tokens


CALLS = {
    "observe": [
        ("GET", "/v1/scenes", None),
        ("GET", "/v1/scenes/tiny/render?width=64", None),
        ("GET", "/v1/fleet", None),
        ("GET", "/metrics", None),
    ],
    "drive": [("POST", "/v1/sessions?scene=tiny", {})],
    "edit": [
        ("POST", "/v1/scenarios", {"scene": "tiny"}),
        ("POST", "/v1/assets", CUT),
        ("POST", "/v1/exports", VIDEO),
    ],
    "administer": [("PUT", "/v1/scenes/tiny/residency", None)],
}


@pytest.mark.parametrize("role", ROLES)
def test_each_role_allows_exactly_its_calls(site, role):
    client, tokens = site
    for needed, calls in CALLS.items():
        for method, path, body in calls:
            answer = client.request(method, path, json=body, headers=bearer(tokens[role]))
            if ROLES.index(role) >= ROLES.index(needed):
                assert answer.status_code < 300, answer.text
            else:
                assert (answer.status_code, answer.json()["code"]) == (403, "FORBIDDEN")
                assert needed in answer.json()["detail"]
                assert f"--role {needed}" in answer.json()["hint"]


def test_routes_require_the_expected_roles(client):
    paths = client.get("/openapi.json").json()["paths"]
    needed = {
        (method.upper(), path): needed_role(method.upper(), path)
        for path, methods in paths.items()
        for method in methods
        if method in ("get", "post", "put", "patch", "delete")
    }
    assert {role for (method, _), role in needed.items() if method == "GET"} == {"observe"}
    changing = {key: role for key, role in needed.items() if key[0] != "GET"}
    observed = [path for (_, path), role in changing.items() if role == "observe"]
    assert observed == ["/v1/scenes/{scene}/render"]
    administered = {path for (_, path), role in changing.items() if role == "administer"}
    assert administered == {"/v1/scenes", "/v1/scenes/{scene}/residency"}
    driven = {path for (_, path), role in changing.items() if role == "drive"}
    assert all(path.startswith(("/v1/sessions", "/v1/sweeps")) for path in driven)


def test_an_observer_token_cannot_reset_a_session(site):
    client, tokens = site
    made = client.post("/v1/sessions?scene=tiny", json={}, headers=bearer(tokens["drive"])).json()
    path = f"/v1/sessions/{made['session_id']}"
    assert client.get(f"{path}/state", headers=bearer(tokens["observe"])).status_code != 403
    refused = client.post(f"{path}/reset", json={}, headers=bearer(tokens["observe"]))
    assert (refused.status_code, refused.json()["code"]) == (403, "FORBIDDEN")
    # The session's own token has the role of its creator.
    assert client.post(f"{path}/reset", json={}, headers=bearer(made["token"])).status_code == 200


def test_a_token_without_a_role_administers(tokens_file):
    add_token(tokens_file, "old", TokenLimits())
    text = json.loads(tokens_file.read_text())
    del text["tokens"][0]["role"]
    tokens_file.write_text(json.dumps(text))
    assert read_token_file(tokens_file).tokens[0].role == "administer"


def test_jobs_of_a_token_are_limited(start_worker, tokens_file, held_videos):
    alice = add_token(tokens_file, "alice", TokenLimits(jobs=1))
    bob = add_token(tokens_file, "bob", TokenLimits())
    client = start_worker(tokens_file=tokens_file)
    first = client.post("/v1/exports", json=VIDEO, headers=bearer(alice)).json()["job_id"]
    refused = client.post("/v1/exports", json=VIDEO, headers=bearer(alice))
    assert (refused.status_code, refused.json()["code"]) == (429, "TOO_MANY_JOBS")
    assert client.post("/v1/exports", json=VIDEO, headers=bearer(bob)).status_code == 202
    client.delete(f"/v1/jobs/{first}", headers=bearer(alice))
    client.headers.update(bearer(bob))
    finished(client, f"/v1/jobs/{first}")
    assert client.post("/v1/exports", json=VIDEO, headers=bearer(alice)).status_code == 202


def test_changes_and_refusals_are_in_the_audit_log(site, tmp_path, capsys):
    client, tokens = site
    client.get("/v1/scenes", headers=bearer(tokens["observe"]))
    made = client.post(
        "/v1/scenarios",
        json={"scene": "tiny"},
        headers=bearer(tokens["edit"]) | {"X-Request-Id": "mine"},
    )
    assert made.status_code == 201
    client.post("/v1/scenarios", json={"scene": "tiny"}, headers=bearer(tokens["observe"]))
    client.post("/v1/scenarios", json={"scene": "tiny"}, headers=bearer("guessed"))
    client.portal.call(client.app.state.worker.audit.flush)

    audit(data=tmp_path / "data")
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = [(e["account"], e["method"], e["path"], e["status"]) for e in found]
    assert said == [
        ("", "POST", "/v1/scenarios", 401),
        ("observe", "POST", "/v1/scenarios", 403),
        ("edit", "POST", "/v1/scenarios", 201),
    ]
    assert (found[2]["request_id"], found[2]["worker_id"]) == ("mine", "w0")
    audit(data=tmp_path / "data", who="edit", last=1)
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_audit_entries_are_kept_until_the_store_recovers(client, monkeypatch):
    worker = client.app.state.worker
    add = worker.audit._log.add

    async def fail(_entries) -> None:
        raise worker_error

    from real2sim_server.service.storage.connection import StoreUnavailableError

    worker_error = StoreUnavailableError("gone")
    monkeypatch.setattr(worker.audit._log, "add", fail)
    client.post("/v1/scenarios", json={"scene": "tiny"})
    with pytest.raises(StoreUnavailableError):
        client.portal.call(worker.audit.flush)
    monkeypatch.setattr(worker.audit._log, "add", add)
    client.portal.call(worker.audit.flush)

    async def newest():
        return await worker.audit._log.newest(account=None, limit=10)

    assert [e.path for e in client.portal.call(newest)] == ["/v1/scenarios"]
