"""Clients that violate the protocol get an error and do not affect other sessions."""

from __future__ import annotations

import json
import math
import socket as sockets

import pytest
import websockets
from websockets.sync.client import connect

from real2sim_proto import DRIVE_SUBPROTOCOL, encode
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from tests.waiting import wait_until

pytestmark = pytest.mark.network

CAMERA = {"camera": "front"}


def refused_handshake(url: str, subprotocols: list[str] | None) -> tuple[int, dict]:
    with (
        pytest.raises(websockets.exceptions.InvalidStatus) as refused,
        connect(url, subprotocols=subprotocols, proxy=None),
    ):
        pass
    response = refused.value.response
    assert response.headers["Content-Type"] == "application/problem+json"
    return response.status_code, json.loads(response.body)


# --- handshake ----------------------------------------------------------------------------------


@pytest.mark.parametrize("offered", [["real2sim.v9.msgpack"], ["chat", "soap"], None])
def test_an_unsupported_subprotocol_is_refused_with_both_names(site, offered):
    status, problem = refused_handshake(site.create()["ws_url"], offered)
    assert (status, problem["code"]) == (426, "UNSUPPORTED_PROTOCOL")
    assert DRIVE_SUBPROTOCOL in problem["detail"]
    assert (offered or ["none"])[0] in problem["detail"]


def test_an_unknown_session_is_refused_at_the_handshake(site):
    url = site.create()["ws_url"].replace("w0.", "w0.dead")
    status, problem = refused_handshake(url, [DRIVE_SUBPROTOCOL])
    assert (status, problem["code"]) == (404, "UNKNOWN_SESSION")


def test_a_closed_session_is_refused_at_the_handshake(site):
    info = site.create()
    site.call("DELETE", info)
    status, problem = refused_handshake(info["ws_url"], [DRIVE_SUBPROTOCOL])
    assert (status, problem["code"]) == (410, "SESSION_CLOSED")


# --- hello --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"protocols": ["real2sim.v9.msgpack"]}, "UNSUPPORTED_PROTOCOL"),
        ({"v": 2}, "UNSUPPORTED_PROTOCOL"),
        ({"token": "guess"}, "UNAUTHORIZED"),
        ({"token": None}, "UNAUTHORIZED"),
        ({"role": "owner"}, "BAD_MESSAGE"),
        ({"protocols": []}, "BAD_MESSAGE"),
    ],
)
def test_an_invalid_hello_closes_the_connection(site, join, fields, code):
    planner = join(site.create(), None)
    answer = planner.hello(**fields)
    assert (answer["type"], answer["code"], answer["fatal"]) == ("error", code, True)
    assert planner.wait_closed() == 1008


def test_a_version_mismatch_names_both_versions(site, join):
    detail = join(site.create(), None).hello(v=2)["detail"]
    assert "version 2" in detail
    assert "speaks 1" in detail


def test_the_first_message_must_be_hello(site, join):
    planner = join(site.create(), None)
    answer = planner.reset()
    assert (answer["code"], answer["fatal"]) == ("BAD_MESSAGE", True)


def test_a_second_hello_is_refused_without_side_effects(planner):
    assert planner.hello()["code"] == "BAD_MESSAGE"
    assert planner.reset()["step"] == 0


def test_a_second_controller_is_refused_without_affecting_the_first(site, join):
    info = site.create()
    first = join(info)
    first.reset()
    second = join(info, None)
    answer = second.hello()
    assert (answer["code"], answer["fatal"]) == ("CONTROLLER_TAKEN", True)
    assert second.wait_closed() == 1008
    assert first.act(0)["step"] == 1


# --- messages ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "told"),
    [
        ({"kind": "control", "acceleration": math.nan, "steering": 0.0}, "acceleration"),
        ({"kind": "control", "acceleration": math.inf, "steering": 0.0}, "acceleration"),
        ({"kind": "control", "acceleration": 1.0}, "steering"),
        ({"kind": "control", "acceleration": 1.0, "steering": 9.0}, "steering"),
        ({"kind": "trajectory", "times_us": [1, 2], "poses": [[0, 0, math.nan]] * 2}, "poses"),
        ({"kind": "trajectory", "times_us": [2, 1], "poses": [[0, 0, 0]] * 2}, "increase"),
        ({"kind": "trajectory", "times_us": [1], "poses": [[0, 0, 0]] * 2}, "1 times for 2 poses"),
        ({"kind": "pose", "x": math.nan, "y": 0.0, "yaw": 0.0}, "x"),
        ({"kind": "teleport"}, "teleport"),
        ("straight on", "plan"),
    ],
)
def test_an_invalid_plan_is_explained_and_does_not_advance_the_step(planner, bystander, plan, told):
    planner.reset()
    answer = planner.ask("action", step=0, plan=plan)
    assert (answer["type"], answer["code"], answer["fatal"]) == ("error", "BAD_MESSAGE", False)
    assert told in answer["detail"]
    assert planner.act(0)["step"] == 1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"not msgpack at all",
        encode({"v": 1, "type": "action", "step": 0})[:-3],
        encode({"v": 1, "type": "fly"}),
        encode({"v": 1}),
        encode({"v": 1, "type": "bye", "extra": 1}),
        encode({"v": 1, "type": "action", "step": -1, "plan": None}),
        b"\x81\x01\x02",
        b"\x91" * 200 + b"\xc0",
        "a string",
    ],
)
def test_a_malformed_message_is_refused_and_the_session_continues(planner, data):
    planner.reset()
    planner.socket.send(data)
    answer = planner.receive()
    assert (answer["type"], answer["code"], answer["fatal"]) == ("error", "BAD_MESSAGE", False)
    assert answer["detail"]
    assert planner.act(0)["step"] == 1


def test_a_message_of_another_version_closes_the_connection_but_not_the_session(
    site, join, planner
):
    planner.reset()
    answer = planner.ask("action", v=3, step=0, plan={})
    assert (answer["code"], answer["fatal"]) == ("UNSUPPORTED_PROTOCOL", True)
    assert planner.wait_closed() == 1008
    assert join(planner.info).act(0)["step"] == 1


def test_an_oversized_message_closes_only_its_connection(site, join, planner, bystander):
    planner.reset()
    planner.socket.send(b"x" * (MAX_CLIENT_MESSAGE_BYTES + 1))
    assert planner.wait_closed() == 1009
    assert join(planner.info).act(0)["step"] == 1


def test_a_plan_near_the_message_size_limit_is_parsed_and_refused(planner, bystander):
    planner.reset()
    poses = [[0.0, 0.0, 0.0]] * 30_000
    answer = planner.ask(
        "action", step=0, plan={"kind": "trajectory", "times_us": [1], "poses": poses}
    )
    assert answer["code"] == "BAD_MESSAGE"
    assert "at most 1024" in answer["detail"]


# --- clients that disconnect --------------------------------------------------------------------


def vanish(planner) -> None:
    """Drop the connection without a close frame, like a killed process."""
    raw = planner.socket.socket
    raw.setsockopt(sockets.SOL_SOCKET, sockets.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    raw.close()


def test_a_new_controller_continues_after_a_disconnect_during_a_step(site, join, bystander):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[CAMERA | {"width": 2048}])
    planner.send("action", step=0, plan={"kind": "control", "acceleration": 1.0, "steering": 0.0})
    vanish(planner)
    session = site.session(info)
    wait_until(lambda: session.controller is None, "the worker to notice")
    successor = join(info, None)
    assert successor.hello()["step"] == 1
    assert successor.act(1)["step"] == 2


def test_a_disconnected_observer_is_removed(site, join):
    info = site.create()
    controller, observer = join(info), join(info, "observer")
    controller.reset()
    vanish(observer)
    session = site.session(info)
    for step in range(3):
        controller.act(step, acceleration=0.0)
    wait_until(lambda: not session.observers, "the worker to notice")


def test_deleting_a_session_notifies_all_clients(site, join):
    info = site.create()
    connected = [join(info), join(info, "observer")]
    connected[0].reset()
    connected[1].receive()
    assert site.call("DELETE", info).status_code == 204
    for planner in connected:
        answer = planner.receive()
        assert (answer["code"], answer["fatal"]) == ("SESSION_CLOSED", True)
        assert planner.wait_closed() == 1008
