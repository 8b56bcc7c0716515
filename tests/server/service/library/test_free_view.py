"""Pictures of a scene from cameras anywhere, with objects where the request has them."""

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
    """A camera of the rig, where the vehicle was."""
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
    """Instance ids that the front camera sees, and its image of them."""
    body = {"cameras": [camera(scene, modalities=["instance"])]} | body
    (frame,) = decode(client.post(VIEW, json=body, headers=MSGPACK).content)["frames"]
    seen = image(frame)
    return {int(i) for i in np.unique(seen)} - {0}, seen


def test_from_the_recorded_place_it_is_the_recorded_picture(client, tiny_scene):
    body = {"t_us": 1_000_000, "cameras": [camera(tiny_scene, t_us=1_000_000)]}
    view = decode(client.post(VIEW, json=body, headers=MSGPACK).content)
    there = client.get(f"{VIEW}?camera=front&t_us=1000000", headers=MSGPACK)
    assert view["t_us"] == 1_000_000
    assert np.array_equal(image(view["frames"][0]), image(decode(there.content)))


def test_an_object_is_drawn_where_the_request_has_it(client, tiny_scene):
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
def test_what_becomes_of_objects_that_are_not_posed_is_said(client, tiny_scene, others, shown):
    seen, _ = ids(client, tiny_scene, others=others)
    assert seen == {tiny_scene.instance_id(object_id) for object_id in shown}


def test_a_view_leaves_no_trace(client, tiny_scene):
    before, _ = ids(client, tiny_scene)
    pose = {"position": [12.0, 1.5, 0.75], "quaternion": UPRIGHT}
    ids(client, tiny_scene, objects=[{"object_id": "car_red", "pose": pose}], others="none")
    assert ids(client, tiny_scene)[0] == before


def test_several_cameras_come_in_one_answer_each_in_its_codec(client, tiny_scene):
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


def test_one_image_is_a_file_unless_asked_otherwise(client, tiny_scene):
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
def test_what_cannot_be_drawn_is_refused(client, tiny_scene, body, code):
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
def test_what_is_no_camera_is_refused(client, tiny_scene, wrong):
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
def test_what_is_allowed_at_its_extremes_is_drawn(client, tiny_scene, extreme):
    wanted = camera(tiny_scene, **extreme.pop("cameras", {}))
    pose = extreme.pop("objects", None)
    objects = [{"object_id": "car_blue", "pose": pose}] if pose else []
    body = {"cameras": [wanted], "objects": objects} | extreme
    response = client.post(VIEW, json=body)
    assert response.status_code == 200, response.text


def test_a_name_given_twice_is_refused(client, tiny_scene):
    twice = client.post(VIEW, json={"cameras": [camera(tiny_scene)] * 2})
    assert "cameras name one twice" in twice.text


def test_too_many_pixels_are_refused(start_worker, tiny_scene):
    client = start_worker(max_pixels_per_step=1000)
    problem = client.post(VIEW, json={"cameras": [camera(tiny_scene)]}).json()
    assert "this worker allows 1000" in problem["detail"]
