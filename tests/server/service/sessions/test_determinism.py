"""The same seed and actions give identical bytes."""

from __future__ import annotations

import hashlib
import json

import httpx2
import pytest

from ...worker_processes import KillableWorker

pytestmark = pytest.mark.network

SENSORS = [
    {"camera": "front", "modalities": ["rgb", "depth", "instance"]},
    {"camera": "left", "codec": "jpeg"},
]
PLANS = [
    {"kind": "trajectory", "times_us": [t, t + 500_000], "poses": [[1, 0.1, 0.02], [5, 0.6, 0.1]]}
    for t in range(100_000, 900_000, 100_000)
]


def fingerprint(planner) -> list[str]:
    """Hash of each observation, without its timing."""
    obs = planner.reset(seed=7, action="trajectory", sensors=SENSORS, privileged=True)
    hashes = [hashed(obs)]
    for step, plan in enumerate(PLANS):
        hashes.append(hashed(planner.ask("action", step=step, plan=plan)))
    closer = {"op": "translate", "object_id": "post", "y": -2.5}
    assert planner.ask("edit", operations=[closer])["type"] == "edited"
    hashes.append(hashed(planner.ask("action", step=len(PLANS), plan=late_plan())))
    return hashes


def late_plan() -> dict:
    return {"kind": "trajectory", "times_us": [1_500_000], "poses": [[4.0, 0.0, 0.0]]}


def hashed(obs: dict) -> str:
    assert obs["type"] == "obs", obs
    obs = {k: v for k, v in obs.items() if k not in {"timing", "id"}}
    digest = hashlib.sha256()
    for frame in obs.pop("frames"):
        digest.update(frame.pop("data") + repr(sorted(frame)).encode())
        digest.update(frame["T_world_sensor"].tobytes() + frame["K"].tobytes())
    digest.update(obs.pop("route").tobytes())
    digest.update(json.dumps(obs, sort_keys=True).encode())
    return digest.hexdigest()


def test_two_sessions_of_one_worker_are_identical(site, join):
    first = fingerprint(join(site.create()))
    assert fingerprint(join(site.create())) == first
    assert len(set(first)) == len(first)


def test_a_reset_repeats_the_episode_exactly(site, join):
    planner = join(site.create())
    assert fingerprint(planner) == fingerprint(planner)


def test_other_sessions_do_not_change_the_result(site, join):
    alone = fingerprint(join(site.create()))
    other = join(site.create())
    other.reset(sensors=[{"camera": "front", "width": 512}])
    other.send("action", step=0, plan={"kind": "control", "acceleration": 0, "steering": 0})
    assert fingerprint(join(site.create())) == alone


@pytest.mark.slow
def test_a_new_process_with_another_thread_count_gives_the_same_result(site, join, tmp_path):
    here = fingerprint(join(site.create()))
    worker = KillableWorker(
        scenes=site.worker.settings.scenes_path,
        data=tmp_path / "data",
        log_file=tmp_path / "log",
        settings={"REAL2SIM_THREADS": "1"},
    )
    worker.start()
    try:
        worker.wait_ready()
        answer = httpx2.post(f"{worker.url}/v1/sessions?scene=tiny", timeout=60)
        assert fingerprint(join(answer.raise_for_status().json())) == here
    finally:
        worker.kill()
