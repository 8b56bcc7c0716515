"""A drive longer than its recording is reproducible to the bit and resumes after a kill."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import real2sim
from real2sim.planners.idm import Idm
from real2sim_server.demo.street import unpack_street

from ..worker_processes import KillableWorker, killable_worker

pytestmark = pytest.mark.network

DRIVE = {
    "seed": 11,
    "beyond_log": "loop",
    "privileged": True,
    "agents": {
        "spawn": {"density": 30, "lanes": [{"offset": 0.0}, {"offset": 3.5, "oncoming": True}]}
    },
    "randomization": {
        "start": {"longitudinal": 2.0, "lateral": 0.3, "speed": 1.0},
        "estimate": {"position": 0.05, "heading": 0.005, "correlation": 5.0},
        "latency_us": 30_000,
    },
}


class Workers:
    """One worker after another, on the demo street and one store."""

    def __init__(self, worker: KillableWorker, stack: ExitStack) -> None:
        self._worker, self._stack = worker, stack
        self.client = self._connected()

    def kill(self) -> None:
        """Kill the worker. ``client`` then belongs to the next one."""
        self._worker.kill_and_start()
        self.client = self._connected()

    def _connected(self) -> real2sim.Client:
        self._worker.wait_listening()
        client = self._stack.enter_context(real2sim.connect(self._worker.url, timeout=120))
        client.wait_ready()
        return client


@pytest.fixture
def workers(tmp_path: Path) -> Iterator[Workers]:
    scenes, data = tmp_path / "scenes", tmp_path / "data"
    unpack_street(scenes, "street")
    with (
        killable_worker(scenes=scenes, data=data, log_file=tmp_path / "log") as worker,
        ExitStack() as stack,
    ):
        yield Workers(worker, stack)


def hashed(obs: real2sim.Observation) -> str:
    """Hash of an observation."""
    parts = [obs.step, obs.ego, obs.ego_truth, obs.agents, obs.events, obs.metrics, obs.drawn]
    digest = hashlib.sha256(repr([*parts, obs.lap, obs.route.tolist()]).encode())
    for camera in obs.frames:
        digest.update(obs.image(camera).tobytes())
    return digest.hexdigest()


def drive(workers: Workers, options: dict, *, kills: tuple[int, ...]) -> tuple[list[str], dict]:
    """Observation hashes and statistics of a drive whose worker is killed after some steps."""
    planner, session = Idm(speed=8.0), workers.client.session(scene="street").open()
    sensors = [{"camera": "front", "width": 64, "codec": "raw", "period_us": 500_000}]
    obs = session.reset(sensors=sensors, **options)
    hashes, seen, collisions = [hashed(obs)], set[str](), 0
    while not obs.over:
        if obs.step in kills:
            name, token = session.session_id, session.token
            workers.kill()
            session = workers.client.join(name, token=token).__enter__()
        obs = session.step(planner.plan(obs))
        hashes.append(hashed(obs))
        seen |= {a.object_id for a in obs.agents if a.object_id.startswith("spawned:")}
        collisions += sum(event.type == "collision" for event in obs.events)
    facts = {"lap": obs.lap, "spawned": len(seen), "collisions": collisions, "reason": obs.reason}
    session.close()
    return hashes, facts


@pytest.mark.slow
def test_a_drive_across_the_loop_seam_is_identical_after_a_kill(workers):
    # From shortly before the loop seam to shortly after it.
    options = DRIVE | {"start_us": 9_000_000, "horizon": 40}
    whole, facts = drive(workers, options, kills=())
    assert facts["lap"] == 1
    assert facts["spawned"] > 1
    assert drive(workers, options, kills=(25,)) == (whole, facts)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_three_minute_drive_is_identical_after_kills(workers):
    options = DRIVE | {"horizon": 1800}
    whole, facts = drive(workers, options, kills=())
    assert facts["reason"] == "horizon"
    assert facts["lap"] >= 12
    assert facts["spawned"] > 40
    assert facts["collisions"] == 0
    assert drive(workers, options, kills=(600, 1201)) == (whole, facts)
