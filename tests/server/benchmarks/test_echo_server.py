"""The echo server, the baseline of the session bench."""

from __future__ import annotations

import pytest
from starlette.testclient import TestClient

from real2sim_bench.drive_probe import action
from real2sim_bench.learn import ECHOED, echo_app
from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode

OBSERVATION = {"v": 1, "type": "obs", "id": 2, "step": 0, "t_us": 5}


@pytest.mark.parametrize("what", ECHOED)
def test_every_action_is_answered_with_the_observation(what: str) -> None:
    client = TestClient(echo_app(encode(OBSERVATION)))
    with client.websocket_connect(f"/{what}", subprotocols=[DRIVE_SUBPROTOCOL]) as socket:
        socket.send_bytes(encode({"v": 1, "type": "hello", "id": 1}))
        assert decode(socket.receive_bytes())["type"] == "welcome"
        for message_id in (2, 3):
            socket.send_bytes(encode({"v": 1, "id": message_id, **action(OBSERVATION)}))
            assert decode(socket.receive_bytes()) == OBSERVATION
