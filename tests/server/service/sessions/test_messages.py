"""Client messages: the fast path for actions gives the same result as the general parser."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest

from real2sim_proto import encode
from real2sim_proto.codec import encode as encode_arrays
from real2sim_server.service.sessions import messages
from real2sim_server.service.sessions.messages import BadMessageError, _read, read_message

TRAJECTORY = {"kind": "trajectory", "times_us": [1, 2], "poses": [[1.0, 0.0, 0.0], [2, 0, 0]]}
ACTION: dict[str, Any] = {"v": 1, "id": 7, "type": "action", "step": 3, "plan": TRAJECTORY}


def outcome(read, data: bytes) -> object:
    try:
        return read(data)
    except BadMessageError as error:
        return (error.message_id, error.fatal, vars(error.error))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"slot": 1},
        {"plan": {"kind": "control", "acceleration": 1, "steering": 0.0}},
        {"plan": {"kind": "pose", "x": 1, "y": 2, "yaw": 0.5}},
        {"plan": TRAJECTORY | {"frame": "world"}},
        {"plan": TRAJECTORY | {"times_us": np.array([1, 2]), "poses": np.zeros((2, 3))}},
    ],
)
def test_the_fast_path_reads_an_action_like_the_general_parser(monkeypatch, changes):
    data = encode_arrays(ACTION | changes)
    slowly = _read(data)
    monkeypatch.setattr(messages, "_read", None)
    quickly = read_message(data)
    assert quickly.message == slowly
    assert repr(quickly.message) == repr(slowly)
    assert quickly.message.model_fields_set == slowly.model_fields_set


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        encode(ACTION)[:-1],
        encode(ACTION) + b"\x00",
        msgpack.packb([ACTION]),
        encode(ACTION | {"v": True}),
        encode(ACTION | {"v": 2}),
        encode(ACTION | {"v": [1]}),
        encode(ACTION | {"id": -1}),
        encode(ACTION | {"type": ["action"]}),
        encode(ACTION | {"more": 1}),
        encode({k: v for k, v in ACTION.items() if k != "v"}),
        encode(ACTION | {"plan": TRAJECTORY | {"times_us": [2, 1]}}),
        encode(ACTION | {"plan": TRAJECTORY | {"poses": [[float("nan"), 0.0, 0.0]] * 2}}),
        msgpack.packb(ACTION | {"step": msgpack.Timestamp(3)}),
        msgpack.packb(ACTION | {"step": msgpack.ExtType(9, b"")}),
        msgpack.packb(ACTION | {b"more": 1}),
        encode({"v": 1, "id": 1, "type": "bye"}),
    ],
)
def test_other_messages_are_handled_like_by_the_general_parser(data):
    def slowly(data: bytes) -> object:
        message = _read(data)
        content = b"" if message.type != "action" else messages.plan_payload(message.plan)
        return messages.ReceivedMessage(message, content)

    assert outcome(read_message, data) == outcome(slowly, data)


def test_an_action_that_is_not_a_number_is_refused_in_words():
    plan = {"kind": "control", "acceleration": 1.0, "steering": float("nan")}
    with pytest.raises(BadMessageError) as caught:
        read_message(encode(ACTION | {"plan": plan}))
    said = "action/plan/control/steering: must be a finite number, got NaN"
    assert caught.value.error.detail == said
