"""What was acknowledged is there after the worker was killed."""

from __future__ import annotations

import random
import sqlite3
import threading
from contextlib import ExitStack, closing

import httpx2
import pytest

from ..worker_processes import KillableWorker
from .test_trouble import wait_until

pytestmark = pytest.mark.network

KILLS = 2
MOST_BETWEEN = 6


@pytest.fixture
def start(scenes_dir, tmp_path):
    """Starts workers in processes of their own on the same store; the next kills the one before."""
    folders = {"scenes": scenes_dir, "data": tmp_path / "data"}
    worker = KillableWorker(**folders, log_file=tmp_path / "worker.log")
    with ExitStack() as stack:
        stack.callback(worker.kill)

        def another() -> httpx2.Client:
            worker.kill()
            worker.start()
            worker.wait_listening()
            client = httpx2.Client(base_url=worker.url, trust_env=False, timeout=60)
            return stack.enter_context(client)

        yield another


def test_nothing_acknowledged_is_lost_between_any_two_requests(start):
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
            # The answer that was lost with the process can be asked for again.
            last = acknowledged[-1]
            again = client.post(
                last["url"], json=last["json"], headers={"Idempotency-Key": last["key"]}
            )
            assert again.headers["Idempotent-Replayed"] == "true"
            assert again.json()["revision"] == last["revision"]
        if round_ == KILLS:
            break
        for n in range(choose.randint(1, MOST_BETWEEN)):
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
def test_an_asset_whose_answer_was_not_stored_yet_is_answered_after_the_kill(start, tmp_path):
    client = start()
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "cut"}
    request = {"url": "/v1/assets", "json": cut, "headers": {"Idempotency-Key": "once"}}
    bundle = tmp_path / "data/assets/cut.r2a"
    wait_until(lambda: client.get("/readyz").status_code == 200, 60)
    with closing(sqlite3.connect(tmp_path / "data/real2sim.db")) as store:
        store.execute("BEGIN IMMEDIATE")  # Whoever writes waits.
        asking = threading.Thread(target=_without_answer, args=(client, request))
        asking.start()
        wait_until(bundle.exists)
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
    """Two workers in processes of their own on one store."""
    shared = {
        "REAL2SIM_STORE_URL": f"sqlite:///{tmp_path / 'shared.db'}",
        "REAL2SIM_LEASE_SECONDS": "1",
    }
    with ExitStack() as stack:
        workers = []
        for name in ("w0", "w1"):
            worker = KillableWorker(
                scenes=scenes_dir,
                data=tmp_path / name,
                log_file=tmp_path / f"{name}.log",
                settings=shared | {"REAL2SIM_WORKER_ID": name},
            )
            stack.callback(worker.kill)
            worker.start()
            worker.wait_listening()
            client = httpx2.Client(base_url=worker.url, trust_env=False, timeout=60)
            workers.append((worker, stack.enter_context(client)))
        yield workers


VIDEO = {"scene": "tiny", "camera": "front", "width": 960, "fps": 30}


def running(client: httpx2.Client) -> str:
    """Address of a job that draws."""
    job = client.post("/v1/exports", json=VIDEO).headers["Location"]
    wait_until(lambda: client.get(job).json()["progress"] > 0, 60)
    return job


@pytest.mark.slow
def test_a_job_of_a_killed_worker_is_done_by_another(two_workers):
    (first, client), (_, other) = two_workers
    job = running(client)
    assert other.get(job).json()["worker"] == "w0"
    first.kill()
    wait_until(lambda: other.get(job).json()["state"] == "succeeded", 120)
    done = other.get(job).json()
    assert (done["worker"], done["attempt"], done["result"]["frames"]) == ("w1", 2, 61)
    assert other.get(f"{job}/files/video.webm").status_code == 200


@pytest.mark.slow
def test_a_job_is_cancelled_by_way_of_another_worker(two_workers):
    (_, client), (_, other) = two_workers
    job = running(client)
    assert other.delete(job).json()["state"] == "cancelled"
    assert client.get(job).json()["state"] == "cancelled"


@pytest.mark.slow
def test_a_worker_that_was_killed_goes_on_with_its_jobs(start):
    job = running(start())
    client = start()
    assert client.get(job).json()["attempt"] == 2
    wait_until(lambda: client.get(job).json()["state"] == "succeeded", 120)


@pytest.mark.slow
def test_a_data_set_goes_on_with_the_clips_that_it_had(start):
    body = {"kind": "dataset", "scene": "tiny", "formats": ["kitti"], "width": 320}
    client = start()

    def archive(job: str) -> bytes:
        wait_until(lambda: client.get(job).json()["state"] == "succeeded", 120)
        return client.get(f"{job}/files/dataset.tar").content

    def begun() -> str:
        asked = body | {"clip_s": 0.3, "period_us": 50_000}
        return client.post("/v1/exports", json=asked).headers["Location"]

    undisturbed = archive(begun())
    job = begun()
    wait_until(lambda: client.get(job).json()["progress"] > 0.4, 120)
    client = start()
    seen: list[float] = []
    wait_until(lambda: seen.append(client.get(job).json()["progress"]) or seen[-1] > 0, 120)
    assert seen[-1] > 0.2
    assert archive(job) == undisturbed
