"""Full or unwritable disks, clock shifts, and a database outage of half a minute. Each has a
specific error, no data is lost, and the worker recovers without help."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import httpx2
import pytest

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_server.demo.run import worker_process
from real2sim_server.scene.io import save_scene, write_splats
from tests.waiting import wait_until

from .failing_system import BROKEN, NO_SPACE, READ_ONLY, FailingSystem, failing_system
from .postgres import Postgres, running_postgres
from .test_trouble import Site, assert_told, filled, stopped
from .waiting import accepted, finished, is_ready, succeeded, wait_ready

pytestmark = pytest.mark.network

OUTAGE_S, MIN_ROUNDS = 30.0, 20
PATIENT = {"REAL2SIM_STORE_TIMEOUT_SECONDS": "60"}
"""Slower than any working disk, even on a busy machine."""
JOB = {"scene": "tiny", "camera": "front", "fps": 2, "width": 64}
CUT = {"scene": "tiny", "object_id": "car_red"}


# --- unwritable disk ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def system(tmp_path_factory) -> FailingSystem:
    place = tmp_path_factory.mktemp("system")
    return failing_system(place / "data", place)


@pytest.fixture(scope="module")
def apart(system, tiny_scene, worker_kernels) -> Iterator[httpx2.Client]:
    """A worker in its own process on the failing system."""
    scenes = system.folder.parent / "scenes"
    save_scene(tiny_scene, scenes / "tiny.r2s")
    log_file = system.folder.parent / "worker.log"
    with (
        mock.patch.dict(os.environ, system.environment | PATIENT),
        worker_process(scenes=scenes, data=system.folder, log_file=log_file) as worker,
        httpx2.Client(base_url=worker.url, trust_env=False, timeout=None) as client,
    ):
        wait_ready(client)
        yield client
        assert "Traceback" not in log_file.read_text()


def test_an_unwritable_folder_is_reported_and_no_data_is_lost(apart, system):
    site = Site(apart)
    assert site.edit().status_code == 200
    for number, code, status in (
        (READ_ONLY, "STORAGE_UNAVAILABLE", 503),
        (BROKEN, "STORAGE_UNAVAILABLE", 503),
    ):
        assert site.step().status_code == 200
        with system.refusing_writes(number):
            assert_told(site.edit(f"edit {number}"), code, status)
            assert_told(site.step(f"step {number}"), code, status)
            cut = CUT | {"asset_id": f"car_{number}"}
            assert_told(apart.post("/v1/assets", json=cut), code, status)
            assert_told(apart.post("/v1/exports", json=JOB), code, status)
            assert not is_ready(apart)
            assert apart.get("/livez").status_code == 200
            site.check_nothing_is_lost()
            assert apart.get("/v1/scenes/tiny/render?width=32").status_code == 200
        wait_ready(apart)
        assert site.edit(f"edit {number}").status_code == 200
        assert site.step(f"step {number}").status_code == 200
        assert apart.post("/v1/assets", json=cut).status_code == 201
        site.check_nothing_is_lost()


def test_an_upload_to_an_unwritable_folder_is_refused(apart, system, tmp_path, tiny_scene):
    write_splats(tiny_scene.background, tmp_path / "car.ply")
    form = {"data": {"asset_id": "car", "category": "car"}}

    def upload():
        return apart.post(
            "/v1/assets", files={"file": ("car.ply", (tmp_path / "car.ply").read_bytes())}, **form
        )

    for number, code, status in (
        (READ_ONLY, "STORAGE_UNAVAILABLE", 503),
        (NO_SPACE, "STORAGE_FULL", 507),
    ):
        with system.refusing_writes(number):
            assert_told(upload(), code, status)
    assert upload().status_code == 201


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (READ_ONLY, "STORAGE_UNAVAILABLE"),
        (NO_SPACE, "STORAGE_FULL"),
    ],
)
def test_a_job_with_unwritable_files_fails_with_a_storage_error(apart, system, number, code):
    # The job's folder, the encoder's output, and the final video.
    for refused in ("jobs/job_*", "jobs/job_*/.video*", "jobs/job_*/video.webm"):
        with system.refusing_writes(number, to=refused):
            ended = finished(apart, apart.post("/v1/exports", json=JOB))
        assert ended["state"] == "failed", refused
        assert ended["error"]["code"] == code, refused


def test_a_clock_set_back_and_forth_by_an_hour_has_no_effect(apart, system):
    site = Site(apart)
    assert site.edit("before").status_code == 200
    before = apart.get("/v1/scenarios").json()["scenarios"]
    made = []
    for k, seconds in enumerate((-3600, 0)):
        system.set_clock(seconds)
        assert site.edit("before").headers["Idempotent-Replayed"] == "true"
        site.edits -= 1
        assert site.edit(f"new {k}").status_code == 200
        assert site.step(f"new {k}").status_code == 200
        assert site.step(f"new {k}").headers["Idempotent-Replayed"] == "true"
        site.steps -= 1
        made.append(apart.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"])
        succeeded(apart, apart.post("/v1/exports", json=JOB))
        assert is_ready(apart)
    listed = [s["scenario_id"] for s in apart.get("/v1/scenarios").json()["scenarios"]]
    assert [f"/v1/scenarios/{i}" for i in listed[len(before) :]] == made
    site.check_nothing_is_lost()


def rounds() -> Iterator[None]:
    """Rounds of an outage, until it has lasted long enough with enough rounds."""
    began, count = time.monotonic(), 0
    while count < MIN_ROUNDS or time.monotonic() - began < OUTAGE_S:
        yield
        time.sleep(0.5)
        count += 1


# --- database outage ----------------------------------------------------------------------------


@pytest.fixture
def own_postgres() -> Iterator[Postgres]:
    with (
        tempfile.TemporaryDirectory(prefix="real2sim-pg-") as folder,
        running_postgres(Path(folder)) as server,
    ):
        yield server


@pytest.mark.slow
@pytest.mark.parametrize("trouble", [stopped, Postgres.frozen], ids=["stopped", "frozen"])
def test_a_database_outage_of_half_a_minute_loses_no_data(trouble, own_postgres, start_worker):
    client = start_worker(store_url=own_postgres.new_database(), store_timeout_seconds=2)
    site = Site(client)
    accepted(lambda: site.edit("first"))
    job = accepted(lambda: client.post("/v1/exports", json=JOB))
    made = accepted(lambda: client.post("/v1/sessions?scene=tiny")).json()
    url = f"/v1/sessions/{made['session_id']}/drive"
    with client.websocket_connect(
        url, subprotocols=[DRIVE_SUBPROTOCOL], headers={"Host": "127.0.0.1"}
    ) as drive:

        def say(**fields):
            drive.send_bytes(encode({"v": 1, "id": 1, **fields}))
            while (said := decode(drive.receive_bytes()))["type"] == "progress":
                pass
            return said

        hello = say(type="hello", protocols=[DRIVE_SUBPROTOCOL], token=made["token"])
        assert hello["type"] == "welcome"
        assert say(type="reset", spec={"action": "control"})["type"] == "obs"
        plan = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
        with trouble(own_postgres):
            for _ in rounds():
                assert_told(site.edit("edit"), "STORAGE_UNAVAILABLE", 503)
                assert_told(site.step("step"), "STORAGE_UNAVAILABLE", 503)
                said = say(type="action", step=0, plan=plan)
                assert (said["code"], said["fatal"]) == ("STORAGE_UNAVAILABLE", False)
                assert not is_ready(client)
                assert client.get("/livez").status_code == 200
        wait_ready(client)
        wait_until(lambda: say(type="action", step=0, plan=plan).get("step") == 1, "a step")
    for key in ("edit", "edit"):
        accepted(lambda key=key: site.edit(key))
    site.edits -= 1
    for key in ("step", "step"):
        accepted(lambda key=key: site.step(key))
    site.steps -= 1
    succeeded(client, job)
    site.check_nothing_is_lost()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "status"),
    [(READ_ONLY, "STORAGE_UNAVAILABLE", 503), (NO_SPACE, "STORAGE_FULL", 507)],
    ids=["read-only", "full"],
)
def test_an_unwritable_folder_for_half_a_minute_loses_no_data(apart, system, number, code, status):
    site = Site(apart)
    assert site.edit().status_code == 200
    assert site.step().status_code == 200
    cut = CUT | {"asset_id": f"car_{code.lower()}"}
    with system.refusing_writes(number):
        for _ in rounds():
            assert_told(site.edit("edit"), code, status)
            assert_told(site.step("step"), code, status)
            assert_told(apart.post("/v1/assets", json=cut), code, status)
            assert not is_ready(apart)
            assert apart.get("/livez").status_code == 200
        site.check_nothing_is_lost()
    wait_ready(apart)
    assert site.edit("edit").status_code == 200
    assert site.step("step").status_code == 200
    assert apart.post("/v1/assets", json=cut).status_code == 201
    site.check_nothing_is_lost()


@pytest.mark.slow
def test_a_full_disk_for_half_a_minute_loses_no_data(small_disk, start_worker):
    """Uses a real small disk, if the test may mount one."""
    client = start_worker(data_dir=small_disk / "data")
    site = Site(client)
    assert site.edit().status_code == 200
    with filled(small_disk):
        for _ in rounds():
            # An episode has only a few steps.
            steps = [site.step()] if site.steps < 10 else []
            for answer in (site.edit(), *steps):
                if answer.status_code != 200:  # The journal may have a few pages left.
                    assert_told(answer, "STORAGE_FULL", 507)
            assert client.get("/livez").status_code == 200
        wait_until(lambda: site.edit().status_code != 200 and not is_ready(client), "a full disk")
        site.check_nothing_is_lost()
    wait_ready(client)
    assert site.edit().status_code == 200
    assert site.step().status_code == 200
    site.check_nothing_is_lost()


@pytest.mark.slow
def test_a_clock_an_hour_behind_for_half_a_minute_has_no_effect(apart, system):
    site = Site(apart)
    assert site.edit("before").status_code == 200
    made = []
    system.set_clock(-3600)
    try:
        for _ in rounds():
            assert site.edit("before").headers["Idempotent-Replayed"] == "true"
            site.edits -= 1
            assert site.edit().status_code == 200
            if site.steps < 10:  # An episode has only a few steps.
                assert site.step().status_code == 200
            made.append(apart.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"])
            assert is_ready(apart)
    finally:
        system.set_clock(0)
    assert site.edit("before").headers["Idempotent-Replayed"] == "true"
    site.edits -= 1
    assert site.step().status_code == 200
    listed = [s["scenario_id"] for s in apart.get("/v1/scenarios").json()["scenarios"]]
    assert [f"/v1/scenarios/{i}" for i in listed[-len(made) :]] == made
    site.check_nothing_is_lost()
