"""A fleet during a database outage, and behaviour and cost of its proxy."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import real2sim

from .test_fleet_kill import SESSIONS, Fleet, drive, fleet, undisturbed  # noqa: F401 - fixtures
from .test_trouble import stopped

pytestmark = [pytest.mark.network, pytest.mark.slow]

AWAY_S = 10.0
STRAIGHT = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
SCENES, EACH = 12, 4
TIMED = int(os.environ.get("REAL2SIM_TEST_STEPS", "600"))


def test_a_ten_second_database_outage_does_not_change_any_drive(
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


# --- behaviour and cost of the proxy -----------------------------------------------------------


def test_sessions_go_to_workers_with_their_scene_and_load_is_balanced(
    fleet: Fleet,  # noqa: F811
):
    """Sessions stay open, because the proxy counts their sockets."""
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
    # Not 100 %: a connection that is closing still counts as load. Chance level is 65 %.
    assert right >= 0.8
    assert most <= 1.5


def test_observations_through_the_proxy_equal_direct_ones(
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
