from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect

from real2sim_server.service.routes.sockets import instance_at


@pytest.fixture
def scenario(client) -> dict:
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()
    return client.get(f"/v1/scenarios/{made['scenario_id']}").json()


def opened(client, scenario, **headers):
    return client.websocket_connect(
        f"/v1/scenarios/{scenario['scenario_id']}/view", headers={"Host": "127.0.0.1"} | headers
    )


def introduce(socket, token: str = "") -> None:
    socket.send_json({"type": "hello", "token": token})
    assert socket.receive_json() == {"type": "welcome"}


def frame(socket) -> tuple[dict, bytes]:
    message = socket.receive_bytes()
    (size,) = struct.unpack("<I", message[:4])
    return json.loads(message[4 : 4 + size]), message[4 + size :]


def test_a_view_request_returns_an_image_of_the_requested_width(client, scenario):
    with opened(client, scenario) as socket:
        introduce(socket)
        socket.send_json({"seq": 7, "camera": "front", "t_us": scenario["start_us"], "width": 64})
        header, data = frame(socket)
    assert (header["seq"], header["width"], header["revision"]) == (7, 64, 0)
    assert data[:2] == b"\xff\xd8"


def test_the_preview_of_an_edit_does_not_change_the_scenario(client, scenario):
    look = {"camera": "front", "t_us": scenario["start_us"], "width": 96}
    away = [{"op": "delete", "object_id": o["object_id"]} for o in scenario["objects"]]
    with opened(client, scenario) as socket:
        introduce(socket)
        renderer = []
        for operations in ([], away, []):
            socket.send_json(look | {"operations": operations})
            renderer.append(frame(socket)[1])
    assert renderer[0] != renderer[1]
    assert renderer[0] == renderer[2]
    after = client.get(f"/v1/scenarios/{scenario['scenario_id']}").json()
    assert after["revision"] == 0


def test_a_free_camera_uses_the_requested_pose(client, scenario):
    pose = np.array([[0, 0, 1, 3], [-1, 0, 0, 0.5], [0, -1, 0, 9], [0, 0, 0, 1.0]])
    with opened(client, scenario) as socket:
        introduce(socket)
        look = {"camera": "front", "t_us": scenario["start_us"], "width": 64}
        socket.send_json(look | {"T_world_camera": pose.ravel().tolist()})
        header, _ = frame(socket)
    np.testing.assert_allclose(np.reshape(header["T_world_camera"], (4, 4)), pose, atol=1e-9)


def test_an_invalid_view_request_is_refused_and_the_view_continues(client, scenario):
    look = {"camera": "front", "t_us": scenario["start_us"], "width": 64}
    with opened(client, scenario) as socket:
        introduce(socket)
        for wrong in ({"camera": "back"}, {"t_us": 10**12}, {"width": 1}):
            socket.send_json(look | wrong)
            assert socket.receive_json()["type"] == "error"
        socket.send_json(look | {"operations": [{"op": "delete", "object_id": "nobody"}]})
        assert "nobody" in socket.receive_json()["detail"]
        socket.send_json(look)
        assert frame(socket)[0]["width"] == 64


def test_an_edit_by_another_client_is_announced(client, scenario):
    with opened(client, scenario) as socket:
        introduce(socket)
        socket.send_json({"camera": "front", "t_us": scenario["start_us"], "width": 64})
        frame(socket)
        operation = {"op": "delete", "object_id": scenario["objects"][0]["object_id"]}
        url = f"/v1/scenarios/{scenario['scenario_id']}/operations"
        client.post(url, json={"operations": [operation]}).raise_for_status()
        assert socket.receive_json() == {"type": "changed", "revision": 1}


def test_a_wrong_token_closes_the_view(start_worker):
    client = start_worker(token="correct horse")
    with client.websocket_connect("/v1/scenarios/any/view") as socket:
        socket.send_json({"type": "hello", "token": "battery staple"})
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_json()
    assert closed.value.code == 4401


def test_cross_origin_view_sockets_are_refused(client, scenario):
    with (
        pytest.raises(WebSocketDisconnect) as refused,
        opened(client, scenario, Origin="http://elsewhere.example"),
    ):
        pass
    assert refused.value.code == 4403


def test_only_an_object_near_the_pointer_is_picked():
    ids = np.zeros((40, 40), np.uint16)
    ids[10:20, 10:20] = 300
    assert instance_at(ids, (0.4, 0.4)) == 300
    assert instance_at(ids, (22.5 / 40, 0.4)) == 300
    assert instance_at(ids, (30 / 40, 0.4)) == 0
