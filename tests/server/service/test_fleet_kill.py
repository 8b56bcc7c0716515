"""Three workers, HAProxy and PostgreSQL. Workers are killed or stopped during drives, and every
session continues elsewhere, bit for bit."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

import real2sim
from real2sim_server.render.cast.call import warm_up_casting
from real2sim_server.scene.io import save_scene

from ..ports import reserved_port
from ..worker_processes import KillableWorker
from .haproxy import running_haproxy
from .sessions.test_resume import FAN, SENSORS, hashed, plan

pytestmark = [pytest.mark.network, pytest.mark.slow]

WORKERS = ("w0", "w1", "w2")
SESSIONS, EPISODES, STEPS = 6, 3, 18
KILLS = int(os.environ.get("REAL2SIM_TEST_KILLS", "3"))
RESTARTED_EPISODES = int(os.environ.get("REAL2SIM_TEST_EPISODES", "36"))


class Fleet:
    """Workers on one store behind one address.

    Attributes:
        url: address of the proxy.
        gaps: duration of each step of all drives [s].
    """

    def __init__(self, url: str, store_url: str, workers: dict[str, KillableWorker]) -> None:
        self.url = url
        self.workers = workers
        self.gaps: list[float] = []
        self._engine = sa.create_engine(store_url, poolclass=sa.NullPool)

    def busiest(self) -> str:
        """The worker with the most open sessions."""
        query = (
            "SELECT worker_id FROM sessions WHERE closed_us IS NULL "
            "GROUP BY worker_id ORDER BY count(*) DESC LIMIT 1"
        )
        with self._engine.connect() as connection:
            return str(connection.execute(sa.text(query)).scalar() or WORKERS[0])

    def logs_are_whole(self) -> bool:
        """Whether every session log has contiguous positions without duplicates."""
        query = "SELECT count(*) - 1 - max(seq) FROM session_log GROUP BY session_id"
        with self._engine.connect() as connection:
            return all(row[0] == 0 for row in connection.execute(sa.text(query)))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory, tiny_scene, postgres) -> Iterator[Fleet]:
    root: Path = tmp_path_factory.mktemp("fleet")
    save_scene(tiny_scene, root / "scenes" / "tiny.r2s")
    store_url = postgres.new_database()
    warm_up_casting()
    with ExitStack() as stack:
        workers, agents = {}, {}
        for name in WORKERS:
            agents[name] = reserved_port()
            settings = {
                "REAL2SIM_STORE_URL": store_url,
                "REAL2SIM_WORKER_ID": name,
                "REAL2SIM_AGENT_PORT": str(agents[name]),
                "REAL2SIM_DRAIN_SECONDS": "1.5",
            }
            workers[name] = KillableWorker(
                scenes=root / "scenes",
                data=root / name,
                log_file=root / f"{name}.log",
                settings=settings,
            )
            stack.callback(workers[name].kill)
            workers[name].start()
        for worker in workers.values():
            worker.wait_listening()
        ports = {name: worker.port for name, worker in workers.items()}
        url = stack.enter_context(running_haproxy(root, ports, agents))
        with real2sim.connect(url) as client:
            client.wait_ready(240)
        yield Fleet(url, store_url, workers)


def drive(fleet: Fleet, seed: int) -> list[str]:
    """Hashes of all observations of several episodes in one session."""
    seen = []
    with (
        real2sim.connect(fleet.url) as client,
        client.session(scene="tiny", reconnect=240) as session,
    ):
        for episode in range(EPISODES):
            chosen = {"seed": 100 * episode + seed, "sensors": SENSORS, "lidars": [FAN]}
            seen.append(hashed(session.reset(**chosen, privileged=True)))
            for step in range(STEPS):
                began = time.monotonic()
                seen.append(hashed(session.step(plan(step))))
                fleet.gaps.append(time.monotonic() - began)
                time.sleep(0.02)
    return seen


@pytest.fixture(scope="module")
def undisturbed(fleet) -> list[list[str]]:
    return [drive(fleet, seed) for seed in range(SESSIONS)]


@pytest.mark.timeout(3600)
def test_sessions_of_killed_workers_continue_elsewhere_bit_for_bit(fleet, undisturbed):
    chance = random.Random(5)
    told: list[float] = []
    for _ in range(KILLS):
        fleet.gaps.clear()
        with ThreadPoolExecutor(SESSIONS) as drivers:
            drives = [drivers.submit(drive, fleet, seed) for seed in range(SESSIONS)]
            time.sleep(chance.uniform(0.2, 1.5))
            killed = fleet.workers[fleet.busiest()]
            killed.kill()
            assert [d.result() for d in drives] == undisturbed
        told.append(max(fleet.gaps))
        killed.start()
        killed.wait_listening(120)
    assert fleet.logs_are_whole()
    p95 = float(np.percentile(told, 95))
    print(f"{KILLS} kills under {SESSIONS} drives: longest step {max(told):.2f} s, p95 {p95:.2f} s")


def test_a_worker_paused_for_ten_seconds_is_fenced_off(fleet, undisturbed):
    with ThreadPoolExecutor(SESSIONS) as drivers:
        drives = [drivers.submit(drive, fleet, seed) for seed in range(SESSIONS)]
        time.sleep(0.5)
        process = fleet.workers[fleet.busiest()].process
        os.kill(process.pid, signal.SIGSTOP)
        waking = threading.Timer(10.0, os.kill, (process.pid, signal.SIGCONT))
        waking.start()
        assert [d.result() for d in drives] == undisturbed
        waking.join()
    assert fleet.logs_are_whole()


@pytest.mark.timeout(3600)
def test_a_rolling_restart_does_not_affect_planners(fleet, undisturbed):
    """Workers are stopped and restarted one after the other during drives. Every drive is identical
    and no error reaches its planner."""
    over, restarted = threading.Event(), []

    def restart_in_turn() -> None:
        while not over.is_set():
            name = WORKERS[len(restarted) % len(WORKERS)]
            fleet.workers[name].stop(60)
            fleet.workers[name].start()
            fleet.workers[name].wait_ready(120)
            restarted.append(name)

    fleet.gaps.clear()
    episodes = 0
    with ThreadPoolExecutor(1) as operator, ThreadPoolExecutor(SESSIONS) as drivers:
        restarting = operator.submit(restart_in_turn)
        try:
            while episodes < RESTARTED_EPISODES or len(restarted) < len(WORKERS):
                drives = [drivers.submit(drive, fleet, seed) for seed in range(SESSIONS)]
                assert [d.result() for d in drives] == undisturbed
                episodes += SESSIONS * EPISODES
        finally:
            over.set()
        restarting.result()
    assert fleet.logs_are_whole()
    p99 = float(np.percentile(fleet.gaps, 99))
    print(
        f"{len(restarted)} restarts under {episodes} episodes: longest step "
        f"{max(fleet.gaps):.2f} s, p99 {p99:.2f} s"
    )
