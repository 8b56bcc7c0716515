"""Images of a scene from arbitrary cameras, with objects posed by the request."""

from __future__ import annotations

import numpy as np
import pytest
import simplejpeg

from real2sim_proto import ErrorCode, decode
from real2sim_server.geometry import matrix_to_quaternion

VIEW = "/v1/scenes/tiny/render"
MSGPACK = {"Accept": "application/msgpack"}
UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def camera(scene, name="front", *, t_us=0, **fields):
    """A camera of the rig at the recorded vehicle pose."""
    of_rig = scene.rig[name]
    pose = of_rig.pose(scene.ego.transform(t_us))
    quaternion = matrix_to_quaternion(pose[:3, :3]).tolist()
    return {
        "name": name,
        "width": of_rig.width,
        "height": of_rig.height,
        "K": of_rig.K.tolist(),
        "pose": {"position": pose[:3, 3].tolist(), "quaternion": quaternion},
    } | fields


def image(frame):
    return np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])


def ids(client, scene, **body):
    """Instance ids visible to the front camera, and its instance image."""
    body = {"cameras": [camera(scene, modalities=["instance"])]} | body
    (frame,) = decode(client.post(VIEW, json=body, headers=MSGPACK).content)["frames"]
    seen = image(frame)
    return {int(i) for i in np.unique(seen)} - {0}, seen


def test_a_view_from_the_recorded_pose_equals_the_recorded_frame(client, tiny_scene):
    body = {"t_us": 1_000_000, "cameras": [camera(tiny_scene, t_us=1_000_000)]}
    view = decode(client.post(VIEW, json=body, headers=MSGPACK).content)
    there = client.get(f"{VIEW}?camera=front&t_us=1000000", headers=MSGPACK)
    assert view["t_us"] == 1_000_000
    assert np.array_equal(image(view["frames"][0]), image(decode(there.content)))


def test_an_object_is_rendered_at_its_requested_pose(client, tiny_scene):
    pose = {"position": [12.0, 1.5, 0.75], "quaternion": UPRIGHT}
    posed = [{"object_id": "car_red", "pose": pose}]
    _, seen = ids(client, tiny_scene, objects=posed, others="none")
    front = tiny_scene.rig["front"]
    x, y, z = (front.viewmat(tiny_scene.ego.transform(0)) @ [12.0, 1.5, 0.75, 1.0])[:3]
    u, v, _ = front.K @ (x / z, y / z, 1.0)
    assert seen[int(v), int(u)] == tiny_scene.instance_id("car_red")


@pytest.mark.parametrize(
    ("others", "shown"),
    [
        ("recorded", {"car_red", "car_blue", "post"}),
        ("parked", {"car_red", "post"}),
        ("none", set()),
    ],
)
def test_the_others_option_decides_whether_unposed_objects_are_rendered(
    client, tiny_scene, others, shown
):
    seen, _ = ids(client, tiny_scene, others=others)
    assert seen == {tiny_scene.instance_id(object_id) for object_id in shown}


def test_a_view_does_not_change_the_scene(client, tiny_scene):
    before, _ = ids(client, tiny_scene)
    pose = {"position": [12.0, 1.5, 0.75], "quaternion": UPRIGHT}
    ids(client, tiny_scene, objects=[{"object_id": "car_red", "pose": pose}], others="none")
    assert ids(client, tiny_scene)[0] == before


def test_one_response_holds_several_cameras_with_their_own_codecs(client, tiny_scene):
    body = {
        "cameras": [
            camera(tiny_scene, codec="jpeg"),
            camera(tiny_scene, "left", width=120, height=40, modalities=["rgb", "depth"]),
        ]
    }
    frames = decode(client.post(VIEW, json=body, headers=MSGPACK).content)["frames"]
    assert [(f["sensor"], f["modality"], f["codec"]) for f in frames] == [
        ("front", "rgb", "jpeg"),
        ("left", "rgb", "raw"),
        ("left", "depth", "raw"),
    ]
    assert simplejpeg.decode_jpeg(frames[0]["data"]).shape == (64, 96, 3)
    assert frames[1]["shape"] == [40, 120, 3]


def test_a_single_image_is_returned_as_a_jpeg_file_by_default(client, tiny_scene):
    response = client.post(VIEW, json={"cameras": [camera(tiny_scene)]})
    assert response.headers["Content-Type"] == "image/jpeg"


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"objects": [{"object_id": "x", "pose": {"position": [0, 0, 0]}}]}, "UNKNOWN_OBJECT"),
        ({"others": "some"}, "INVALID_REQUEST"),
        ({"cameras": []}, "INVALID_REQUEST"),
    ],
)
def test_a_view_that_cannot_be_rendered_is_refused(client, tiny_scene, body, code):
    problem = client.post(VIEW, json={"cameras": [camera(tiny_scene)]} | body).json()
    assert problem["code"] == ErrorCode[code]


@pytest.mark.parametrize(
    "wrong",
    [
        {"K": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"K": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]},
        {"K": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]},
        {"K": [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"K": [[1e-300, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"width": 8},
        {"pose": {"position": [0, 0, 0], "quaternion": [1, 1, 0, 0]}},
    ],
)
def test_an_invalid_camera_is_refused(client, tiny_scene, wrong):
    response = client.post(VIEW, json={"cameras": [camera(tiny_scene, **wrong)]})
    assert response.status_code == 422


@pytest.mark.parametrize(
    "extreme",
    [
        {"cameras": {"K": [[1e6, 0, -1e6], [0, 0.1, 1e6], [0, 0, 1]]}},
        {"cameras": {"pose": {"position": [1e6, -1e6, 1e6], "quaternion": UPRIGHT}}},
        {"t_us": 2**62, "objects": {"position": [0, 0, 0], "quaternion": UPRIGHT}},
        {"t_us": -(2**62), "objects": {"position": [1e6, 1e6, -1e6], "quaternion": UPRIGHT}},
    ],
)
def test_extreme_valid_values_are_rendered(client, tiny_scene, extreme):
    wanted = camera(tiny_scene, **extreme.pop("cameras", {}))
    pose = extreme.pop("objects", None)
    objects = [{"object_id": "car_blue", "pose": pose}] if pose else []
    body = {"cameras": [wanted], "objects": objects} | extreme
    response = client.post(VIEW, json=body)
    assert response.status_code == 200, response.text


def test_duplicate_camera_names_are_refused(client, tiny_scene):
    twice = client.post(VIEW, json={"cameras": [camera(tiny_scene)] * 2})
    assert "cameras name one twice" in twice.text


def test_too_many_pixels_are_refused(start_worker, tiny_scene):
    client = start_worker(max_pixels_per_step=1000)
    problem = client.post(VIEW, json={"cameras": [camera(tiny_scene)]}).json()
    assert "this worker allows 1000" in problem["detail"]
