"""Uncertainty images over REST, for scenes with and without uncertainties."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto import ErrorCode, decode
from real2sim_server.scene import UNSEEN
from real2sim_server.scene.io import save_scene

CAMERA = {
    "name": "eye",
    "width": 64,
    "height": 48,
    "K": [[40.0, 0, 32], [0, 40, 24], [0, 0, 1]],
    "pose": {"position": [1.0, 0, 1.5], "quaternion": [0.5, -0.5, 0.5, -0.5]},
    "modalities": ["rgb", "uncertainty"],
}
MSGPACK = {"Accept": "application/msgpack"}


@pytest.fixture
def known(scenes_dir, tiny_scene, start_worker):
    """A worker with a scene ``tiny`` without uncertainties and a scene ``known`` with them."""
    background = replace(
        tiny_scene.background, uncertainties=torch.full((len(tiny_scene.background),), 0.02)
    )
    save_scene(replace(tiny_scene, name="known", background=background), scenes_dir / "known.r2s")
    return start_worker()


def rendered(client, scene):
    return client.post(f"/v1/scenes/{scene}/render", json={"cameras": [CAMERA]}, headers=MSGPACK)


def test_uncertainty_images_are_rendered_only_for_scenes_that_have_them(known):
    answer = rendered(known, "known")
    assert answer.status_code == 200, answer.text
    frame = decode(answer.content)["frames"][1]
    image = np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])
    assert (frame["modality"], image.shape, image.dtype) == ("uncertainty", (48, 64), np.float32)
    assert float(image[-1].mean()) < 0.2 < float(image[0].mean()) <= UNSEEN + 1e-6
    refused = rendered(known, "tiny")
    assert (refused.status_code, refused.json()["code"]) == (422, ErrorCode.INVALID_REQUEST)
    assert "fit-uncertainty" in refused.json()["detail"]
    said = {name: known.get(f"/v1/scenes/{name}").json() for name in ("known", "tiny")}
    assert [said[name]["has_uncertainties"] for name in said] == [True, False]


def test_a_session_with_uncertainty_images_is_refused_for_a_scene_without_them(known):
    sensors = [{"camera": "front", "modalities": ["uncertainty"], "codec": "png", "width": 48}]

    def begin(scene):
        return known.post(
            "/v1/sessions", params={"scene": scene}, json={"reset": {"sensors": sensors}}
        )

    refused = begin("tiny")
    assert (refused.status_code, refused.json()["code"]) == (422, ErrorCode.INVALID_REQUEST)
    assert "has no images 'uncertainty'" in refused.json()["detail"]
    begun = begin("known")
    assert begun.status_code == 201, begun.text
    info = begun.json()
    view = known.post(
        f"/v1/sessions/{info['session_id']}/render",
        json={"sensors": sensors},
        headers=MSGPACK | {"Authorization": f"Bearer {info['token']}"},
    )
    assert view.status_code == 200, view.text
    [frame] = decode(view.content)["frames"]
    assert (frame["modality"], frame["dtype"], frame["codec"]) == ("uncertainty", "uint16", "png")


def test_the_studio_view_shows_uncertainty_in_colour(known):
    made = known.post("/v1/scenarios", json={"scene": "known"}).json()
    path = f"/v1/scenarios/{made['scenario_id']}/view"
    pictures = []
    with known.websocket_connect(path, headers={"Host": "127.0.0.1"}) as socket:
        socket.send_json({"type": "hello", "token": ""})
        assert socket.receive_json() == {"type": "welcome"}
        for shows in ("rgb", "uncertainty"):
            socket.send_json({"camera": "front", "t_us": 0, "width": 64, "shows": shows})
            message = socket.receive_bytes()
            (size,) = struct.unpack("<I", message[:4])
            assert json.loads(message[4 : 4 + size])["width"] == 64
            pictures.append(message[4 + size :])
    assert all(picture[:2] == b"\xff\xd8" for picture in pictures)
    assert pictures[0] != pictures[1]
