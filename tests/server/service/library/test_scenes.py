from __future__ import annotations

import io
import json
import shutil

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from real2sim_proto import ErrorCode, decode
from real2sim_proto.scenes import SceneInfo, SceneList, SceneState
from real2sim_server.scene.io import read_scene_summary

RENDER = "/v1/scenes/tiny/render"


def test_all_scenes_are_listed_with_cameras_and_objects_but_no_tracks(client):
    (scene,) = SceneList.model_validate(client.get("/v1/scenes").json()).scenes
    assert scene.scene == "tiny"
    assert scene.state is SceneState.AVAILABLE
    assert [c.name for c in scene.cameras] == ["front", "left"]
    assert [o.object_id for o in scene.objects] == ["car_red", "car_blue", "post"]
    assert scene.ego is None
    assert all(o.trajectory is None for o in scene.objects)


def test_a_single_scene_includes_tracks_extent_and_ego(client, scenes_dir):
    scene = SceneInfo.model_validate(client.get("/v1/scenes/tiny").json())
    summary = read_scene_summary(scenes_dir / "tiny.r2s")
    blue = scene.objects[1]
    assert blue.trajectory.positions[0] == (8.0, 0.0, 0.75)
    assert len(blue.trajectory.times_us) == 21
    assert scene.ego.positions[-1] == (10.0, 0.0, 0.0)
    assert scene.extent_min == pytest.approx(summary.bounds[0])
    assert scene.content_hash == summary.content_hash
    assert scene.gaussians == 440


def test_a_scene_can_be_loaded_and_unloaded(client):
    assert client.put("/v1/scenes/tiny/residency").json()["state"] == "resident"
    assert client.get("/v1/scenes").json()["scenes"][0]["state"] == "resident"
    assert client.delete("/v1/scenes/tiny/residency").json()["state"] == "available"
    assert client.delete("/v1/scenes/tiny/residency").status_code == 200


def test_a_scene_over_the_budget_is_refused_with_its_size(start_worker):
    client = start_worker(scene_memory_bytes=1000)
    problem = client.put("/v1/scenes/tiny/residency").json()
    assert problem["code"] == ErrorCode.OUT_OF_MEMORY
    assert problem["needed_bytes"] > problem["free_bytes"] == 1000


def test_a_scene_in_use_is_not_unloaded(client):
    scene_cache = client.app.state.worker.scene_cache
    client.portal.call(scene_cache.pin, "tiny")
    assert client.delete("/v1/scenes/tiny/residency").json()["code"] == ErrorCode.SCENE_IN_USE
    scene_cache.unpin("tiny")


def test_unknown_scenes_are_refused(client):
    for response in (
        client.get("/v1/scenes/zzz"),
        client.put("/v1/scenes/zzz/residency"),
        client.delete("/v1/scenes/zzz/residency"),
        client.get("/v1/scenes/zzz/render?camera=front"),
    ):
        assert response.status_code == 404
        assert response.json()["code"] == ErrorCode.UNKNOWN_SCENE


@pytest.mark.parametrize("name", ["..", "%2e%2e", "a%2Fb", "-x", "a" * 81])
def test_an_invalid_name_is_refused(client, name):
    assert client.get(f"/v1/scenes/{name}").status_code in (404, 422)


def test_broken_bundles_are_listed_with_a_reason_and_do_not_affect_others(client, scenes_dir):
    newer, truncated = scenes_dir / "newer.r2s", scenes_dir / "truncated.r2s"
    for bundle in (newer, truncated):
        shutil.copytree(scenes_dir / "tiny.r2s", bundle)
    document = json.loads((newer / "scene.json").read_text())
    (newer / "scene.json").write_text(json.dumps(document | {"version": 99}))
    objects = truncated / "objects.safetensors"
    objects.write_bytes(objects.read_bytes()[:-1])

    scenes = {s["scene"]: s for s in client.get("/v1/scenes").json()["scenes"]}
    assert scenes["newer"]["state"] == scenes["truncated"]["state"] == "broken"
    assert "version 99" in scenes["newer"]["reason"]
    assert "cut short" in scenes["truncated"]["reason"]
    for name in ("newer", "truncated"):
        refused = client.get(f"/v1/scenes/{name}/render?camera=front")
        assert refused.json()["code"] == ErrorCode.SCENE_BROKEN
        assert client.get(f"/v1/scenes/{name}").json()["state"] == "broken"
    assert client.get(f"{RENDER}?camera=front").status_code == 200
    assert client.get("/livez").status_code == 200


def test_a_frame_is_a_jpeg_of_the_recorded_size(client):
    response = client.get(f"{RENDER}?camera=front")
    assert response.headers["Content-Type"] == "image/jpeg"
    assert simplejpeg.decode_jpeg(response.content).shape == (64, 96, 3)
    assert {"queue", "render", "encode"} <= {
        part.split(";")[0].strip() for part in response.headers["Server-Timing"].split(",")
    }


def test_the_first_camera_is_the_default(client, tiny_scene):
    camera = tiny_scene.rig.names[0]
    frame = client.get(f"/v1/scenes/tiny/render?camera={camera}")
    assert client.get("/v1/scenes/tiny/render").content == frame.content


def test_png_and_msgpack_contain_the_same_pixels(client):
    as_png = client.get(f"{RENDER}?camera=front", headers={"Accept": "image/png"})
    as_msgpack = client.get(f"{RENDER}?camera=front", headers={"Accept": "application/msgpack"})
    frame = decode(as_msgpack.content)
    raw = np.frombuffer(frame["data"], np.uint8).reshape(frame["shape"])
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(as_png.content))), raw)


def test_a_frame_shows_the_recorded_objects_from_the_recorded_pose(client, tiny_scene):
    camera = tiny_scene.rig["front"]
    for t_us in (0, 1_050_000):
        url = f"{RENDER}?camera=front&modality=instance&t_us={t_us}"
        frame = decode(client.get(url, headers={"Accept": "application/msgpack"}).content)
        vehicle = tiny_scene.ego.transform(t_us)
        assert frame["t_us"] == t_us
        assert frame["T_world_sensor"] == pytest.approx(vehicle @ camera.T_vehicle_camera)
        instance = np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])
        centre = camera.viewmat(vehicle) @ tiny_scene.objects["car_blue"].trajectory.transform(t_us)
        x, y, z = centre[:3, 3]
        u, v, _ = camera.K @ (x / z, y / z, 1)
        assert instance[int(v), int(u)] == tiny_scene.instance_id("car_blue")


def test_depth_is_metres_along_the_camera_axis(client):
    url = f"{RENDER}?camera=front&modality=depth"
    frame = decode(client.get(url, headers={"Accept": "application/msgpack"}).content)
    depth = np.frombuffer(frame["data"], np.float32).reshape(frame["shape"])
    # The blue car's rear is 8 - 2.1 m ahead of the axle, the camera 1 m.
    assert 4.5 < depth[36, 48] < 8.5


def test_the_height_follows_the_requested_width(client):
    response = client.get(f"{RENDER}?camera=front&width=48")
    assert simplejpeg.decode_jpeg(response.content).shape == (32, 48, 3)


def test_the_same_request_gives_the_same_bytes(client):
    first, second = (client.get(f"{RENDER}?camera=left").content for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    ("query", "code"),
    [
        ("camera=rear", ErrorCode.UNKNOWN_CAMERA),
        ("camera=front&t_us=2000001", ErrorCode.TIME_OUT_OF_RANGE),
        ("camera=front&t_us=-1", ErrorCode.TIME_OUT_OF_RANGE),
        ("camera=front&modality=smell", ErrorCode.INVALID_REQUEST),
        ("camera=front&width=9000", ErrorCode.INVALID_REQUEST),
    ],
)
def test_an_invalid_frame_request_is_refused(client, query, code):
    assert client.get(f"{RENDER}?{query}").json()["code"] == code


def test_a_frame_over_the_pixel_limit_is_refused(start_worker):
    problem = start_worker(max_pixels_per_step=1000).get(f"{RENDER}?camera=front").json()
    assert problem["code"] == ErrorCode.INVALID_REQUEST
    assert "6144 pixels" in problem["detail"]


@pytest.mark.parametrize(
    ("accept", "modality", "expected"),
    [
        ("*/*", "rgb", "image/jpeg"),
        ("*/*", "depth", "image/png"),
        ("image/*", "instance", "image/png"),
        ("image/jpeg;q=0.1, image/png", "rgb", "image/png"),
        ("image/*;q=0.2, application/msgpack", "rgb", "application/msgpack"),
        ("*/*, image/jpeg;q=0", "rgb", "image/png"),
        ("text/html, */*;q=0.8", "rgb", "image/jpeg"),
    ],
)
def test_the_accept_header_selects_the_format(client, accept, modality, expected):
    url = f"{RENDER}?camera=front&modality={modality}"
    assert client.get(url, headers={"Accept": accept}).headers["Content-Type"] == expected


@pytest.mark.parametrize(
    ("accept", "modality"),
    [("image/webp", "rgb"), ("image/jpeg", "depth"), ("*/*;q=0", "rgb"), ("image/png;q=x", "rgb")],
)
def test_an_unsupported_format_is_refused_with_the_supported_ones(client, accept, modality):
    url = f"{RENDER}?camera=front&modality={modality}"
    problem = client.get(url, headers={"Accept": accept}).json()
    assert problem["code"] == ErrorCode.NOT_ACCEPTABLE
    assert "image/png" in problem["detail"]
