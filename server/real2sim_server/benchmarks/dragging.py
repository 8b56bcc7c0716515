"""Pictures of an object that is being dragged, as the studio asks for them over the view socket."""

from __future__ import annotations

import contextlib
import json
import math
import struct
import time
from collections.abc import Iterator
from typing import Any

from websockets.sync.client import ClientConnection, connect

import real2sim

SUBJECT, T_US = "van_0", 5_250_000
"""What is dragged on the demo's street, and when: the van ahead, four metres from the camera."""
CAMERA, WIDTH = "front", 640
REACH = 3.5
"""It is dragged to the next lane and back [m]."""
ROUND = 40
"""Pictures from one end to the other and back."""
WARM_UP = 10
ANSWER_S = 60.0


def drag(url: str, *, scene: str, frames: int) -> tuple[list[float], list[int]]:
    """Times [ms] from a question to its picture, and the size (width, height) of the pictures.

    Like the studio while a box is dragged on the map: a picture of the object at a new place is
    asked for as soon as the last one is here, so that a second holds as many pictures as fit.
    """
    with real2sim.connect(url) as client:
        client.wait_ready()
        client.scenes.load(scene)
        scenario = client.scenarios.create(scene=scene)
        times, size = [], [0, 0]
        with _view(url, scenario.scenario_id) as socket:
            for k in range(WARM_UP + frames):
                started = time.perf_counter()
                header = _request_frame(socket, k)
                times.append((time.perf_counter() - started) * 1e3)
                size = [header["width"], header["height"]]
        client.scenarios.delete(scenario.scenario_id)
    return times[WARM_UP:], size


@contextlib.contextmanager
def _view(url: str, scenario_id: str) -> Iterator[ClientConnection]:
    address = f"ws{url.removeprefix('http')}/v1/scenarios/{scenario_id}/view"
    with connect(address, compression=None, max_size=None, proxy=None) as socket:
        socket.send(json.dumps({"type": "hello", "token": ""}))
        welcome = json.loads(socket.recv(timeout=ANSWER_S))
        if welcome["type"] != "welcome":
            raise RuntimeError(f"the view was refused: {welcome}")
        yield socket


def _request_frame(socket: ClientConnection, k: int) -> dict[str, Any]:
    across = REACH * (1 - math.cos(2 * math.pi * k / ROUND)) / 2
    move = {"op": "translate", "object_id": SUBJECT, "y": across, "snap": True}
    request = {"seq": k, "camera": CAMERA, "t_us": T_US, "width": WIDTH, "operations": [move]}
    socket.send(json.dumps(request))
    while True:
        message = socket.recv(timeout=ANSWER_S)
        if isinstance(message, str):
            raise RuntimeError(f"a preview was refused: {message}")
        (size,) = struct.unpack_from("<I", message)
        header: dict[str, Any] = json.loads(message[4 : 4 + size])
        if header["seq"] == k:
            return header
