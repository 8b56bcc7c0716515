"""Workers with separate folders that share a database and an object store."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable

import pytest

from real2sim_server.service import membership
from real2sim_server.service.shared_objects import FolderObjects
from tests.waiting import LIMIT_S, wait_until

from ..library.test_assets import CUT
from ..test_trouble import Site
from ..waiting import succeeded


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(membership, "LOOK_S", 0.05)


@pytest.fixture
def start(start_worker, tmp_path, scenes_dir) -> Callable:
    """Start workers. Only the first, ``w0``, has scenes in its folder."""

    def start(worker_id: str, objects_url: str = f"file://{tmp_path / 'objects'}"):
        folder = tmp_path / worker_id
        scenes = folder / "scenes"
        if worker_id == "w0":
            shutil.copytree(scenes_dir, scenes)
        scenes.mkdir(parents=True, exist_ok=True)
        return start_worker(
            worker_id=worker_id,
            data_dir=folder,
            scenes_dir=scenes,
            store_url=f"sqlite:///{tmp_path / 'shared.db'}",
            objects_url=objects_url,
        )

    return start


def shared(client) -> set[tuple[str, str]]:
    return set(client.app.state.worker.sharing._known)


def wait_shared(client, kind: str, name: str) -> None:
    """Wait until the object store has the bundle."""
    wait_until(lambda: (kind, name) in shared(client), f"{kind} {name} to be shared")


def wait_status(client, path: str, status: int) -> None:
    """Wait until a GET returns this status."""
    wait_until(lambda: client.get(path).status_code == status, f"{status} for {path}")


def test_a_session_starts_on_a_worker_without_the_scene(start, objects_url):
    first = start("w0", objects_url)
    wait_shared(first, "scene", "tiny")
    second = start("w1", objects_url)
    ours, theirs = (
        c.app.state.worker.scene_cache.catalog.scan().get("tiny") for c in (second, first)
    )
    assert ours is None
    assert theirs is not None
    assert Site(second).step().status_code == 200


def test_a_scene_missing_everywhere_is_unknown(start):
    assert start("w1").get("/v1/scenes/nowhere").json()["code"] == "UNKNOWN_SCENE"


def test_job_files_are_available_from_any_worker(start, objects_url):
    first = start("w0", objects_url)
    body = {"scene": "tiny", "camera": "front", "width": 64, "fps": 2}
    asked = first.post("/v1/exports", json=body)
    assert asked.status_code == 202, asked.text
    job = asked.headers["Location"]
    (name,) = (one["name"] for one in succeeded(first, job)["files"])
    there = first.get(f"{job}/files/{name}")
    wait_shared(first, "job", job.rpartition("/")[2])

    second = start("w1", objects_url)
    here = second.get(f"{job}/files/{name}")
    assert (here.status_code, here.content) == (200, there.content)
    part = second.get(f"{job}/files/{name}", headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, there.content[10:20])
    signed = second.get(f"{job}/files/{name}?signed=true", follow_redirects=False)
    assert signed.status_code == (307 if objects_url.startswith("s3") else 200)

    assert second.delete(job).status_code == 204
    wait_until(lambda: ("job", job.rpartition("/")[2]) not in shared(second), "its files to go")


def test_an_asset_is_added_and_deleted_on_all_workers(start):
    first, second = start("w0"), start("w1")
    assert first.post("/v1/assets", json=CUT).status_code == 201
    wait_status(second, "/v1/assets/red", 200)
    assert second.get("/v1/assets/red").json() == first.get("/v1/assets/red").json()
    assert second.delete("/v1/assets/red").status_code == 204
    wait_status(first, "/v1/assets/red", 404)
    # The id can be reused for a different asset.
    again = CUT | {"object_id": "post"}
    assert first.post("/v1/assets", json=again).status_code == 201
    wait_status(second, "/v1/assets/red", 200)
    assert second.get("/v1/assets/red").json() == first.get("/v1/assets/red").json()


def test_an_unavailable_object_store_is_reported_and_recovers(start, monkeypatch, tmp_path):
    first = start("w0")
    wait_shared(first, "scene", "tiny")
    second = start("w1")
    hidden = tmp_path / "hidden"
    (tmp_path / "objects").rename(hidden)
    answer = second.post("/v1/sessions?scene=tiny", json={})
    assert (answer.status_code, answer.json()["code"]) == (503, "STORAGE_UNAVAILABLE")
    assert answer.headers["Retry-After"]
    hidden.rename(tmp_path / "objects")
    assert second.post("/v1/sessions?scene=tiny", json={}).status_code == 201


def test_steps_do_not_wait_for_the_object_store(start, monkeypatch):
    waiting, released, put = threading.Event(), threading.Event(), FolderObjects.put

    def stuck(self, file, digest) -> None:
        waiting.set()
        assert released.wait(LIMIT_S)
        put(self, file, digest)

    client = start("w0")
    site = Site(client)
    wait_shared(client, "scene", "tiny")
    monkeypatch.setattr(FolderObjects, "put", stuck)
    assert client.post("/v1/assets", json=CUT).status_code == 201
    assert waiting.wait(LIMIT_S)
    assert [site.step().status_code for _ in range(5)] == [200] * 5
    assert site.edit().status_code == 200
    assert ("asset", "red") not in shared(client)
    released.set()
    wait_shared(client, "asset", "red")
