"""The NeuroNCAP planner adapter against a small local server."""

from __future__ import annotations

import base64
import importlib
import io
import json
import math
import os
import sys
import threading
import types
import warnings
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch

from real2sim.planners import load_planner, needs_of
from real2sim.planners.neuroncap import NeuroNcap
from real2sim.planners.peer import PeerError

from . import rig

pytestmark = pytest.mark.network

AHEAD = [[3.0 * (k + 1), 0.5 * (k + 1)] for k in range(6)]


class Peer(HTTPServer):
    """Answers with ``reply``, and records all requests."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked: list[tuple[str, dict]] = []
        self.reply: object = {"trajectory": AHEAD, "aux_outputs": {}}
        self.status = 200
        self.url = f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Peer

    def do_GET(self):
        self._answer(True)

    def do_POST(self):
        content = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append((self.path, content))
        self._answer(self.server.reply if self.path == "/infer" else True)

    def _answer(self, content):
        body = json.dumps(content).encode()
        self.send_response(self.server.status if self.path == "/infer" else 200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def peer():
    with Peer() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def planner(peer):
    planner = NeuroNcap(peer.url)
    planner.reset(rig.seen())
    yield planner
    planner.close()


def test_the_planner_is_found_by_name_and_needs_all_cameras(peer):
    planner = load_planner(f"neuroncap={peer.url}")
    assert needs_of(planner).all_cameras
    assert needs_of(planner).modalities == ("rgb",)
    planner.close()


def test_the_trajectory_is_returned_with_times_and_headings(planner):
    plan = planner.plan(rig.seen())
    assert plan.times_us == [1_500_000 + 500_000 * k for k in range(6)]
    assert [pose[:2] for pose in plan.poses] == [tuple(p) for p in AHEAD]
    assert [pose[2] for pose in plan.poses] == pytest.approx([math.atan2(0.5, 3.0)] * 6)


def test_a_standing_trajectory_keeps_the_heading(peer, planner):
    peer.reply = {"trajectory": [[0.0, 0.0], [0.01, 0.005], [0.01, 0.005]], "aux_outputs": {}}
    assert [pose[2] for pose in planner.plan(rig.seen()).poses] == [0.0] * 3


def test_requests_contain_the_neuroncap_inputs(peer, planner):
    planner.plan(rig.seen())
    (_, reset), (path, told) = peer.asked
    assert reset == {}
    assert path == "/infer"
    assert set(told) == {"images", "ego2world", "canbus", "timestamp", "command", "calibration"}
    assert (told["timestamp"], told["command"]) == (1_000_000, 2)
    pose = np.array(told["ego2world"])
    np.testing.assert_allclose(pose[:3, :3], rig.turned(30.0), atol=1e-12)
    assert pose[:3, 3].tolist() == [100.0, 50.0, 2.0]
    assert len(told["canbus"]) == 16
    assert told["canbus"][13] == 6.0


def form(value):
    """Keys, lengths and types of a JSON value."""
    if isinstance(value, dict):
        return {key: form(part) for key, part in value.items()}
    if isinstance(value, list):
        return [form(part) for part in value]
    return "number" if isinstance(value, int | float) else type(value).__name__


def test_requests_have_the_same_structure_as_neuroncaps_own(peer, planner):
    """Compared with NeuroNCAP's own code, from a checkout of atonderski/neuro-ncap (MIT)."""
    checkout = os.environ.get("REAL2SIM_NEURONCAP")
    if not checkout:
        pytest.skip("REAL2SIM_NEURONCAP names no checkout of atonderski/neuro-ncap")
    for needed in ("httpx", "shapely"):
        pytest.importorskip(needed)
    planner.plan(rig.seen())
    told = peer.asked[-1][1]
    # Its package imports nuScenes' toolkit and other packages that this module does not use.
    for name in ("neuro_ncap", "neuro_ncap.components"):
        package = types.ModuleType(name)
        package.__path__ = [str(Path(checkout, *name.split(".")))]
        sys.modules[name] = package
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            theirs = importlib.import_module("neuro_ncap.components.model_api")
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "neuro_ncap"]:
            del sys.modules[name]
    names = list(told["images"])
    calibration = theirs.Calibration(
        camera2image={name: torch.eye(3) for name in names},
        camera2ego={name: torch.eye(4) for name in names},
        lidar2ego=torch.eye(4),
    )
    sent = theirs.ModelInput(
        images=dict.fromkeys(names, ""),
        ego2world=torch.eye(4),
        canbus=torch.zeros(16),
        timestamp=0,
        command=theirs.Command.STRAIGHT,
        calibration=calibration,
    ).to_json_dict()
    assert form(told) == form(sent)
    assert told["command"] == theirs.Command.STRAIGHT


def test_cameras_are_renamed_for_the_planner(peer, planner):
    planner.plan(rig.seen())
    told = peer.asked[-1][1]
    ours = {"CAM_FRONT": "front", "CAM_FRONT_LEFT": "left", "CAM_BACK": "CAM_BACK"}
    assert set(told["images"]) == set(ours)
    for k, name in enumerate(ours):
        saved = io.BytesIO(base64.b64decode(told["images"][name]))
        image = torch.load(saved, weights_only=True)
        assert (image.dtype, tuple(image.shape)) == (torch.uint8, (32, 48, 3))
        assert image.unique().tolist() == [10 * k]
        placed = np.array(told["calibration"]["camera2ego"][name])
        expected = rig.camera_on_vehicle(rig.CAMERAS[ours[name]])
        np.testing.assert_allclose(placed, expected, atol=1e-9)
        assert told["calibration"]["camera2image"][name] == rig.K.tolist()


@pytest.mark.parametrize(
    ("reply", "said"),
    [
        ({"trajectory": [[1.0, math.nan]], "aux_outputs": {}}, "not finite"),
        ({"trajectory": [[1.0, 2.0, 3.0]]}, r"shape \[1, 3\]"),
        ({"trajectory": []}, "shape"),
        ({}, "shape"),
        ([1, 2], "shape"),
        ({"trajectory": [["a", "b"]]}, "not a list of points"),
    ],
)
def test_invalid_trajectories_are_refused(peer, planner, reply, said):
    peer.reply = reply
    with pytest.raises(PeerError, match=said):
        planner.plan(rig.seen())


def test_an_error_of_the_planner_is_passed_on(peer, planner):
    peer.status, peer.reply = 500, {"detail": "out of memory"}
    with pytest.raises(PeerError, match=r"/infer answers 500.*out of memory"):
        planner.plan(rig.seen())


def test_an_unreachable_planner_is_named_by_address():
    with pytest.raises(PeerError, match=r"no planner answers at http://127\.0\.0\.1:9"):
        NeuroNcap("http://127.0.0.1:9", timeout=0.3)
