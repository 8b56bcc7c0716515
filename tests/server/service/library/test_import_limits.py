"""Limits of imports: decoded size, memory, time, disk quota and queue length."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_server.scene import BundleError, BundleTooLargeError
from real2sim_server.scene.io import StagingLimits, import_splats, stage_scene, write_splats
from real2sim_server.scene.io.spz import Header, Streams, write_streams
from real2sim_server.service.library import imports
from real2sim_server.service.library.imports import MAX_IMPORTS
from tests.waiting import LIMIT_S

MIB = 1024**2


def many_splats(path: Path, count: int) -> Path:
    """An spz file of ``count`` equal splats of degree 3, a few bytes per thousand splats."""
    header = Header(3, count, 3, 12, 0)
    arrays = {name: np.zeros(n, np.uint8) for name, n in header.stream_sizes.items()}
    path.write_bytes(write_streams(header, Streams(**arrays)))
    return path


@pytest.fixture
def thing(tmp_path, tiny_scene) -> Path:
    write_splats(tiny_scene.objects["car_red"].cloud, tmp_path / "thing.ply")
    return tmp_path / "thing.ply"


def upload(client, where: str, file: Path, **fields):
    with file.open("rb") as stream:
        return client.post(f"/v1/{where}", files={"file": (file.name, stream)}, data=fields)


@pytest.mark.parametrize(("where", "named"), [("scenes", "scene"), ("assets", "asset_id")])
def test_a_small_file_that_decodes_to_a_large_scene_is_refused(
    start_worker, tmp_path, where, named
):
    client = start_worker(max_scene_bytes=MIB, max_asset_bytes=MIB)
    file = many_splats(tmp_path / "bomb.spz", 20_000)
    assert file.stat().st_size < 10_000
    problem = upload(client, where, file, **{named: "bomb"}).json()
    assert (problem["status"], problem["code"]) == (413, ErrorCode.PAYLOAD_TOO_LARGE)
    assert "4720000 bytes of memory; allowed are 1048576" in problem["detail"]
    assert not list(client.app.state.worker.assets.folder.glob("*"))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".splat"])
def test_the_size_limit_applies_to_every_format(tmp_path, tiny_scene, suffix):
    file = tmp_path / f"a{suffix}"
    write_splats(tiny_scene.objects["car_red"].cloud, file)
    whole = import_splats(file, name="a").background.nbytes
    import_splats(file, name="a", max_bytes=whole)
    with pytest.raises(BundleTooLargeError, match=rf"allowed are {whole - 1}"):
        import_splats(file, name="a", max_bytes=whole - 1)


def test_peak_memory_of_an_import_is_a_small_multiple_of_the_scene_size(tmp_path):
    tight = StagingLimits(max_bytes=100 * MIB, memory_bytes=400 * MIB, seconds=600)
    file = many_splats(tmp_path / "many.spz", 400_000)
    # All splats are at the origin. The import passes every stage within the memory limit.
    stage_scene(file, tmp_path / "many.r2s", name="many", limits=tight)


def test_an_import_over_the_memory_limit_is_refused(tmp_path):
    file = many_splats(tmp_path / "many.spz", 400_000)
    tight = StagingLimits(max_bytes=100 * MIB, memory_bytes=60 * MIB, seconds=600)
    with pytest.raises(BundleTooLargeError, match=r"needs more than 60 MiB of memory"):
        stage_scene(file, tmp_path / "many.r2s", name="many", limits=tight)


def test_an_import_over_the_time_limit_is_refused(tmp_path, thing):
    hasty = StagingLimits(max_bytes=100 * MIB, memory_bytes=1024 * MIB, seconds=0.001)
    with pytest.raises(BundleError, match="time limit"):
        stage_scene(thing, tmp_path / "a.r2s", name="a", limits=hasty)


def test_scenes_load_while_an_import_is_running(client, thing, monkeypatch):
    reading, done = threading.Event(), threading.Event()
    staged = imports.stage_scene

    def slow(*arguments, **options):
        reading.set()
        done.wait(LIMIT_S)
        staged(*arguments, **options)

    monkeypatch.setattr(imports, "stage_scene", slow)
    answers = []
    importer = threading.Thread(
        target=lambda: answers.append(upload(client, "scenes", thing, scene="new"))
    )
    importer.start()
    try:
        assert reading.wait(LIMIT_S)
        loaded = client.put("/v1/scenes/tiny/residency", headers={"Prefer": "wait=20"})
        assert loaded.status_code == 200
    finally:
        done.set()
        importer.join()
    assert answers[0].status_code == 201


def test_an_upload_over_the_import_queue_limit_is_refused(client, thing):
    worker = client.app.state.worker
    places = [worker.imports.place() for _ in range(MAX_IMPORTS)]
    for place in places:
        place.__enter__()
    assert upload(client, "scenes", thing).json()["code"] == ErrorCode.QUEUE_FULL
    for place in places:
        place.__exit__(None, None, None)
    assert upload(client, "scenes", thing).status_code == 201


@pytest.mark.parametrize(
    "limit", [{"assets_quota": 1}, {"assets_quota_bytes": 6000}], ids=["number", "bytes"]
)
def test_the_library_has_a_quota(start_worker, thing, limit):
    client = start_worker(**limit)
    assert upload(client, "assets", thing, asset_id="a", category="car").status_code == 201
    problem = upload(client, "assets", thing, asset_id="b", category="car").json()
    assert (problem["status"], problem["code"]) == (507, ErrorCode.QUOTA_EXCEEDED)
    assert "ASSETS_QUOTA" in problem["hint"]
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "b"}
    assert client.post("/v1/assets", json=cut).json()["code"] == ErrorCode.QUOTA_EXCEEDED
    assert client.delete("/v1/assets/a").status_code == 204
    assert upload(client, "assets", thing, asset_id="b", category="car").status_code == 201


@pytest.mark.parametrize(
    "limit", [{"scenes_quota": 1}, {"scenes_quota_bytes": 1000}], ids=["number", "bytes"]
)
def test_the_scene_folder_has_a_quota(start_worker, thing, limit, scenes_dir):
    problem = upload(start_worker(**limit), "scenes", thing, scene="b").json()
    assert (problem["status"], problem["code"]) == (507, ErrorCode.QUOTA_EXCEEDED)
    assert "SCENES_QUOTA" in problem["hint"]
    assert [p.name for p in scenes_dir.iterdir()] == ["tiny.r2s"]


@pytest.mark.parametrize("limit", [{"jobs_quota": 0}, {"jobs_quota_bytes": 0}])
def test_jobs_have_a_quota(start_worker, limit):
    body = {"scene": "tiny", "camera": "front", "width": 64}
    problem = start_worker(**limit).post("/v1/exports", json=body).json()
    assert (problem["status"], problem["code"]) == (507, ErrorCode.QUOTA_EXCEEDED)


def test_loading_a_scene_does_not_count_against_the_jobs_quota(start_worker):
    client = start_worker(jobs_quota=0)
    assert client.put("/v1/scenes/tiny/residency").status_code in (200, 202)
