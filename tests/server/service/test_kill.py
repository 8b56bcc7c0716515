"""Acknowledged writes survive a killed worker."""

from __future__ import annotations

import random
import sqlite3
import threading
from contextlib import ExitStack, closing
from pathlib import Path

import httpx2
import pytest

from tests.waiting import wait_until

from ..worker_processes import KillableWorker
from .waiting import finished, succeeded, wait_ready

pytestmark = pytest.mark.network

HOLD = """
import asyncio, os
from real2sim_server.service import exports

drawn, render_frame = [], exports._render_frame

async def render_unless_held(renderer, render_request, context):
    while drawn and os.path.exists({path!r}):
        context.check()
        await asyncio.sleep(0.01)
    drawn.append(await render_frame(renderer, render_request, context))
    return drawn[-1]

exports._render_frame = render_unless_held
"""
"""Worker code that pauses videos after their first frame while a file exists."""

KILLS = 2
MAX_BETWEEN = 6


@pytest.fixture
def start(scenes_dir, tmp_path):
    """Start workers in processes on the same store. Each start kills the previous worker."""
    worker = KillableWorker(
        scenes=scenes_dir,
        data=tmp_path / "data",
        log_file=tmp_path / "worker.log",
        before=HOLD.format(path=str(tmp_path / "hold")),
    )
    with ExitStack() as stack:
        stack.callback(worker.kill)

        def another() -> httpx2.Client:
            worker.kill()
            worker.start()
            worker.wait_listening()
            client = httpx2.Client(base_url=worker.url, trust_env=False, timeout=None)
            return stack.enter_context(client)

        yield another


@pytest.mark.slow
def test_acknowledged_writes_survive_kills_between_requests(start):
    choose = random.Random(7)
    client = start()
    url = client.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
    acknowledged: list[dict] = []
    asset = {"scene": "tiny", "object_id": "car_red", "asset_id": "kept"}
    assert client.post("/v1/assets", json=asset).status_code == 201

    for round_ in range(KILLS + 1):
        history = client.get(f"{url}/operations").json()
        assert [e["revision"] for e in history["entries"]] == [a["revision"] for a in acknowledged]
        assert client.get(url).json()["revision"] == len(acknowledged)
        assert client.get("/v1/assets/kept").status_code == 200
        if acknowledged:
            # The lost answer can be requested again.
            last = acknowledged[-1]
            again = client.post(
                last["url"], json=last["json"], headers={"Idempotency-Key": last["key"]}
            )
            assert again.headers["Idempotent-Replayed"] == "true"
            assert again.json()["revision"] == last["revision"]
        if round_ == KILLS:
            break
        for n in range(choose.randint(1, MAX_BETWEEN)):
            key = f"{round_}-{n}"
            json = {"operations": [{"op": "translate", "object_id": "post", "x": 0.5}]}
            target = f"{url}/operations"
            if acknowledged and choose.random() < 0.4:
                target, json = f"{url}/undo", None
            answer = client.post(target, json=json, headers={"Idempotency-Key": key})
            if answer.status_code == 200:
                revision = answer.json()["revision"]
                done = {"revision": revision, "url": target, "json": json, "key": key}
                acknowledged.append(done)
        client = start()


@pytest.mark.slow
def test_an_asset_without_a_stored_answer_is_answered_after_the_kill(start, tmp_path):
    client = start()
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "cut"}
    request = {"url": "/v1/assets", "json": cut, "headers": {"Idempotency-Key": "once"}}
    bundle = tmp_path / "data/assets/cut.r2a"
    wait_ready(client)
    with closing(sqlite3.connect(tmp_path / "data/real2sim.db")) as store:
        store.execute("BEGIN IMMEDIATE")  # Blocks all writers.
        asking = threading.Thread(target=_without_answer, args=(client, request))
        asking.start()
        wait_until(bundle.exists, "the asset's files")
        client = start()
        asking.join()
        store.rollback()
    again = client.post(**request)
    assert again.status_code == 201, again.text
    assert client.get("/v1/assets/cut").json() == again.json()
    other = client.post(**request | {"headers": {"Idempotency-Key": "twice"}})
    assert other.json()["code"] == "ALREADY_EXISTS"


def _without_answer(client: httpx2.Client, request: dict) -> None:
    with pytest.raises(httpx2.HTTPError):
        client.post(**request)


@pytest.fixture
def two_workers(scenes_dir, tmp_path):
    """Two workers in their own processes on one store."""
    # Leases expire only when a test lets them.
    shared = {
        "REAL2SIM_STORE_URL": f"sqlite:///{tmp_path / 'shared.db'}",
        "REAL2SIM_LEASE_SECONDS": "600",
    }
    with ExitStack() as stack:
        workers = []
        for name in ("w0", "w1"):
            worker = KillableWorker(
                scenes=scenes_dir,
                data=tmp_path / name,
                log_file=tmp_path / f"{name}.log",
                settings=shared | {"REAL2SIM_WORKER_ID": name},
                before=HOLD.format(path=str(tmp_path / "hold")),
            )
            stack.callback(worker.kill)
            worker.start()
            worker.wait_listening()
            client = httpx2.Client(base_url=worker.url, trust_env=False, timeout=None)
            workers.append((worker, stack.enter_context(client)))
        yield workers


VIDEO = {"scene": "tiny", "camera": "front", "width": 64, "fps": 4}


def running(client: httpx2.Client, tmp_path: Path) -> str:
    """Path of a job that has drawn one frame. It draws the next once ``hold`` is removed."""
    (tmp_path / "hold").touch()
    job = client.post("/v1/exports", json=VIDEO).headers["Location"]
    wait_until(lambda: client.get(job).json()["progress"] > 0, "the first frame")
    return job


@pytest.mark.slow
def test_a_job_of_a_killed_worker_is_completed_by_another(two_workers, tmp_path):
    (first, client), (_, other) = two_workers
    job = running(client, tmp_path)
    assert other.get(job).json()["worker"] == "w0"
    first.kill()
    with closing(sqlite3.connect(tmp_path / "shared.db", timeout=60)) as store, store:
        store.execute("UPDATE workers SET lease_until_us = 0 WHERE worker_id = 'w0'")
    (tmp_path / "hold").unlink()
    done = succeeded(other, job)
    assert (done["worker"], done["attempt"], done["result"]["frames"]) == ("w1", 2, 9)
    assert other.get(f"{job}/files/video.webm").status_code == 200


@pytest.mark.slow
def test_a_job_is_cancelled_through_another_worker(two_workers, tmp_path):
    (_, client), (_, other) = two_workers
    job = running(client, tmp_path)
    cancelled = other.delete(job)
    assert cancelled.status_code == 200, cancelled.text
    assert finished(other, job)["state"] == finished(client, job)["state"] == "cancelled"


@pytest.mark.slow
def test_a_restarted_worker_resumes_its_jobs(start, tmp_path):
    job = running(start(), tmp_path)
    client = start()
    assert client.get(job).json()["attempt"] == 2
    (tmp_path / "hold").unlink()
    succeeded(client, job)


@pytest.mark.slow
def test_a_data_set_resumes_with_its_finished_clips(start):
    body = {"kind": "dataset", "scene": "tiny", "formats": ["kitti"], "width": 320}
    client = start()

    def archive(job: str) -> bytes:
        succeeded(client, job)
        return client.get(f"{job}/files/dataset.tar").content

    def begun() -> str:
        asked = body | {"clip_s": 0.3, "period_us": 50_000}
        return client.post("/v1/exports", json=asked).headers["Location"]

    undisturbed = archive(begun())
    job = begun()
    wait_until(lambda: client.get(job).json()["progress"] > 0.4, "some clips")
    client = start()
    seen: list[float] = []
    wait_until(lambda: seen.append(client.get(job).json()["progress"]) or seen[-1] > 0, "progress")
    assert seen[-1] > 0.2
    assert archive(job) == undisturbed
