"""``real2sim bench edit``: latency of an edit, of opening a scenario with many edits, and of
previews while an object is dragged.

Measured by a client over loopback, with the worker in a separate process. The worker is killed
before the scenario is opened, so it is read from disk.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import struct
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
from rich.console import Console
from rich.table import Table
from websockets.sync.client import ClientConnection, connect

import real2sim
from real2sim_proto.operations import (
    OPERATION,
    Delete,
    Duplicate,
    Operation,
    Restore,
    Rotate,
    SetPhysics,
    SetVelocity,
    TimeRange,
    Translate,
)
from real2sim_server.demo.run import worker_process
from real2sim_server.demo.street import unpack_street
from real2sim_server.scene.io import save_scene
from real2sim_server.synthetic.gaussian_street import street

from .serve import percentiles

# Previews of an object while it is dragged, over the view socket as in the studio.

SUBJECT, T_US = "van_0", 5_250_000
"""Dragged object of the demo street, and time [us]: the van ahead, 4 m from the camera."""
CAMERA, WIDTH = "front", 640
REACH = 3.5
"""Lateral drag distance, to the next lane and back [m]."""
ROUND = 40
"""Previews per round trip."""
WARM_UP = 10
ANSWER_S = 60.0


def drag(url: str, *, scene: str, frames: int) -> tuple[list[float], list[int]]:
    """Times [ms] from request to preview, and the size (width, height) of previews.

    Like the studio while a box is dragged on the map: each preview is requested as soon as the
    previous one arrives.
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


SCENE = "street"
DRAGGED = "demo_street"
"""300,000 Gaussians, 18 objects."""
OPENINGS = 5

Figures = dict[str, Any]


@dataclass(frozen=True)
class EditBenchOptions:
    """Size of the benchmark: edits of a scenario, Gaussians of its scene, previews of a drag."""

    operations: int = 1000
    gaussians: int = 100_000
    previews: int = 200


def run(options: EditBenchOptions | None = None) -> Figures:
    """Edit a scenario many times, kill the worker, and open it again; figures in milliseconds.

    ``append`` is the time from sending an edit to its response, when it is on disk. ``open`` is the
    time of the first response about the scenario from a new process, ``describe`` that of later
    ones. ``preview`` is the time from requesting an image of a moved object to receiving it.
    """
    options = options or EditBenchOptions()
    console = Console()
    with tempfile.TemporaryDirectory(prefix="real2sim-bench-") as folder:
        root = Path(folder)
        scene = street(SCENE, gaussians=options.gaussians, width=320, height=214)
        save_scene(scene, root / "scenes" / f"{SCENE}.r2s")
        unpack_street(root / "scenes", f"{DRAGGED}.r2s")
        places = {"scenes": root / "scenes", "data": root}
        with (
            console.status(f"{options.operations} edits"),
            worker_process(**places, log_file=root / "writing.log") as worker,
        ):
            scenario_id, append = _append(worker.url, options.operations)
            worker.process.kill()
        opened, described = [], []
        for n in range(OPENINGS):
            with worker_process(**places, log_file=root / f"opening_{n}.log") as worker:
                times = _open(worker.url, scenario_id, revision=options.operations)
                opened.append(times[0])
                described += times[1:]
                worker.process.kill()
        with (
            console.status(f"{options.previews} previews"),
            worker_process(**places, log_file=root / "dragging.log") as worker,
        ):
            preview, size = drag(worker.url, scene=DRAGGED, frames=options.previews)
    figures = {
        "operations": options.operations,
        "append_ms": percentiles(append),
        "append_last_hundred_ms": percentiles(append[-100:]),
        "open_ms": percentiles(opened),
        "describe_ms": percentiles(described),
        "preview_ms": percentiles(preview),
        "preview_size": size,
        "preview_fps": 1e3 * len(preview) / sum(preview),
    }
    _print(console, figures)
    return figures


def _append(url: str, count: int) -> tuple[str, list[float]]:
    with real2sim.connect(url) as client:
        client.wait_ready()
        scenario = client.scenarios.create(scene=SCENE)
    cars = [o.object_id for o in scenario.info.objects]
    path = f"/v1/scenarios/{scenario.scenario_id}/operations"
    address = urlsplit(url)
    times = []
    # Raw HTTP, to exclude client overhead between request and response.
    with closing(HTTPConnection(address.hostname or "", address.port)) as http:
        for operation in _edits(cars, count):
            body = json.dumps({"operations": [OPERATION.dump_python(operation, mode="json")]})
            started = time.perf_counter()
            http.request("POST", path, body, {"Content-Type": "application/json"})
            answer = http.getresponse()
            answer.read()
            times.append((time.perf_counter() - started) * 1e3)
            if answer.status != 200:
                raise RuntimeError(f"an edit was answered with {answer.status} {answer.reason}")
    return scenario.scenario_id, times


def _edits(cars: list[str], count: int) -> list[Operation]:
    """Edits of all common kinds; most are small moves, as from dragging in the browser."""
    choose = random.Random(0)
    edits: list[Operation] = []
    while len(edits) < count:
        car = choose.choice(cars)
        kind = len(edits) % 20
        if kind == 0 and len(cars) < 30:
            new_id = f"copy_{len(edits)}"
            edits.append(Duplicate(object_id=car, new_id=new_id, y=3.5))
            cars.append(new_id)
        elif kind == 5:
            edits += [Delete(object_id=car), Restore(object_id=car)]
        elif kind == 9:
            when = TimeRange(start_us=2_000_000, end_us=6_000_000)
            edits.append(Translate(object_id=car, y=0.1, time_range=when))
        elif kind == 12:
            edits.append(SetPhysics(object_id=car, mass=1500.0, friction=0.6))
        elif kind == 15:
            edits.append(SetVelocity(object_id=car, linear=(5.0, 0.0, 0.0)))
        elif kind % 2:
            edits.append(Rotate(object_id=car, angle=choose.uniform(-0.1, 0.1)))
        else:
            edits.append(Translate(object_id=car, x=choose.uniform(-1, 1), snap=kind == 18))
    return edits[:count]


def _open(url: str, scenario_id: str, *, revision: int) -> list[float]:
    times = []
    with real2sim.connect(url) as client:
        client.wait_ready()
        client.scenes.list()
    with httpx2.Client(base_url=url, trust_env=False) as http:
        for _ in range(4):
            started = time.perf_counter()
            answer = http.get(f"/v1/scenarios/{scenario_id}").raise_for_status()
            times.append((time.perf_counter() - started) * 1e3)
            found = answer.json()["revision"]
            if found != revision:
                raise RuntimeError(f"{revision} edits were acknowledged, {found} were found again")
    return times


def _print(console: Console, figures: Figures) -> None:
    table = Table(r"\[ms]", "p50", "p95", "p99", "max", "n", title="edits", title_justify="left")
    for name in ("append_ms", "append_last_hundred_ms", "open_ms", "describe_ms", "preview_ms"):
        row = figures[name]
        numbers = [f"{row[column]:.2f}" for column in ("p50", "p95", "p99", "max")]
        table.add_row(name.removesuffix("_ms").replace("_", " "), *numbers, str(row["count"]))
    console.print(table)
    width, height = figures["preview_size"]
    console.print(f"dragging: {figures['preview_fps']:.1f} pictures of {width}x{height} a second")
