from __future__ import annotations

import json
import re

import pytest

from real2sim_server.policies.evaluate import Options, run
from real2sim_server.policies.page import page
from real2sim_server.policies.summary import figures_of, groups_of, recompute
from real2sim_server.world.recording.recording import load_recording
from real2sim_server.world.scoring import VERSIONS

pytestmark = pytest.mark.network


def one(driven, policy, case, seed=0):
    (found,) = [d for d in driven if (d.policy, d.case, d.seed) == (policy, case, seed)]
    return found


def test_every_planner_drives_every_case_with_every_seed(driven):
    assert len({(d.policy, d.case, d.seed) for d in driven}) == len(driven) == 3 * 2 * 2


def test_a_car_that_brakes_hard_is_hit_by_the_blind_and_not_by_those_that_see(driven):
    assert one(driven, "pid", "brakes").reason == "collision"
    assert one(driven, "pid", "brakes").figures["at_fault"] == 1
    assert one(driven, "idm", "brakes").figures["collisions"] == 0


def test_edits_of_a_case_take_effect_for_its_planners(driven):
    assert "car_blue" not in one(driven, "pid", "free").recording.instants[-1].others.ids
    assert one(driven, "pid", "free").figures["collisions"] == 0


def test_scores_of_the_report_are_those_of_the_recordings(driven, folder):
    figures = json.loads(json.dumps(figures_of(driven, folder)))
    assert recompute(figures, folder) == []
    for episode in figures["episodes"]:
        if episode["error"] is None:
            again = load_recording(folder / episode["recording"]).rescore()
            assert {s["name"] for s in episode["scores"]} == set(VERSIONS)
            assert [s.value for s in again] == [s["value"] for s in episode["scores"]]


def test_a_score_that_a_recording_does_not_bear_out_is_found(driven, folder):
    figures = json.loads(json.dumps(figures_of(driven, folder)))
    figures["episodes"][0]["scores"][0]["value"] = 0.123
    assert recompute(figures, folder) == [figures["episodes"][0]["recording"]]


def test_means_and_spreads_are_those_of_the_episodes(driven):
    (group,) = [g for g in groups_of(driven) if (g.policy, g.case) == ("idm", "brakes")]
    values = [one(driven, "idm", "brakes", s).scores()["carla_ds"]["value"] for s in (0, 1)]
    spread = group.scores["carla_ds"]
    assert spread.mean == pytest.approx(sum(values) / 2)
    assert spread.deviation == pytest.approx(abs(values[0] - values[1]) / 2)
    assert group.episodes == spread.count == 2


def test_a_planner_that_dies_gets_no_scores_and_holds_up_nobody(driven):
    failed = one(driven, "broken:Dies", "free")
    assert failed.reason == "planner failed"
    assert "KeyError" in failed.error
    (group,) = [g for g in groups_of(driven) if (g.policy, g.case) == ("broken:Dies", None)]
    assert group.failed == 4
    assert all(spread is None for spread in group.scores.values())


def test_seeds_vary_a_case_and_the_same_for_every_planner(driven):
    speeds = {
        (d.policy, d.seed): [i.others.velocities[1].tolist() for i in d.recording.instants[:12]]
        for d in driven
        if d.case == "brakes" and d.policy != "broken:Dies"
    }
    assert speeds["idm", 0][:3] == speeds["pid", 0][:3]


def test_the_page_holds_everything_and_loads_nothing(driven):
    text = page(driven, title="a < b")
    assert "a &lt; b" in text
    loaded = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert loaded
    assert all(link.startswith(("data:image/", "recordings/")) for link in loaded)
    assert text.count("data:image/png") == 2 * 2
    assert text.count("data:image/jpeg") >= 2 * 2 * 4
    for name in VERSIONS:
        assert name.replace("_", " ") in text


def test_the_command_leaves_a_report_of_a_running_worker(site, tmp_path, capsys):
    run(
        out=tmp_path / "out",
        options=Options(policies=("pid",), scenes=("tiny",), seeds=1, url=site.url),
    )
    figures = json.loads((tmp_path / "out/report.json").read_text())
    assert recompute(figures, tmp_path / "out") == []
    assert (tmp_path / "out/report.html").read_text().startswith("<!doctype html>")
    assert "pid" in capsys.readouterr().out
