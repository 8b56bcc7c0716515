"""The code blocks of README and of the guides run, and what the pages promise comes true."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import real2sim
from real2sim_server.demo.street import unpack_street
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings
from tests.pages import LIMIT_S, Page

pytestmark = pytest.mark.network


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


@pytest.fixture(scope="module")
def demo_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A worker on the demo's street."""
    root = tmp_path_factory.mktemp("worker")
    unpack_street(root / "scenes", "demo_street")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error")
    with running_worker(settings) as worker:
        yield worker.url


@pytest.mark.slow
def test_rest(page: Callable[[str], Page], demo_url: str) -> None:
    with page("docs/rest.md") as rest, real2sim.connect(demo_url) as sim:
        serve = ".venv/bin/real2sim serve --scenes out/demo/scenes --data out/worker &"
        rest.shell("serve --scenes", {serve: ":", "http://127.0.0.1:8600": demo_url})
        (info,) = sim.scenarios.list()
        rest.shell("car_7")
        scenario = sim.scenarios.get(info.scenario_id)
        assert on_lane_of_the_drive(sim, scenario.objects["car_7"].pose(5.25).position)
        assert picture(rest.folder / "after.jpg").shape[2] == 3
        rest.shell("video.webm")
        assert frames_of(rest.folder / "cut_in.webm") == 107
        rest.shell("dataset.tar")
        assert {"coco", "nuscenes"} <= {path.name for path in rest.folder.iterdir()}
        assert picture(rest.folder / "labels.jpg").shape[2] == 3
        rest.shell("crash.jpg")
        contacts = json.loads((rest.folder / "crash.json").read_text())["contacts"]
        assert ["second", "van_0"] in [sorted(c["pair"]) for c in contacts]
        rest.shell('"experiment": "pair"')
        rest.shell("/v1/sweeps")
        assert (rest.folder / "episodes.parquet").stat().st_size > 0
        rest.shell("calibrate")
        found = json.loads((rest.folder / "calibration.json").read_text())["result"]
        assert found["factors"]["speed"] == pytest.approx(0.8, abs=0.02)
        rest.shell("above.jpg")
        assert picture(rest.folder / "above.jpg").shape == (360, 640, 3)
        obs = shown(sim, sensors=[rest.json("optics")])
        assert (obs["front"][0, 0] == 0).all()  # What the fisheye does not see is black.
        rest.shell("sweep.msgpack")
        assert (rest.folder / "sweep.f32").stat().st_size % 16 == 0
        rest.shell("blue_car")
        assert {"blue_car", "anna"} < {asset.asset_id for asset in sim.assets}
        jobs = [sim.jobs.get(job.job_id).wait(timeout=LIMIT_S) for job in sim.jobs]
        assert {job.info.kind for job in jobs} == {"calibrate", "export", "simulate", "sweep"}


def shown(sim: real2sim.Client, **options: Any) -> real2sim.Observation:
    """The first observation of a session on the demo street."""
    with sim.session("demo_street") as session:
        return session.reset(**options)


def on_lane_of_the_drive(sim: real2sim.Client, place: Sequence[float]) -> bool:
    """Whether a place is less than half a lane beside the recorded path."""
    path = np.array(sim.scenes["demo_street"].ego.positions)
    return bool(np.linalg.norm(path[:, :2] - place[:2], axis=1).min() < 1.75)


def frames_of(video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    count = 0
    while capture.grab():
        count += 1
    return count
