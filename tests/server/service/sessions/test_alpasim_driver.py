"""NVIDIA's AlpaSim driver service drives a session.

REAL2SIM_ALPASIM names a checkout of github.com/NVlabs/alpasim (Apache-2.0). The service also needs
grpcio-tools, omegaconf, hydra-core and torch, but no weights: the model is a stub.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import real2sim
from real2sim.planners import run_episode
from real2sim.planners.alpasim import AlpasimDriver
from tests.waiting import LIMIT_S

pytestmark = [pytest.mark.network]

PROCESS = Path(__file__).parents[3] / "client" / "planners" / "alpasim_driver_process.py"
CAMERAS = ["camera_front_wide_120fov", "camera_front_tele_30fov", "camera_cross_left_120fov"]


@pytest.fixture
def serve(tmp_path):
    """Start the service for some cameras and a context length. Returns its address."""
    checkout = os.environ.get("REAL2SIM_ALPASIM")
    if not checkout:
        pytest.skip("REAL2SIM_ALPASIM names no checkout of NVlabs/alpasim")
    for needed in ("grpc_tools", "omegaconf", "hydra"):
        pytest.importorskip(needed)
    started = []

    def start(cameras: list[str], context: int, *options: str) -> str:
        arguments = [checkout, ",".join(cameras), str(context), str(tmp_path), *options]
        process = subprocess.Popen(
            [sys.executable, str(PROCESS), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        said = ""
        for line in process.stdout:
            said += line
            if found := re.match(r"listens at (\d+)", line):
                return f"127.0.0.1:{found[1]}"
        raise AssertionError(f"the service did not start: {said}")

    yield start
    for process in started:
        process.terminate()
        process.communicate(timeout=LIMIT_S)


def drive(site, target: str, *, steps: int) -> tuple[real2sim.planners.EpisodeSummary, int]:
    """Drive the tiny scene, which lasts two seconds."""
    planner = AlpasimDriver(target)
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        sensors = planner.needs.sensors(session.welcome.cameras)
        summary = run_episode(
            session, planner, steps=steps, sensors=sensors, dt_us=20_000, on_collision="continue"
        )
    planner.close()
    return summary, len(sensors)


@pytest.mark.parametrize("context", [1, 4])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_nvidias_service_drives_100_steps(site, serve, context, count):
    summary, sensors = drive(site, serve(CAMERAS[:count], context), steps=100)
    assert summary.steps == 100
    assert summary.distance > 5.0
    # The scene has two cameras. The front one serves as both wide and tele.
    assert sensors == (1 if count < 3 else 2)


def test_a_service_with_rectification_drives(site, serve):
    summary, _ = drive(site, serve(CAMERAS[:1], 1, "rectify"), steps=10)
    assert summary.steps == 10
