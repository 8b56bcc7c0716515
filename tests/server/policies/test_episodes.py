from __future__ import annotations

import contextlib
import html
import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import real2sim
from real2sim.cli import build_app
from real2sim_server.policies.page import (
    group_scores,
    render_page,
    report_figures,
    unconfirmed_scores,
)
from real2sim_server.world.recording import load_recording
from real2sim_server.world.scoring import METRICS
from tests.server.planners import ALL, AND_LIMITS, none_left_running

pytestmark = pytest.mark.network


def one(results, policy, case, seed=0):
    (found,) = [d for d in results if (d.policy, d.case, d.seed) == (policy, case, seed)]
    return found


def test_random_cases_are_driven_with_every_seed_and_others_once(results):
    episodes = {(d.policy, d.case, d.seed) for d in results}
    assert len(episodes) == len(results) == 3 * (1 + 2)


def test_a_blind_planner_hits_a_braking_car_and_idm_does_not(results):
    assert one(results, "pid", "brakes").reason == "collision"
    assert one(results, "pid", "brakes").figures["at_fault"] == 1
    assert one(results, "idm", "brakes").figures["collisions"] == 0


def test_edits_of_a_case_are_applied(results):
    assert "car_blue" not in one(results, "pid", "free").recording.instants[-1].others.ids
    assert one(results, "pid", "free").figures["collisions"] == 0


def test_reported_scores_match_the_recordings(results, folder):
    figures = json.loads(json.dumps(report_figures(results, folder)))
    assert unconfirmed_scores(figures, folder) == []
    for episode in figures["episodes"]:
        if episode["error"] is None:
            again = load_recording(folder / episode["recording"]).rescore()
            assert {s["name"] for s in episode["scores"]} == set(METRICS)
            assert [s.value for s in again] == [s["value"] for s in episode["scores"]]


def test_a_score_that_does_not_match_its_recording_is_detected(results, folder):
    figures = json.loads(json.dumps(report_figures(results, folder)))
    figures["episodes"][0]["scores"][0]["value"] = 0.123
    assert unconfirmed_scores(figures, folder) == [figures["episodes"][0]["recording"]]


def test_means_and_deviations_are_computed_over_episodes(results):
    (group,) = [g for g in group_scores(results) if (g.policy, g.case) == ("idm", "brakes")]
    values = [one(results, "idm", "brakes", s).scores()["carla_ds"]["value"] for s in (0, 1)]
    spread = group.scores["carla_ds"]
    assert spread.mean == pytest.approx(sum(values) / 2)
    assert spread.deviation == pytest.approx(abs(values[0] - values[1]) / 2)
    assert group.episodes == spread.count == 2


def test_a_failing_planner_gets_no_scores(results):
    failed = one(results, "broken:Dies", "free")
    assert failed.reason == "planner failed"
    assert "KeyError" in failed.error
    (group,) = [g for g in group_scores(results) if (g.policy, g.case) == ("broken:Dies", None)]
    assert group.failed == 3
    assert all(spread is None for spread in group.scores.values())


def test_a_seed_gives_the_same_variation_for_every_planner(results):
    speeds = {
        (d.policy, d.seed): [i.others.velocities[1].tolist() for i in d.recording.instants[:12]]
        for d in results
        if d.case == "brakes" and d.policy != "broken:Dies"
    }
    assert speeds["idm", 0][:3] == speeds["pid", 0][:3]


def test_the_html_report_is_self_contained(results):
    text = render_page(results, title="a < b")
    assert "a &lt; b" in text
    loaded = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert loaded
    assert all(link.startswith(("data:image/", "recordings/")) for link in loaded)
    assert text.count("data:image/png") == 2 * 2
    assert text.count("data:image/jpeg") >= 2 * 2 * 4
    for name in METRICS:
        assert name.replace("_", " ") in text


@pytest.fixture(scope="module")
def evaluated(site, tmp_path_factory) -> tuple[Path, str]:
    """Folder and output of `evaluate-policy` on a scene with three seeds."""
    out = tmp_path_factory.mktemp("evaluate") / "out"
    command = ["evaluate-policy", "--policy", "pid", "--scene", "tiny", "--seeds", "3"]
    done = CliRunner().invoke(build_app(), [*command, "--url", site.url, "--out", str(out)])
    assert done.exit_code == 0, done.output
    return out, done.output


BAD = """
import os, sys
from real2sim.planners import FollowRoute
class Bad(FollowRoute):
    steps = 0
    def plan(self, obs):
        self.steps += 1
        return self.tenth() if self.steps == 10 else super().plan(obs)
class Exits(Bad):
    def tenth(self): os._exit(3)
class Leaves(Bad):
    def tenth(self): sys.exit("no more")
class Refused(Bad):
    def tenth(self): return {"kind": "pose", "x": 1e9, "y": 0.0, "yaw": 0.0}
class Other(FollowRoute):
    def plan(self, obs): return {"kind": "control", "acceleration": 0.0, "steering": 0.0}
class Nothing(FollowRoute):
    def plan(self, obs): pass
class Early(Bad):
    def begin(self, welcome): os._exit(4)
"""
FAILURES = {
    "bad:Exits": "the planner ended with exit code 3 at step 9",
    "bad:Leaves": "SystemExit: no more",
    "bad:Refused": "plan refused: plan: pose/x",
    "bad:Other": "plan refused: ",
    "bad:Nothing": "plan refused: plan: ",
    "bad:Early": "the planner ended with exit code 4 in begin",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failures", "limit_s"),
    [(FAILURES, 60.0), *(({ALL[k]: r for k, r in rs.items()}, s) for rs, s in AND_LIMITS)],
    ids=["own file", "misbehave", "never answer"],
)
def test_failing_planners_are_reported_and_the_others_driven(
    failures, limit_s, site, tmp_path, monkeypatch
):
    (tmp_path / "bad.py").write_text(BAD)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    command = ["evaluate-policy", "--scene", "tiny", "--url", site.url, "--out", str(out)]
    command += ["--plan-limit", str(limit_s), "--sessions", "1", "--policy", "pid"]
    policies = [word for name in failures for word in ("--policy", name)]
    alive = none_left_running(tmp_path) if failures is not FAILURES else contextlib.nullcontext()
    with alive:
        done = CliRunner().invoke(build_app(), [*command, *policies])
    assert done.exit_code == 1, done.output
    figures = json.loads((out / "report.json").read_text())
    episodes = {e["policy"]: e for e in figures["episodes"]}
    assert (episodes["pid"]["error"], episodes["pid"]["reason"]) == (None, "horizon")
    page = (out / "report.html").read_text()
    for name, reason in failures.items():
        error = episodes[name]["error"]
        assert error.startswith(reason)
        assert error in html.unescape(page)
        told = f"planner {name} failed in 1 of 1 episodes, first in tiny, seed 0: {error}"
        assert told in done.output
        assert load_recording(out / episodes[name]["recording"]).instants
    with real2sim.connect(site.url, token=site.token) as client:
        assert client.sessions.list() == []


def test_a_failed_planner_has_no_collision_count(site, tmp_path, monkeypatch):
    (tmp_path / "bad_too.py").write_text(BAD)
    monkeypatch.chdir(tmp_path)
    command = ["evaluate-policy", "--policy", "bad_too:Exits", "--scene", "tiny"]
    done = CliRunner().invoke(build_app(), [*command, "--url", site.url, "--out", "out"])
    assert re.search("collisions at fault *│ *–", done.output)
    assert re.search("failed episodes *│ *1 of 1", done.output)


def test_the_command_writes_a_report(evaluated):
    out, output = evaluated
    figures = json.loads((out / "report.json").read_text())
    assert unconfirmed_scores(figures, out) == []
    assert (out / "report.html").read_text().startswith("<!doctype html>")
    assert "pid" in output


@pytest.mark.slow
def test_a_scene_without_randomness_is_driven_once_with_a_note(evaluated):
    out, output = evaluated
    figures = json.loads((out / "report.json").read_text())
    assert [(e["case"], e["seed"]) for e in figures["episodes"]] == [("tiny", 0)]
    assert "driven once, not with 3 seeds: tiny" in output


@pytest.mark.slow
def test_without_seeds_the_output_does_not_mention_them(site, tmp_path, monkeypatch):
    (tmp_path / "bad_again.py").write_text(BAD)
    monkeypatch.chdir(tmp_path)
    command = ["evaluate-policy", "--policy", "bad_again:Early", "--scene", "tiny"]
    done = CliRunner().invoke(build_app(), [*command, "--url", site.url, "--out", "out"])
    assert "mean over cases" in done.output
    assert "seeds:" not in done.output


def test_one_episode_has_no_deviation(evaluated):
    out, _ = evaluated
    groups = json.loads((out / "report.json").read_text())["groups"]
    scores = [score for group in groups for score in group["scores"].values() if score]
    assert scores
    assert all(score["count"] == 1 and score["deviation"] is None for score in scores)
    assert "±" not in (out / "report.html").read_text()
