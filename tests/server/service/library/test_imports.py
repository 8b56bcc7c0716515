from __future__ import annotations

import shutil

import pytest

from real2sim_proto import ErrorCode
from real2sim_server.scene.io import write_splats


@pytest.fixture
def import_root(tmp_path, tiny_scene, scenes_dir):
    root = tmp_path / "import"
    root.mkdir()
    shutil.copytree(scenes_dir / "tiny.r2s", root / "street.r2s")
    write_splats(tiny_scene.objects["car_red"].cloud, root / "car.ply")
    return root


def post(client, **body):
    return client.post("/v1/scenes", json=body)


def test_a_bundle_is_imported_under_its_own_name_and_can_be_rendered(client, import_root):
    response = post(client, path="street.r2s")
    assert response.status_code == 201
    assert response.headers["Location"] == "/v1/scenes/street"
    assert response.json()["content_hash"] == client.get("/v1/scenes/tiny").json()["content_hash"]
    assert client.get("/v1/scenes/street/render?camera=front").status_code == 200


def test_a_splat_file_is_imported_under_the_name_given(client, import_root):
    response = post(client, path="car.ply", scene="red")
    assert response.status_code == 201
    assert response.json()["gaussians"] == 60
    camera = response.json()["cameras"][0]["name"]
    assert client.get(f"/v1/scenes/red/render?camera={camera}&width=64").status_code == 200


def test_a_splat_file_can_be_uploaded(client, import_root):
    content = (import_root / "car.ply").read_bytes()
    files = {"file": ("my car (1).ply", content, "application/octet-stream")}
    response = client.post("/v1/scenes", files=files)
    assert response.status_code == 201
    assert response.json()["scene"] == "my_car_1"
    assert response.json()["gaussians"] == 60


def test_the_demo_street_is_imported_and_can_be_rendered(client):
    response = post(client, demo=True)
    assert response.status_code == 201
    assert response.headers["Location"] == "/v1/scenes/demo_street"
    camera = response.json()["cameras"][0]["name"]
    drawn = client.get(f"/v1/scenes/demo_street/render?camera={camera}&width=64")
    assert drawn.status_code == 200
    assert post(client, demo=True).json()["code"] == ErrorCode.ALREADY_EXISTS


@pytest.mark.parametrize("body", [{}, {"demo": True, "path": "street.r2s"}, {"demo": False}])
def test_an_import_without_exactly_one_source_is_refused(client, import_root, body):
    problem = post(client, **body).json()
    assert problem["code"] == ErrorCode.INVALID_REQUEST
    assert "either a path" in str(problem["errors"])


def test_the_demo_street_counts_against_the_scenes_quota(start_worker):
    client = start_worker(scenes_quota=1)
    assert post(client, demo=True).json()["code"] == ErrorCode.QUOTA_EXCEEDED


def test_a_worker_adds_the_demo_street_unless_a_scene_has_its_name(run_worker, scenes_dir):
    mine = scenes_dir / "demo_street.r2s" / "mine"
    for start in range(2):
        with run_worker(demo=True) as client:
            names = [scene["scene"] for scene in client.get("/v1/scenes").json()["scenes"]]
        assert names == ["demo_street", "tiny"]
        assert mine.exists() == (start == 1)
        mine.touch()


def test_a_worker_starts_even_if_it_cannot_add_the_demo_street(start_worker):
    client = start_worker(demo=True, scenes_quota=1)
    assert [scene["scene"] for scene in client.get("/v1/scenes").json()["scenes"]] == ["tiny"]


def test_a_worker_without_scenes_suggests_the_demo(start_worker, tmp_path):
    (tmp_path / "nothing").mkdir()
    problem = start_worker(scenes_dir=tmp_path / "nothing").get("/v1/scenes/street").json()
    assert "serve --demo" in problem["hint"]


def test_an_upload_leaves_no_temporary_files(client, import_root, scenes_dir):
    content = (import_root / "car.ply").read_bytes()
    client.post("/v1/scenes", files={"file": ("a.ply", content)}, data={"scene": "b"})
    client.post("/v1/scenes", files={"file": ("c.ply", content[:-10])})
    assert sorted(p.name for p in scenes_dir.iterdir()) == ["b.r2s", "tiny.r2s"]


def test_uploads_have_a_separate_size_limit(start_worker, import_root):
    content = (import_root / "car.ply").read_bytes()
    client = start_worker(max_request_bytes=1024, max_upload_bytes=len(content) + 1000)
    files = {"file": ("a.ply", content)}
    assert client.post("/v1/scenes", files=files).status_code == 201
    files = {"file": ("b.ply", content + bytes(2000))}
    assert client.post("/v1/scenes", files=files).json()["code"] == ErrorCode.PAYLOAD_TOO_LARGE
    assert post(client, path="a" * 2000).json()["code"] == ErrorCode.PAYLOAD_TOO_LARGE


@pytest.mark.parametrize(
    "path", ["../scenes/tiny.r2s", "/etc", "street.r2s/../..", ".", "a\u0000b"]
)
def test_a_path_outside_the_import_folder_is_refused(client, import_root, path):
    problem = post(client, path=path, scene="x").json()
    assert problem["code"] == ErrorCode.IMPORT_FAILED
    assert str(import_root) not in problem["detail"]


@pytest.mark.parametrize("link", ["outside.r2s", "street.r2s/extra"])
def test_a_link_that_leaves_the_import_folder_is_refused(client, import_root, scenes_dir, link):
    (import_root / link).symlink_to(scenes_dir / "tiny.r2s")
    problem = post(client, path=link.split("/")[0], scene="x").json()
    assert problem["code"] == ErrorCode.IMPORT_FAILED
    assert "leads out" in problem["detail"]


def test_a_missing_path_is_refused(client):
    assert post(client, path="nothing.ply").json()["code"] == ErrorCode.IMPORT_FAILED


def test_a_name_that_is_taken_is_refused(client, import_root):
    problem = post(client, path="street.r2s", scene="tiny")
    assert problem.json()["code"] == ErrorCode.ALREADY_EXISTS


@pytest.mark.parametrize("name", ["../up", "", "a b", ".hidden"])
def test_an_invalid_scene_name_is_refused(client, import_root, name):
    assert post(client, path="street.r2s", scene=name).json()["code"] == ErrorCode.INVALID_REQUEST


def test_a_file_that_is_not_a_splat_file_is_refused_without_revealing_its_path(client, import_root):
    (import_root / "note.ply").write_text("hello")
    problem = post(client, path="note.ply").json()
    assert problem["code"] == ErrorCode.IMPORT_FAILED
    assert str(import_root) not in problem["detail"]


def test_an_invalid_body_is_refused(client):
    problem = client.post("/v1/scenes", content=b"{", headers={"Content-Type": "application/json"})
    assert problem.json()["code"] == ErrorCode.INVALID_REQUEST
    form = client.post("/v1/scenes", files={"other": ("a", b"b")})
    assert form.json()["code"] == ErrorCode.INVALID_REQUEST
