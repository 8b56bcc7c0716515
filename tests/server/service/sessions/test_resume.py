"""Episodes continue unchanged after a lost connection or a killed worker."""

from __future__ import annotations

import hashlib
import json
import random
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import real2sim
from real2sim_server.render.cast.call import warm_up_casting
from real2sim_server.scene.io import save_scene
from tests.waiting import LIMIT_S

from ...worker_processes import KillableWorker, killable_worker

pytestmark = pytest.mark.network

STEPS = 12
SENSORS = [{"camera": "front", "modalities": ["rgb", "depth"], "codec": "raw"}]
PLAN = {"kind": "control", "acceleration": 0.5, "steering": 0.02}


# --- lost connections ---------------------------------------------------------------------------


def test_a_resume_token_replaces_the_old_connection(site, join):
    info = site.create()
    first = join(info, None)
    token = first.hello()["resume_token"]
    first.reset()
    first.act(0)
    second = join(info, None)
    welcome = second.hello(resume={"token": token, "last_step": 1})
    assert (welcome["type"], welcome["step"]) == ("welcome", 1)
    assert second.act(1)["step"] == 2
    assert first.wait_closed() == 1008


def test_a_resume_token_needs_no_session_token(site, join):
    info = site.create()
    token = join(info, None).hello()["resume_token"]
    answer = join(info, None).hello(token=None, resume={"token": token})
    assert answer["type"] == "welcome"


def test_a_wrong_resume_token_does_not_displace_the_controller(site, join):
    info = site.create()
    planner = join(info)
    planner.reset()
    other = join(info, None)
    assert other.hello(resume={"token": "guess"})["code"] == "CONTROLLER_TAKEN"
    assert planner.act(0)["step"] == 1


def test_a_missed_observation_is_sent_again(site, join):
    info = site.create()
    first = join(info, None)
    token = first.hello()["resume_token"]
    first.reset(sensors=SENSORS)
    lost = first.act(0)
    second = join(info, None)
    second.hello(resume={"token": token, "last_step": 0})
    unasked = second.receive()
    assert (unasked["id"], unasked["step"]) == (0, 1)
    again = second.act(0)
    assert again["frames"][0]["data"] == lost["frames"][0]["data"]
    assert second.act(1)["step"] == 2


def test_the_sdk_reconnects_automatically(site):
    with (
        real2sim.connect(site.url) as client,
        client.session(scene="tiny") as session,
    ):
        session.reset(action="control")
        assert session.step(PLAN).step == 1
        session._socket.socket.shutdown(socket.SHUT_RDWR)
        assert session.step(PLAN).step == 2


def test_an_observer_receives_the_observations_of_the_controller(site):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as driver:
        driver.reset(action="control")
        with client.join(driver.session_id, token=driver.token, role="observer") as observer:
            driver.step(PLAN)
            driver.step(PLAN)
            view = observer.render(["front"])
            assert [observer.receive(timeout=LIMIT_S).step for _ in range(2)] == [1, 2]
            assert view.image("front").shape == (64, 96, 3)
            with pytest.raises(real2sim.ReplyTimeoutError):
                observer.receive(timeout=0.1)


# --- snapshots and forks ----------------------------------------------------------------------


def test_restoring_a_snapshot_repeats_the_episode(site):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(action="control")
        session.step(PLAN)
        assert session.snapshot("here").step == 1
        first = [session.step(PLAN) for _ in range(3)]
        assert session.restore("here").step == 1
        again = [session.step(PLAN) for _ in range(3)]
    assert [o.ego for o in again] == [o.ego for o in first]


def test_a_fork_starts_at_the_same_step_and_evolves_independently(site):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(action="control", sensors=SENSORS)
        session.step(PLAN)
        forked = session.fork()
        with client.join(forked.session_id, token=forked.token) as other:
            theirs = other.step(PLAN | {"acceleration": -3.0})
            mine = session.step(PLAN)
            assert theirs.step == mine.step == 2
            assert theirs.ego.speed < mine.ego.speed
    site.made.append({"session_id": forked.session_id, "token": forked.token})


def test_a_fork_counts_against_the_session_limit(own_site):
    site = own_site(max_sessions=1)
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(action="control")
        with pytest.raises(real2sim.CapacityError):
            session.fork()
        assert session.step(PLAN).step == 1


def test_an_unknown_snapshot_is_refused(site):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(action="control")
        with pytest.raises(real2sim.NotFoundError, match="no snapshot 'there'"):
            session.restore("there")


# --- killed workers -----------------------------------------------------------------------------

BEAMS = {"kind": "spinning", "elevation_deg": [-2, 0, 2], "columns": 90}
FAN = {
    "lidar": "fan",
    "model": {"name": "fan", "beams": BEAMS, "range_noise_m": 0.05},
    "period_us": 200_000,
}


@pytest.fixture(scope="module")
def killable(tmp_path_factory, tiny_scene) -> Iterator[KillableWorker]:
    root = tmp_path_factory.mktemp("killable")
    save_scene(tiny_scene, root / "scenes" / "tiny.r2s")
    folders = {"scenes": root / "scenes", "data": root / "data"}
    with killable_worker(**folders, log_file=root / "worker.log") as worker:
        yield worker


def drive(
    worker: KillableWorker, *, kill_at: tuple[int, ...] = (), delay: float = 0.0
) -> list[str]:
    """Hashes of all observations of an episode with an edit.

    The worker is killed ``delay`` seconds after the episode reaches a given step.
    """
    warm_up_casting()  # cached on disk, so that no reset waits for it
    killers = ThreadPoolExecutor(1)
    with killers, real2sim.connect(worker.url) as client:
        client.wait_ready(120)  # the previous kill may have come after the last answer
        with client.session(scene="tiny", reconnect=240) as session:
            first = session.reset(
                seed=5, sensors=SENSORS, lidars=[FAN], radars=["corner"], privileged=True
            )
            seen = [hashed(first)]
            for step in range(STEPS):
                if step == 4:
                    session.edit([{"op": "translate", "object_id": "post", "y": -1.0}])
                if step in kill_at:
                    killers.submit(worker.kill_and_start, delay)
                seen.append(hashed(session.step(plan(step))))
    return seen


def plan(step: int) -> dict:
    times = [100_000 * (step + k + 1) for k in range(5)]
    poses = [(0.5 * (k + 1), 0.01 * step * k, 0.0) for k in range(5)]
    return {"kind": "trajectory", "times_us": times, "poses": poses}


def hashed(obs: real2sim.Observation) -> str:
    digest = hashlib.sha256(obs.image("front").tobytes())
    digest.update(obs.image("front", "depth").tobytes() + np.ascontiguousarray(obs.route).tobytes())
    for cloud in obs.clouds.values():
        digest.update(cloud.wire.data)
    digest.update(obs.ego.model_dump_json().encode())
    digest.update(json.dumps([a.model_dump() for a in obs.agents]).encode())
    digest.update(json.dumps([e.model_dump() for e in obs.events]).encode())
    digest.update(json.dumps(dict(obs.metrics), sort_keys=True).encode())
    return digest.hexdigest()


@pytest.fixture(scope="module")
def undisturbed(killable) -> list[str]:
    return drive(killable)


def test_an_episode_is_identical_after_kills(killable, undisturbed):
    assert drive(killable, kill_at=(2, 9)) == undisturbed


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_an_episode_is_identical_after_fifty_random_kills(killable, undisturbed):
    chance = random.Random(7)
    for _ in range(50):
        kill_at = (chance.randrange(STEPS),)
        assert drive(killable, kill_at=kill_at, delay=chance.uniform(0, 0.05)) == undisturbed
