from __future__ import annotations

import sys
import textwrap

import pytest

import real2sim
from real2sim import planners
from real2sim.planners import FollowRoute, StageTimes, load_planner, run_episode

from ..fake_episode import ROUTE_LENGTH
from ..fake_worker import FakeWorker


@pytest.mark.network
def test_an_episode_ends_at_the_end_of_the_road(worker: FakeWorker) -> None:
    with (
        real2sim.connect(worker.url) as client,
        client.session(scene="street") as session,
    ):
        summary = run_episode(session, FollowRoute(speed=8.0), steps=500, privileged=True)
    assert (summary.truncated, summary.terminated, summary.reason) == (True, False, "horizon")
    assert summary.distance == pytest.approx(ROUTE_LENGTH - 2.0, abs=1.5)
    assert summary.end_us - summary.start_us == summary.steps * 100_000


@pytest.mark.network
def test_every_stage_of_every_step_is_timed(worker: FakeWorker) -> None:
    with (
        real2sim.connect(worker.url) as client,
        client.session(scene="street") as session,
    ):
        summary = run_episode(session, FollowRoute(), steps=7)
    assert set(summary.stages) == {"plan", "step", "loop", "worker.render", "worker.total"}
    assert {times.count for times in summary.stages.values()} == {7}
    assert summary.stages["worker.render"].p50 == 1.5
    assert summary.steps_per_second == pytest.approx(7 / summary.wall_seconds)


@pytest.mark.network
def test_the_callback_receives_every_observation_including_the_first(worker: FakeWorker) -> None:
    seen: list[int] = []
    with (
        real2sim.connect(worker.url) as client,
        client.session(scene="street") as session,
    ):
        run_episode(
            session, FollowRoute(), steps=3, on_observation=lambda obs: seen.append(obs.step)
        )
    assert seen == [0, 1, 2, 3]


@pytest.mark.network
@pytest.mark.parametrize("module", [real2sim, planners], ids=lambda m: m.__name__)
def test_the_docstring_example_runs(
    worker: FakeWorker, module: object, capsys: pytest.CaptureFixture[str]
) -> None:
    example = textwrap.dedent(module.__doc__.split("::\n\n", 1)[1].rsplit("\n\n", 1)[0])
    code = "\n".join(line for line in example.splitlines() if not line or line[0] != "F")
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) <= 15
    code = code.replace("http://127.0.0.1:8600", worker.url)
    code = code.replace("connect()", f"connect({worker.url!r})")
    exec(compile(code, "<docstring>", "exec"), {})
    assert capsys.readouterr().out


def test_stage_times_report_mean_and_percentiles():
    times = StageTimes.of([float(n) for n in range(101)])
    assert (times.count, times.mean, times.p50, times.p95, times.p99) == (101, 50, 50, 95, 99)


def test_planners_are_loaded_by_name_and_from_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "my_planner.py").write_text(
        "class Mine:\n    def reset(self, obs): pass\n    def plan(self, obs): pass\n"
        "class Half:\n    def plan(self, obs): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert isinstance(load_planner("follow_route"), FollowRoute)
    assert type(load_planner("my_planner:Mine")).__name__ == "Mine"
    with pytest.raises(ValueError, match=r"reset\(obs\)"):
        load_planner("my_planner:Half")


@pytest.mark.parametrize("name", ["nobody", "no.such.module:Class", "real2sim.planners:Nobody"])
def test_unknown_planners_are_named_in_the_error(name):
    with pytest.raises(ValueError, match=f"planner {name!r}"):
        load_planner(name)
