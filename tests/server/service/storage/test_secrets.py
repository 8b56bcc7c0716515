"""Session secrets cannot be read from a worker's files."""

from __future__ import annotations

import json
import sqlite3

import pytest

from real2sim_server.service.accounts import sealed, unsealed


@pytest.fixture
def created(start_worker):
    """A worker, and the answer to a session creation with an idempotency key."""
    client = start_worker()
    headers = {"Idempotency-Key": "made-once"}
    answer = client.post("/v1/sessions?scene=tiny", json={}, headers=headers)
    again = client.post("/v1/sessions?scene=tiny", json={}, headers=headers)
    assert again.headers["Idempotent-Replayed"] == "true"
    assert again.json() == answer.json()
    return client, answer.json()


def test_a_session_token_is_in_no_file_of_the_worker(created, tmp_path):
    _, info = created
    for file in (tmp_path / "data").rglob("*"):
        if file.is_file():
            assert info["token"].encode() not in file.read_bytes(), file.name


def test_a_session_accepts_its_token_but_not_the_stored_hash(created, tmp_path):
    client, info = created
    with sqlite3.connect(tmp_path / "data" / "real2sim.db") as connection:
        ((kept,),) = connection.execute("SELECT token_hash FROM sessions").fetchall()
    url = f"/v1/sessions/{info['session_id']}"
    for token, status in ((info["token"], 200), (kept, 401)):
        headers = {"Authorization": f"Bearer {token}"}
        assert client.get(url, headers=headers).status_code == status


def test_files_with_secrets_are_readable_by_their_owner_only(created, tmp_path):
    for name in ("real2sim.db", "worker.key", "worker.lock"):
        assert (tmp_path / "data" / name).stat().st_mode & 0o077 == 0


def test_a_stored_answer_is_decrypted_only_with_its_key():
    body = json.dumps({"token": "secret"}).encode()
    stored = sealed(body, "key")
    assert unsealed(stored, "key") == body
    assert b"secret" not in stored
    assert unsealed(stored, "other") != body
    assert sealed(body, "key") != stored
    assert unsealed(body, "any") == body
