"""Runs the Python examples of the README on a small street made as its commands do."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

import real2sim
from real2sim_server.logs import log_of_frames
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene
from real2sim_server.scene import Scene
from real2sim_server.scene.io import save_scene
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings
from real2sim_server.synthetic import SyntheticConfig, generate_log

pytestmark = pytest.mark.network

README = Path(__file__).resolve().parents[3] / "README.md"
COARSE = InitialiseOptions(
    max_background=5_000, max_object=200, voxel=0.5, ground_spacing=0.5, object_voxel=0.3,
    sky_resolution=16, feature_images=0, stereo_images=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def street() -> Scene:
    """All objects and lanes of the README's street, rendered coarsely."""
    log = log_of_frames(generate_log(SyntheticConfig()), (0, 30, 59))
    return initialise_scene(log, options=COARSE)


@pytest.fixture(scope="module")
def worker_url(street, tmp_path_factory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("readme")
    save_scene(street, root / "scenes" / "street.r2s")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error")
    with running_worker(settings) as worker:
        yield worker.url


@pytest.fixture
def run_example(worker_url, monkeypatch, tmp_path):
    """Run the only example that contains the given text. Returns its names."""
    text = README.read_text(encoding="utf-8").replace('"demo_street"', '"street"')
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    connect = real2sim.connect
    monkeypatch.setattr(real2sim, "connect", lambda: connect(worker_url))
    monkeypatch.chdir(tmp_path)

    def run(words: str) -> dict:
        (example,) = (block for block in blocks if words in block)
        assert len([line for line in example.splitlines() if line.strip()]) <= 15
        names: dict = {}
        exec(example, names)
        return names

    return run


def test_the_car_of_the_edit_is_in_the_lane_of_the_ego(run_example, worker_url, street):
    names = run_example("car in my lane")
    names["sim"].close()
    scenario = httpx2.get(f"{worker_url}/v1/scenarios/{names['scenario'].scenario_id}").json()
    objects = {o["object_id"]: o for o in scenario["objects"]}
    assert "car_5_copy1" not in objects
    x, y, _ = objects["car_6"]["trajectory"]["positions"][0]
    path = street.ego.positions
    beside = path[((path[:, :2] - (x, y)) ** 2).sum(1).argmin()]
    driven, stands = (street.lanes.nearest(*place) for place in (beside[:2], (x, y)))
    assert stands.lane_id == driven.lane_id
    assert abs(stands.offset) < 0.5
    assert Path("after.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_the_planner_example_drives_and_prints_scores(run_example, capsys):
    run_example("session.step(")["sim"].close()
    assert "pdms" in capsys.readouterr().out
