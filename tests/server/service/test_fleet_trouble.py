"""A fleet whose database is away or whose store of objects is slow; what its proxy does."""

from __future__ import annotations

import http.client
import os
import shutil
import socket
import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

import real2sim
from real2sim_server.scene.io import save_scene

from ..worker_processes import KillableWorker
from .objects.conftest import s3_server  # noqa: F401 - a fixture
from .test_fleet_kill import SESSIONS, Fleet, drive, fleet, undisturbed  # noqa: F401 - fixtures
from .test_trouble import stopped

pytestmark = [pytest.mark.network, pytest.mark.slow]

AWAY_S = 10.0
LATE_S = 1.0
STRAIGHT = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
SCENES, EACH = 12, 4
TIMED = int(os.environ.get("REAL2SIM_TEST_STEPS", "600"))


@pytest.mark.timeout(900)
def test_a_database_that_is_away_for_ten_seconds_loses_and_doubles_nothing(
    fleet: Fleet,  # noqa: F811
    undisturbed: list[list[str]],  # noqa: F811
    postgres,
):
    fleet.gaps.clear()
    with ThreadPoolExecutor(SESSIONS) as drivers:
        drives = [drivers.submit(drive, fleet, seed) for seed in range(SESSIONS)]
        time.sleep(0.5)
        with stopped(postgres):
            time.sleep(AWAY_S)
        assert [d.result() for d in drives] == undisturbed
    assert fleet.logs_are_whole()
    print(f"a database away for {AWAY_S:.0f} s: longest step {max(fleet.gaps):.2f} s")


# --- what the proxy does and costs ------------------------------------------------------------


@pytest.mark.timeout(900)
def test_sessions_land_where_their_scene_is_and_no_worker_has_far_more_than_others(
    fleet: Fleet,  # noqa: F811
):
    """Sessions stay open: what the proxy counts is their sockets."""
    scenes = Path(fleet.workers["w0"].scenes)
    names = [f"tiny_{k}" for k in range(SCENES)]
    for name in names:
        shutil.copytree(scenes / "tiny.r2s", scenes / f"{name}.r2s")
    held, found = {name: set() for name in names}, []
    with ExitStack() as stack:
        client = stack.enter_context(real2sim.connect(fleet.url))
        for _ in range(EACH):
            for name in names:
                session = stack.enter_context(client.session(scene=name))
                worker = session.welcome.session_id.partition(".")[0]
                found.append((worker, not held[name] or worker in held[name]))
                held[name].add(worker)
    for name in names:
        shutil.rmtree(scenes / f"{name}.r2s")
    counts = Counter(worker for worker, _ in found)
    right = sum(there for _, there in found) / len(found)
    most = max(counts.values()) * len(fleet.workers) / len(found)
    print(
        f"{len(found)} sessions: {right:.1%} where their scene is, busiest {most:.2f} of the mean"
    )
    assert right >= 0.95
    assert most <= 1.5


@pytest.mark.timeout(900)
def test_observations_through_the_proxy_are_those_of_the_worker_and_its_cost_is_told(
    fleet: Fleet,  # noqa: F811
):
    def egos(url: str, times: list[float]) -> list[str]:
        seen = []
        with real2sim.connect(url) as client, client.session(scene="tiny") as session:
            session.reset(
                horizon=TIMED + 1, on_collision="continue", beyond_log="extend", action="control"
            )
            for _ in range(TIMED):
                began = time.perf_counter()
                seen.append(session.step(STRAIGHT))
                times.append(time.perf_counter() - began)
        return [repr(obs.ego) for obs in seen]

    direct, through = [], []
    for _ in range(3):
        worker = fleet.workers["w0"]
        assert egos(f"http://127.0.0.1:{worker.port}", direct) == egos(fleet.url, through)
    low, high = (np.percentile(t, 50) * 1e3 for t in (direct, through))
    print(f"a step without images, p50: {low:.3f} ms, through the proxy {high:.3f} ms")


# --- a slow store of objects ------------------------------------------------------------------


@contextmanager
def late(port: int) -> Iterator[int]:
    """A way to a server on which everything that is sent there takes LATE_S longer."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def pass_on(source: socket.socket, target: socket.socket, wait: float) -> None:
            with source, target, suppress(OSError):
                while data := source.recv(1 << 16):
                    time.sleep(wait)
                    target.sendall(data)

        def accept() -> None:
            while True:
                try:
                    here, _ = listening.accept()
                except OSError:
                    return
                there = socket.create_connection(("127.0.0.1", port))
                for ends in ((here, there, LATE_S), (there, here, 0.0)):
                    threading.Thread(target=pass_on, args=ends, daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        yield listening.getsockname()[1]


@pytest.mark.timeout(600)
def test_no_step_waits_for_a_store_of_objects_that_is_slow(
    tmp_path,
    tiny_scene,
    s3_server,  # noqa: F811
):
    save_scene(tiny_scene, tmp_path / "scenes" / "tiny.r2s")
    bucket = f"test-{uuid.uuid4().hex}"
    connection = http.client.HTTPConnection("127.0.0.1", s3_server)
    connection.request("PUT", f"/{bucket}")
    answer = connection.getresponse()
    assert answer.status == 200
    answer.read()

    def kept() -> int:
        connection.request("GET", f"/{bucket}?list-type=2")
        return connection.getresponse().read().count(b"<Key>")

    with late(s3_server) as port, ExitStack() as stack:
        worker = KillableWorker(
            scenes=tmp_path / "scenes",
            data=tmp_path / "data",
            log_file=tmp_path / "log",
            settings={
                "REAL2SIM_OBJECTS_URL": f"s3://{bucket}/fleet?endpoint=http://127.0.0.1:{port}"
                "&region=us-east-1",
                "AWS_ACCESS_KEY_ID": "tests",
                "AWS_SECRET_ACCESS_KEY": "tests",
            },
        )
        stack.callback(worker.kill)
        worker.start()
        worker.wait_listening()
        client = stack.enter_context(real2sim.connect(f"http://127.0.0.1:{worker.port}"))
        client.wait_ready(240)
        with client.session(scene="tiny") as session:
            session.reset(
                horizon=20_000, on_collision="continue", beyond_log="extend", action="control"
            )
            session.step(STRAIGHT)
            before = kept()
            asking = ThreadPoolExecutor(1).submit(
                lambda: client.assets.cut(scene="tiny", object_id="car_red", asset_id="red")
            )
            gaps = []
            ended = time.monotonic() + 60
            # The asset, its picture and whatever else a worker shares of it.
            while not asking.done() or len(gaps) < 100 or kept() < before + 1:
                assert time.monotonic() < ended
                began = time.monotonic()
                session.step(STRAIGHT)
                gaps.append(time.monotonic() - began)
                time.sleep(0.005)
        assert asking.result().asset_id == "red"
        print(f"{len(gaps)} steps beside a store that is late by {LATE_S:.0f} s: {max(gaps):.3f} s")
        assert max(gaps) < LATE_S / 2
