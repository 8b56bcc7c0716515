"""The code blocks of README and of the guides run, and what the pages promise comes true."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import real2sim
from real2sim.planners import FollowRoute, run_episode
from real2sim.renderers.linked_scene import read_links
from real2sim_server.demo.street import unpack_street
from real2sim_server.policies.suite import load_suite
from real2sim_server.scene.range_sensors import read_lidar
from real2sim_server.service.routes.sockets import VIEW_REQUEST
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings
from tests.pages import LIMIT_S, REPOSITORY, Page

pytestmark = [pytest.mark.network, pytest.mark.timeout(5400)]


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


@pytest.fixture(scope="module")
def demo_url(worker_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A worker on the demo's street."""
    root = tmp_path_factory.mktemp("worker")
    unpack_street(root / "scenes", "demo_street")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error", max_sessions=32)
    with running_worker(settings) as worker:
        yield worker.url


@pytest.fixture
def demo(demo_url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[real2sim.Client]:
    """A client of that worker, which the commands and examples of a page find too."""
    monkeypatch.setenv("REAL2SIM_URL", demo_url)
    with real2sim.connect() as sim:
        yield sim


@pytest.mark.slow
def test_readme(
    page: Callable[[str], Page], demo_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page("README.md") as readme, contextlib.ExitStack() as opened:
        readme.block("pip install")
        monkeypatch.setenv("REAL2SIM_URL", demo_url)
        quickstart = readme.python("demo_street")
        quickstart["sim"].close()
        assert quickstart["obs"].over
        readme.shell("real2sim synth", {"out/log  ": "out/log --width 240 --height 160  "})
        assert picture(readme.folder / "out/street.png").shape[2] == 3
        readme.shell("--preset cpu-small", {"--iterations 4000": "--iterations 20"})
        assert (readme.folder / "out/report/report.html").exists()
        readme.shell("t_bone", {"--max-particles 8000": "--max-particles 2000"})
        assert frames_of(readme.folder / "out/t_bone/film.mp4") > 10
        settings = Settings(
            scenes_dir=readme.folder / "out/scenes", data_dir=readme.folder / "data", port=0,
            backend="cpu", log_level="error",
        )  # fmt: skip
        url = opened.enter_context(running_worker(settings)).url
        monkeypatch.setenv("REAL2SIM_URL", url)
        serve = "real2sim serve --scenes out/scenes "
        ours = {serve: f"export REAL2SIM_URL={url}; : ", "'http://127.0.0.1:8600/v1": f"'{url}/v1"}
        readme.shell("curl", ours)
        assert picture(readme.folder / "frame.jpg").shape[2] == 3
        edit = readme.python("car in my lane")
        place = edit["scenario"].objects["car_6"].position
        path = np.array(edit["sim"].scenes["street"].ego.positions)
        edit["sim"].close()
        assert np.linalg.norm(path[:, :2] - place[:2], axis=1).min() < 1.75
        assert "car_5_copy1" not in edit["scenario"].objects
        own_policy(readme, "class Mine", scene="street")
        targets = re.findall(r"^make ([\w-]+)", readme.block("make demo"), re.M)
        made = (REPOSITORY / "Makefile").read_text("utf-8")
        assert all(f"\n{target}:" in made for target in targets)


@pytest.mark.slow
def test_first_minutes(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/site/first_minutes.md") as first:
        new = "python -m venv .venv && . .venv/bin/activate\n"
        new += "pip install --no-compile 'real2sim[server]'  "
        new += "         # without --no-compile: a minute longer\n"
        first.shell("real2sim synth", {new: "", "out/log  ": "out/log --frames 10  ", "12 ": "5 "})
        first.block("real2sim serve")  # This worker runs already, with another street.
        names = first.python("nearer", **{'"street"': '"demo_street"'})
        before = names["street"].objects[0].trajectory
        moved = np.subtract(names["car"].position, before.positions[0])
        assert np.linalg.norm(moved) == pytest.approx(2.0, abs=1e-6)
        assert (first.folder / "nearer.jpg").exists()
        summary = first.python("run_episode", **{"steps=50": "steps=5"})["summary"]
        assert summary.steps == 5
        names["client"].close()


@pytest.mark.slow
def test_policies(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/policies.md") as policies:
        policies.shell("--policy pid", {"--out": "--scene demo_street --out"})
        for name in ("report.html", "report.json"):
            assert (policies.folder / "out/compared" / name).exists()
        own_policy(policies, "class Mine", scene="demo_street")
        suite = policies.block('"cases"')
        (policies.folder / "suite.json").write_text(suite)
        assert [case.name for case in load_suite(Path("suite.json"))] == ["lead_brakes"]
        policies.shell("--seeds 10", {"--seeds 10": "--seeds 2"})
        assert len(list((policies.folder / "report/recordings").rglob("*.r2e"))) == 2
        unpack_street(policies.folder, "street.r2s")
        policies.shell("--perturb", {"SCENE": "street.r2s --end-us 500000"})
        assert (policies.folder / "policy.safetensors").exists()
        env = policies.python("gymnasium.make(")["env"]
        seen, _ = env.reset(seed=0)
        assert seen["front"].shape == (320, 480, 3)
        env.close()


def own_policy(page: Page, words: str, *, scene: str) -> None:
    """The policy of a page drives a worker's scene, and is compared with idm over five seeds."""
    (page.folder / "mine.py").write_text(page.block(words))
    drive = f"real2sim drive --planner mine:Mine --scene {scene} --steps 50"
    page.shell("mine:Mine", {drive: f"{drive} --json driven.json"})
    assert json.loads((page.folder / "driven.json").read_text())["steps"] == 50
    report = json.loads((page.folder / "out/compared/report.json").read_text())
    whole = {g["policy"]: g for g in report["groups"] if g["case"] is None}
    assert set(whole) == {"mine:Mine", "idm"}
    assert {(g["episodes"], g["failed"]) for g in whole.values()} == {(15, 0)}


def test_learning(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/learning.md") as learning:
        names = learning.python("Drive-v0")
        assert names["obs"]["front"].shape == (4, 56, 84, 3)
        names["env"].close()
        names = learning.python("DriveBatch", **{"num_envs=64": "num_envs=4"})
        assert names["obs"]["front"].shape == (4, 84, 84, 3)
        assert names["reward"].shape == (4,)
        names["env"].close()


def test_lidar(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/lidar.md") as lidar:
        some = {"while not obs.over:": "for _ in range(4):"}
        obs = lidar.python("os1-128", **some)["obs"]
        assert obs.step == 4
        assert obs.radar("front").velocity.ndim == 1
        mine = lidar.block('"name": "mine"')
        (lidar.folder / "mine.json").write_text(mine)
        assert read_lidar(lidar.folder / "mine.json").name == "mine"


@pytest.mark.slow
def test_closed_loop(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/closed_loop.md") as loop, demo.session("demo_street") as session:
        obs = session.reset(privileged=True, **loop.json("beyond_log"))
        assert obs.step == 0
        loop.names["session"] = session
        assert loop.python("spawn")["edited"].created == ["spawned_1"]
        loop.block("alpasim-renderer")
        links = loop.block("T_world_theirs")
        (loop.folder / "links.json").write_text(links)
        (link,) = read_links(loop.folder / "links.json").values()
        assert link.cameras == {"camera_front_wide_120fov": "front"}
        loop.block("real2sim ros2")
        assert run_episode(session, FollowRoute(), horizon=5).steps == 5
        session.save_recording(loop.folder / "drive.r2e")
        unpack_street(loop.folder, "street.r2s")
        loop.shell("real2sim replay")
        assert frames_of(loop.folder / "a.mp4") > 0
        assert (loop.folder / "drive.mcap").read_bytes()[:5] == b"\x89MCAP"


@pytest.mark.slow
def test_scenarios(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/scenarios.md") as scenarios:
        storyboard = scenarios.python("storyboard = {")["storyboard"]
        with demo.session("demo_street") as session:
            obs = session.reset(privileged=True, storyboard=storyboard)
            assert np.hypot(*obs.agents["lead"].velocity[:2]) == pytest.approx(6.0, abs=0.1)
        board = scenarios.python("real2sim_proto.cases")["board"]
        with demo.session("demo_street") as session:
            obs = session.reset(privileged=True, storyboard=board)
            assert np.hypot(*obs.agents["cutter"].velocity[:2]) == pytest.approx(12.0, abs=0.1)
        own = demo.scenarios.create("demo_street")
        own.set_storyboard(board)
        assert own.storyboard == board
        unpack_street(scenarios.folder, "street.r2s")
        scenarios.shell("gallery:cut_in", {"scenes/street": "street.r2s"})
        assert frames_of(scenarios.folder / "cut_in.mp4") > 10
        assert (scenarios.folder / "cut_in.r2e").stat().st_size > 0
        names = scenarios.python("apply_corner_case")
        assert names["scenario"].storyboard.parameters["gap"] == 8.0
        ours = names["scenario"].scenario_id
        scenarios.shell("scenario gallery", {"sc_1f2e": ours})
        assert b"OpenSCENARIO" in (scenarios.folder / "again.xosc").read_bytes()
        scenarios.shell("real2sim gallery", {"gap=8": "gap=8 --seconds 2"})
        names["client"].close()


@pytest.mark.slow
def test_sweeps(page: Callable[[str], Page], demo: real2sim.Client) -> None:
    with page("docs/sweeps.md") as sweeps:
        space = sweeps.block("case:").replace("count: 64", "count: 2")
        (sweeps.folder / "sweep.yaml").write_text(space)
        sweeps.shell("sweep.yaml")
        assert (sweeps.folder / "out/cut_in/episodes.parquet").exists()
        of_file = sweeps.block("storyboard: cut_in.xosc")
        assert set(yaml.safe_load(of_file)) == {"storyboard", "case", "parameters"}
        scenario = demo.scenarios.create("demo_street")
        scenario.apply_corner_case("cut_in")
        scenario.write_xosc(sweeps.folder / "drawn.xosc")
        names = sweeps.python("client.sweeps.start", **{'"count": 64': '"count": 2', "300": "20"})
        files = {file.name for file in names["job"].info.files}
        assert f"{names['worst']}.r2e" in files
        names["search"].cancel()
        names["client"].close()
        sweeps.block("real2sim search")


@pytest.mark.slow
def test_simulation(page: Callable[[str], Page]) -> None:
    with page("docs/simulation.md") as simulation:
        found = simulation.python("calibrate(")["found"]
        true = {"stiffness": 1.3, "yield_stress": 0.8, "viscosity": 1.5, "friction": 1.2}
        for name, factor in true.items():
            assert found.factors[name] == pytest.approx(factor, abs=1e-4)


def test_studio(page: Callable[[str], Page]) -> None:
    with page("docs/studio.md") as studio:
        assert "--demo" in studio.block("real2sim serve")
        asked = studio.json('"seq"')
        assert VIEW_REQUEST.validate_python(asked).camera == "front"


@pytest.mark.slow
def test_rest(page: Callable[[str], Page], demo: real2sim.Client, demo_url: str) -> None:
    others = {job.job_id for job in demo.jobs}
    with page("docs/rest.md") as rest:
        serve = ".venv/bin/real2sim serve --scenes out/demo/scenes --data out/worker &"
        rest.shell("serve --scenes", {serve: ":", "http://127.0.0.1:8600": demo_url})
        (info,) = [info for info in demo.scenarios if info.name == "cut-in"]
        rest.shell("car_7")
        scenario = demo.scenarios.get(info.scenario_id)
        # From the kerb into the lane beside it, which is the oncoming one.
        place = scenario.objects["car_7"].pose(5.25).position
        assert beside_the_drive(demo, place) == pytest.approx(3.5, abs=0.6)
        assert picture(rest.folder / "after.jpg").shape[2] == 3
        rest.shell("video.webm")
        assert frames_of(rest.folder / "cut_in.webm") == 107
        rest.shell("dataset.tar")
        assert {"coco", "nuscenes"} <= {path.name for path in rest.folder.iterdir()}
        assert picture(rest.folder / "labels.jpg").shape[2] == 3
        rest.shell("crash.jpg")
        contacts = json.loads((rest.folder / "crash.json").read_text())["contacts"]
        assert ("second", "van_0") in {(c["object_id"], c["other"]) for c in contacts}
        rest.shell('"experiment": "pair"')
        rest.shell("/v1/sweeps")
        assert (rest.folder / "episodes.parquet").stat().st_size > 0
        rest.shell("calibrate")
        found = json.loads((rest.folder / "calibration.json").read_text())["result"]
        assert found["factors"]["speed"] == pytest.approx(0.8, abs=0.02)
        rest.shell("above.jpg")
        assert picture(rest.folder / "above.jpg").shape == (360, 640, 3)
        obs = shown(demo, sensors=[rest.json("optics")])
        assert obs["front"][0, 0].max() < 10  # Black but for noise: the fisheye does not see it.
        rest.shell("sweep.msgpack")
        assert (rest.folder / "sweep.f32").stat().st_size % 16 == 0
        rest.shell("blue_car")
        assert {"blue_car", "anna"} < {asset.asset_id for asset in demo.assets}
        started = {job.job_id for job in demo.jobs} - others
        jobs = [demo.jobs.get(job_id).wait(timeout=LIMIT_S) for job_id in started]
        assert {job.info.kind for job in jobs} == {"calibrate", "export", "simulate", "sweep"}


def shown(sim: real2sim.Client, **options: Any) -> real2sim.Observation:
    """The first observation of a session on the demo street."""
    with sim.session("demo_street") as session:
        return session.reset(**options)


def beside_the_drive(sim: real2sim.Client, place: Sequence[float]) -> float:
    """How far a place is from the recorded path [m]."""
    path = np.array(sim.scenes["demo_street"].ego.positions)
    return float(np.linalg.norm(path[:, :2] - place[:2], axis=1).min())


def frames_of(video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    count = 0
    while capture.grab():
        count += 1
    return count
