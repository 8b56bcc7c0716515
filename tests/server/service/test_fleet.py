"""Several workers on one store. A session continues on another worker when its own is gone, and
runs on one worker only. A request to the wrong worker gets a retryable error."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from real2sim_server.service.accounts import TokenLimits, add_token
from tests.waiting import wait_until

from .test_accounts import bearer
from .test_trouble import Site

LEASE_S = 300.0
"""Longer than any test. A lease only expires through :func:`put_to_sleep` [s]."""


@pytest.fixture
def store_url(tmp_path) -> str:
    return f"sqlite:///{tmp_path / 'shared.db'}"


@pytest.fixture
def start(run_worker, start_worker, store_url, tmp_path):
    """Start workers that share a store. Keyword arguments are other settings."""

    def start(worker_id: str, starter=start_worker, **settings):
        common = {"store_url": store_url, "lease_seconds": LEASE_S}
        return starter(worker_id=worker_id, data_dir=tmp_path / worker_id, **(common | settings))

    return start


def put_to_sleep(client: TestClient, monkeypatch) -> Callable[[], None]:
    """Let a worker's lease expire without its knowledge. Returns a function that wakes it up."""
    worker, awake = client.app.state.worker, threading.Event()
    leases, promise = worker.leases, worker.leases.renew

    async def renew(document) -> None:
        while not awake.is_set():
            await asyncio.sleep(0.02)
        await promise(document)

    def wake() -> None:
        worker.membership._renewed = time.monotonic() - 2 * LEASE_S
        awake.set()
        tell(client)

    monkeypatch.setattr(leases, "renew", renew)
    client.portal.call(leases.give_up, {})
    return wake


def tell(client: TestClient) -> None:
    """Let a worker renew its lease, publish its state and read that of others now."""
    client.portal.call(client.app.state.worker.membership.tell)


def by(client: TestClient, site: Site) -> Site:
    """The same session, accessed through another client."""
    other = object.__new__(Site)
    other.__dict__ = site.__dict__ | {"client": client}
    return other


def test_a_session_of_a_live_worker_is_refused_elsewhere_with_retry_after(start):
    site = Site(start("w0"))
    assert site.step().status_code == 200
    answer = by(start("w1"), site).step()
    assert (answer.status_code, answer.json()["code"]) == (503, "SESSION_ELSEWHERE")
    assert answer.json()["retryable"]
    assert float(answer.headers["Retry-After"]) > 0
    assert site.step().json()["step"] == 2


def test_a_session_continues_identically_on_another_worker(start, run_worker):
    undisturbed = Site(start("w5"))
    with start("w0", run_worker) as first:
        site = Site(first)
        for each in (site, undisturbed):
            assert [each.step().status_code for _ in range(2)] == [200, 200]
    other = by(start("w1"), site)
    own = {"session_id": "", "planning_ms": None}
    assert other.step().json() | own == undisturbed.step().json() | own
    assert other.state().json()["step"] == 3


def test_a_worker_with_an_expired_lease_cannot_write(start, monkeypatch):
    first = start("w0")
    site = Site(first)
    assert site.step("one").status_code == 200
    put_to_sleep(first, monkeypatch)
    other = by(start("w1"), site)
    assert other.step("two").json()["step"] == 2

    late = site.step("three")
    assert (late.status_code, late.json()["code"]) == (503, "SESSION_ELSEWHERE")
    # Also after it has noticed that it lost the session.
    again = site.step("three")
    assert again.json()["code"] == "SESSION_ELSEWHERE"
    assert other.step("three").json()["step"] == 3


def test_a_waking_worker_drops_sessions_that_were_taken_over(start, monkeypatch):
    first = start("w0")
    site, kept = Site(first), Site(first)
    wake = put_to_sleep(first, monkeypatch)
    other = by(start("w1"), site)
    assert other.step().status_code == 200
    wake()
    assert len(first.app.state.worker.sessions) == 1
    assert kept.step().status_code == 200


def test_the_driver_of_a_session_that_was_taken_over_is_notified(start, monkeypatch):
    first = start("w0")
    site = Site(first)
    session = first.app.state.worker.sessions._open[site.session.rpartition("/")[2]]
    told = []

    async def close(error) -> None:
        told.append(error.code.value)

    session.close_callbacks.add(close)
    put_to_sleep(first, monkeypatch)
    assert by(start("w1"), site).step().status_code == 200
    site.step()
    wait_until(lambda: told == ["SESSION_ELSEWHERE"], "the driver to be told")


def test_a_session_can_return_to_its_restarted_worker(start, run_worker):
    with start("w0", run_worker) as first:
        site = Site(first)
        assert site.step().status_code == 200
    with start("w1", run_worker) as second:
        assert by(second, site).step().json()["step"] == 2
    again = by(start("w0"), site)
    assert again.step().json()["step"] == 3


def test_a_deleted_session_is_closed_on_every_worker(start):
    site = Site(start("w0"))
    assert site.client.delete(site.session, headers=site.token).status_code == 204
    assert by(start("w1"), site).step().json()["code"] == "SESSION_CLOSED"


def test_token_limits_apply_across_all_workers(start, tmp_path, held_videos):
    tokens = tmp_path / "tokens.json"
    held = bearer(add_token(tokens, "alice", TokenLimits(sessions=2, jobs=1)))
    one, other = (start(name, tokens_file=tokens) for name in ("w0", "w1"))
    for client in (one, other):
        made = client.post("/v1/sessions?scene=tiny", json={}, headers=held)
        assert made.status_code == 201, made.text
    video = {"scene": "tiny", "camera": "front", "fps": 1, "width": 64}
    assert one.post("/v1/exports", json=video, headers=held).status_code == 202
    for client in (one, other, one):
        tell(client)
    for client in (one, other):
        refused = client.post("/v1/sessions?scene=tiny", json={}, headers=held)
        assert (refused.status_code, refused.json()["code"]) == (429, "TOO_MANY_SESSIONS")
        assert "2 sessions are open" in refused.json()["detail"]
    refused = other.post("/v1/exports", json=video, headers=held)
    assert (refused.status_code, refused.json()["code"]) == (429, "TOO_MANY_JOBS")
    url = f"/v1/sessions/{made.json()['session_id']}"
    assert other.delete(url, headers=held).status_code == 204
    for client in (other, one):
        tell(client)
    assert one.post("/v1/sessions?scene=tiny", json={}, headers=held).status_code == 201


def test_any_worker_reports_the_whole_fleet(start, run_worker):
    with start("w1", run_worker):
        first = start("w0")
        Site(first)
    tell(first)
    found = {w["worker_id"]: w for w in start("w2").get("/v1/fleet").json()["workers"]}
    assert found["w0"]["sessions"] == 1
    assert [found[name]["alive"] for name in ("w0", "w1", "w2")] == [True, False, True]
    assert found["w0"]["scenes"] == ["tiny"]
