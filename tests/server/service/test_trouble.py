"""Error responses during a full disk, a database outage, and a clock shift. Acknowledged writes
survive and the worker recovers without help."""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from real2sim_server.service import clock as clock_module
from real2sim_server.service.storage.connection import StoreTroubleError
from tests.waiting import LIMIT_S, wait_until

from .postgres import Postgres, running_postgres
from .waiting import accepted, succeeded, wait_ready

MOVE = {"operations": [{"op": "translate", "object_id": "post", "x": 0.25}]}
TIMEOUT_S = 2.0


class Site:
    """A worker with a scenario, and a session that has made one step."""

    def __init__(self, client: TestClient) -> None:
        self.client = client
        scenario = accepted(lambda: client.post("/v1/scenarios", json={"scene": "tiny"}))
        self.scenario = scenario.headers["Location"]
        reset = {"reset": {"action": "control"}}
        session = accepted(lambda: client.post("/v1/sessions?scene=tiny", json=reset)).json()
        self.session = f"/v1/sessions/{session['session_id']}"
        self.token = {"Authorization": f"Bearer {session['token']}"}
        self.edits = 0
        self.steps = 0

    def edit(self, key: str | None = None):
        headers = {"Idempotency-Key": key} if key else {}
        answer = self.client.post(f"{self.scenario}/operations", json=MOVE, headers=headers)
        self.edits += answer.status_code == 200
        return answer

    def step(self, key: str | None = None):
        headers = self.token | ({"Idempotency-Key": key} if key else {})
        answer = self.client.post(f"{self.session}/step", json={}, headers=headers)
        self.steps += answer.status_code == 200
        return answer

    def state(self):
        return self.client.get(f"{self.session}/state", headers=self.token)

    def check_nothing_is_lost(self) -> None:
        scenario = accepted(lambda: self.client.get(self.scenario)).json()
        assert scenario["revision"] == self.edits
        assert accepted(self.state).json()["step"] == self.steps


def assert_told(answer, code: str, status: int) -> None:
    assert answer.status_code == status, answer.text
    problem = answer.json()
    assert (problem["code"], problem["retryable"]) == (code, True)
    assert float(answer.headers["Retry-After"]) > 0


def reasons(client: TestClient) -> list[str]:
    """Reasons why a worker is not ready."""
    return client.get("/readyz").json().get("reasons", [])


@contextlib.contextmanager
def filled(disk: Path) -> Iterator[None]:
    """Fill the disk to the last byte inside the block."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    try:
        yield
    finally:
        ballast.unlink()


def test_a_full_disk_refuses_writes_but_not_reads(small_disk, start_worker):
    client = start_worker(data_dir=small_disk / "data")
    site = Site(client)
    assert site.edit().status_code == 200
    assert site.step().status_code == 200
    with filled(small_disk):
        for _ in range(10):
            step = site.step()
            if step.status_code != 200:
                assert_told(step, "STORAGE_FULL", 507)
        # The journal may have a few pages left.
        edits = (site.edit() for _ in range(500))
        refused = next(answer for answer in edits if answer.status_code != 200)
        assert_told(refused, "STORAGE_FULL", 507)
        full = ["the worker has no space left to store anything"]

        def is_full() -> bool:
            # If the journal has a free page, the next check finds the store healthy again.
            return site.edit().status_code != 200 and reasons(client) == full

        wait_until(is_full, lambda: f"a full disk: {reasons(client)}")
        assert client.get("/livez").status_code == 200
        site.check_nothing_is_lost()
    wait_ready(client)
    assert site.edit().status_code == 200
    assert site.step().status_code == 200
    site.check_nothing_is_lost()


@pytest.fixture
def own_postgres() -> Iterator[Postgres]:
    with (
        tempfile.TemporaryDirectory(prefix="real2sim-pg-") as folder,
        running_postgres(Path(folder)) as server,
    ):
        yield server


@pytest.fixture
def site(own_postgres, start_worker) -> Site:
    """A worker whose database can be stopped."""
    url = own_postgres.new_database()
    site = Site(start_worker(store_url=url, store_timeout_seconds=TIMEOUT_S))
    accepted(lambda: site.edit("first edit"))
    accepted(lambda: site.step("first step"))
    return site


@contextlib.contextmanager
def stopped(server: Postgres) -> Iterator[None]:
    server.stop()
    try:
        yield
    finally:
        server.start()


@pytest.mark.parametrize("trouble", [stopped, Postgres.frozen], ids=["stopped", "frozen"])
def test_a_database_outage_is_reported_and_recovers(trouble, site, own_postgres):
    with trouble(own_postgres):
        assert_told(site.edit("once"), "STORAGE_UNAVAILABLE", 503)
        for _ in range(5):
            assert_told(site.edit("once"), "STORAGE_UNAVAILABLE", 503)
            assert_told(site.step(), "STORAGE_UNAVAILABLE", 503)
        readiness = site.client.get("/readyz")
        assert readiness.status_code == 503
        assert any("store" in reason for reason in readiness.json()["reasons"])
        assert site.client.get("/livez").status_code == 200
    wait_ready(site.client)
    accepted(lambda: site.step("once"))
    accepted(lambda: site.edit("once"))
    assert accepted(lambda: site.edit("once")).headers["Idempotent-Replayed"] == "true"
    site.edits -= 1
    site.check_nothing_is_lost()


def test_a_database_that_freezes_during_a_step_keeps_the_session_consistent(site, own_postgres):
    with own_postgres.frozen():
        assert_told(site.step("once"), "STORAGE_UNAVAILABLE", 503)
    # Whether the frozen database applied the write is unknown.
    wait_ready(site.client)
    for key in ("once", "twice", "thrice"):
        accepted(lambda key=key: site.step(key))
    site.check_nothing_is_lost()


def test_a_job_that_ends_during_a_database_outage_is_recorded_afterwards(
    site, own_postgres, monkeypatch, held_videos
):
    tried = threading.Event()
    job_log = site.client.app.state.worker.jobs._log
    update = job_log.update

    async def noted(info, *, epoch) -> None:
        try:
            await update(info, epoch=epoch)
        except StoreTroubleError:
            if info.over:
                tried.set()
            raise

    monkeypatch.setattr(job_log, "update", noted)
    body = {"scene": "tiny", "camera": "front", "fps": 1, "width": 64}
    job = accepted(lambda: site.client.post("/v1/exports", json=body))
    assert held_videos.begun.wait(LIMIT_S)
    with stopped(own_postgres):
        held_videos.released.set()
        assert tried.wait(LIMIT_S)
    wait_ready(site.client)
    succeeded(site.client, job)


def test_a_clock_set_back_by_an_hour_has_no_effect(client, monkeypatch):
    site = Site(client)
    assert site.edit("before").status_code == 200
    hour_ns, time_ns = 3600 * 10**9, time.time_ns
    monkeypatch.setattr(clock_module.time, "time_ns", lambda: time_ns() - hour_ns)
    again = site.edit("before")
    assert again.headers["Idempotent-Replayed"] == "true"
    site.edits -= 1
    later = client.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
    listed = [s["scenario_id"] for s in client.get("/v1/scenarios").json()["scenarios"]]
    assert [f"/v1/scenarios/{i}" for i in listed] == [site.scenario, later]
    assert site.edit("after").status_code == 200
    assert site.step().status_code == 200
    site.check_nothing_is_lost()
