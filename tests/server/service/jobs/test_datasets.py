"""Data set exports through the service. All tests share one worker."""

from __future__ import annotations

import base64
import io
import json
import tarfile
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from real2sim_proto import ErrorCode
from real2sim_server.scene.io import save_scene
from real2sim_server.service.app import create_app
from real2sim_server.service.exports import pack
from real2sim_server.settings import Settings

from ..waiting import finished
from ..waiting import succeeded as job_succeeded

ASKED = {
    "kind": "dataset",
    "scene": "tiny",
    "formats": ["coco"],
    "cameras": ["front"],
    "width": 48,
    "period_us": 100_000,
    "end_us": 200_000,
    "flow": False,
}


@pytest.fixture(scope="module")
def client(tiny_scene, tmp_path_factory):
    scenes = tmp_path_factory.mktemp("scenes")
    save_scene(tiny_scene, scenes / "tiny.r2s")
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("data"),
        scenes_dir=scenes,
        port=0,
        backend="cpu",
        log_level="error",
        drain_seconds=0,
        jobs_quota_bytes=50_000_000,
    )
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
        yield client


def succeeded(client, **change) -> dict:
    return job_succeeded(client, client.post("/v1/exports", json=ASKED | change))


def file_of(client, job: dict, name: str) -> bytes:
    answer = client.get(f"/v1/jobs/{job['job_id']}/files/{name}")
    assert answer.status_code == 200, answer.text
    return answer.content


def members(archive: bytes) -> dict[str, bytes]:
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        return {m.name: tar.extractfile(m).read() for m in tar.getmembers()}


@pytest.fixture(scope="module")
def job(client) -> dict:
    return succeeded(client)


def test_a_data_set_is_one_archive_with_manifest_and_licence(client, job):
    assert job["result"]["frames"] == 3
    held = members(file_of(client, job, "dataset.tar"))
    assert {"manifest.json", "LICENSE.txt", "coco/annotations/instances_train.json"} <= set(held)
    assert file_of(client, job, "manifest.json") == held["manifest.json"]
    names = {name for name in held if name != "manifest.json"}
    assert set(json.loads(held["manifest.json"])["files"]) == names


def test_a_file_with_several_names_is_in_the_archive_once(tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "a.bin").write_bytes(bytes(100_000))
    (folder / "b.bin").hardlink_to(folder / "a.bin")
    (folder / "c.bin").write_bytes(b"other")
    pack(folder, tmp_path / "set.tar", SimpleNamespace(check=lambda: None))
    archive = (tmp_path / "set.tar").read_bytes()
    assert len(archive) < 150_000
    assert members(archive) == {"a.bin": bytes(100_000), "b.bin": bytes(100_000), "c.bin": b"other"}


def test_a_data_set_has_preview_sheets(client, job):
    sheet = file_of(client, job, "preview_0.jpg")
    picture = cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 2 * 48
    assert job["result"]["statistics"]["boxes"]["car"] == 6


def test_the_same_request_gives_the_same_bytes(client, job):
    again = succeeded(client)
    assert file_of(client, again, "dataset.tar") == file_of(client, job, "dataset.tar")


def test_a_dry_run_reports_statistics_without_files(client):
    job = succeeded(client, dry_run=True)
    assert (job["result"]["frames"], job["result"]["images"]) == (3, 3)
    assert job["result"]["bytes"] > 0
    assert job["files"] == []


def test_a_scenario_is_exported_as_edited(client):
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    edits = [{"op": "delete", "object_id": "car_blue"}]
    client.post(f"/v1/scenarios/{scenario}/operations", json={"operations": edits})
    asked = {k: v for k, v in ASKED.items() if k != "scene"} | {"scenario": scenario}
    job = finished(client, client.post("/v1/exports", json=asked))
    assert job["result"]["statistics"]["boxes"]["car"] == 3
    made_of = json.loads(file_of(client, job, "manifest.json"))["made_of"]
    assert made_of == {"operations": edits}


@pytest.fixture(scope="module")
def session(client) -> dict:
    made = client.post("/v1/sessions?scene=tiny", json={"reset": {}}).json()
    bearer = {"Authorization": f"Bearer {made['token']}"}
    client.post(f"/v1/sessions/{made['session_id']}/step", json={"n": 2}, headers=bearer)
    return {"id": made["session_id"], "bearer": bearer}


def test_a_session_and_its_recording_export_the_same_bytes(client, session):
    asked = {k: v for k, v in ASKED.items() if k not in {"scene", "end_us"}}
    live = asked | {"session": session["id"]}
    running = finished(client, client.post("/v1/exports", json=live, headers=session["bearer"]))
    url = f"/v1/sessions/{session['id']}/recording"
    recording = base64.b64encode(client.get(url, headers=session["bearer"]).content).decode()
    recorded = asked | {"scene": "tiny", "recording": recording}
    stored = finished(client, client.post("/v1/exports", json=recorded))
    assert running["result"]["frames"] == 3, running
    assert "recording" not in stored["request"]
    assert file_of(client, running, "dataset.tar") == file_of(client, stored, "dataset.tar")


def test_a_sweep_exports_one_clip_per_value(client):
    sweep = {
        "parameters": {"gap": {"values": [1.0, 3.0]}},
        "operations": [{"op": "translate", "object_id": "car_blue", "x": "$gap"}],
    }
    job = succeeded(client, sweep=sweep, end_us=0)
    clips = json.loads(file_of(client, job, "manifest.json"))["clips"]
    assert [clip["values"] for clip in clips.values()] == [{"gap": 1.0}, {"gap": 3.0}]


def test_exporting_a_session_requires_its_token(client, session):
    asked = {k: v for k, v in ASKED.items() if k != "scene"} | {"session": session["id"]}
    answer = client.post("/v1/exports", json=asked)
    assert (answer.status_code, answer.json()["code"]) == (401, ErrorCode.UNAUTHORIZED)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"formats": ["kitty"]}, "allowed are labels, kitti"),
        ({"cameras": ["rear"]}, "the scene has front, left"),
        ({"end_us": 99_000_000}, "there is 0 to 2000000"),
        ({"splits": {"train": 0}}, "a share above 0"),
        ({"width": 8000, "cameras": []}, "this worker draws at most"),
        ({"recording": base64.b64encode(b"nothing").decode()}, "recording"),
        ({"session": "w0.0123456789abcdef"}, "exactly one of scenario, scene and session"),
        ({"kind": "film"}, "kind is video (default) or dataset"),
    ],
)
def test_an_invalid_data_set_request_is_refused_immediately(client, change, message):
    answer = client.post("/v1/exports", json=ASKED | change)
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST
    assert message in answer.text


def test_invalid_fields_are_reported_by_name(client):
    answer = client.post("/v1/exports", json=ASKED | {"period_us": 0}).json()
    assert [error["pointer"] for error in answer["errors"]] == ["/period_us"]


def test_a_running_data_set_can_be_cancelled(client):
    long = {"period_us": 5_000, "end_us": 2_000_000, "width": 400}
    answer = client.post("/v1/exports", json=ASKED | long)
    client.delete(f"/v1/jobs/{answer.json()['job_id']}")
    assert finished(client, answer)["state"] == "cancelled"


def test_a_data_set_over_the_disk_quota_is_refused_before_rendering(client):
    large = {"period_us": 1_000, "end_us": 2_000_000, "width": 480, "formats": ["labels", "kitti"]}
    job = finished(client, client.post("/v1/exports", json=ASKED | large))
    assert job["error"]["code"] == ErrorCode.QUOTA_EXCEEDED
    assert job["progress"] == 0
