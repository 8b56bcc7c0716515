"""Searches: what is found is the planner's fault, avoidable, and comes out the same again."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.stats import norm
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim.planners import Needs, load_planner
from real2sim_server.console import CommandError
from real2sim_server.policies.page import film_episode
from real2sim_server.policies.suite import Case
from real2sim_server.scene.io import load_scene
from real2sim_server.scene.lane import Lane
from real2sim_server.scene.lane_graph import LaneGraph
from real2sim_server.sweeps.episode import Danger, Drive, adversaries_of, begin, drive_episode
from real2sim_server.sweeps.evaluation import (
    SIDEWAYS,
    Evaluation,
    Evaluator,
    drive_reference,
    manoeuvres,
    plan_of,
)
from real2sim_server.sweeps.failure import Failure, boundaries, render_page
from real2sim_server.sweeps.optimise import (
    Archive,
    GaussianProcess,
    SearchBudget,
    random_search,
    search,
)
from real2sim_server.sweeps.search import (
    FAILURES,
    JOURNAL,
    PAGE,
    SearchOptions,
    run_search,
    sobol_indices,
    splitting,
    wilson,
)
from real2sim_server.sweeps.spec import SHIPPED_SPACES, Space, load_space
from real2sim_server.sweeps.sweep import Journal
from real2sim_server.world.recording import first_difference, load_recording
from real2sim_server.world.scoring.road import RoadMap
from tests.server.planners import ALL, AND_LIMITS, REASONS, none_left_running

SLOW = pytest.mark.slow

BRAKES = Space.model_validate(
    {
        "case": {
            "name": "brakes",
            "scene": "tiny",
            "reset": {"agents": {"drivers": {"car_blue": {"kind": "hard_brake", "delay": 0.0}}}},
        },
        "parameters": {
            "gap": {
                "kind": "float",
                "path": "agents.drivers.car_blue.gap",
                "low": 1.0,
                "high": 25.0,
            },
            "braking": {
                "kind": "float",
                "path": "agents.drivers.car_blue.braking",
                "low": 2.0,
                "high": 8.0,
            },
        },
    }
)


@pytest.fixture(scope="module")
def scene(scene_folder):
    return load_scene(scene_folder / "tiny")


@pytest.fixture
def evaluate(scene) -> Evaluator:
    return Evaluator(scene, [BRAKES], "pid")


@pytest.fixture(scope="module")
def found(scene_folder, tmp_path_factory) -> Path:
    pytest.importorskip("cmaes")
    out = tmp_path_factory.mktemp("search")
    run_search([BRAKES], "pid", out, options_of(scene_folder))
    return out


def options_of(scene_folder: Path, episodes: int = 24) -> SearchOptions:
    return SearchOptions(SearchBudget(episodes), shrink=1, probability=10, scenes=scene_folder)


def contents(out: Path) -> dict[str, bytes]:
    """The files of a search, by path; without its journal."""
    files = (path for path in out.rglob("*") if path.is_file() and path.name != JOURNAL)
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def test_a_blind_planner_is_at_fault_where_the_reference_is_not(evaluate):
    seen = evaluate(0, [1.0, 1.0])
    assert seen.at_fault
    assert seen.avoided
    assert seen.score > 0
    assert seen.cell is not None
    assert seen.impact["object"] == "car_blue"


def test_the_reference_avoids_everybody_within_vehicle_limits(scene, evaluate):
    drive = evaluate(0, [1.0, 1.0]).drive
    world = begin(scene, drive, Needs(), privileged=False)
    drove = drive_reference(world)
    assert drove.survived
    assert drove.gap >= 0.2
    assert not drove.world.accumulator.collisions
    assert drove.effort <= drove.world.spec.ego.max_braking
    assert drove.world.accumulator.distance > 3.0


def test_swerves_stay_within_tyre_grip(scene):
    drive = Drive.of(BRAKES.case, "pid", 0)
    world = begin(scene, drive, Needs(), privileged=False)
    # Plans that brake to a stop end there at once; the vehicle does as its limits let it.
    for manoeuvre in [m for m in manoeuvres(8.0) if m.acceleration >= 0.0]:
        poses = np.array(
            [(world.motion.x, world.motion.y), *(p[:2] for p in plan_of(world, manoeuvre).poses)]
        )
        velocity = np.diff(poses, axis=0)[:, 1] / 0.2
        # Beside the straight route of this street; differences of poses 0.2 s apart.
        assert np.abs(np.diff(velocity) / 0.2).max() <= 1.25 * SIDEWAYS
    hardest = min(m.acceleration for m in manoeuvres(8.0) if m.aside)
    assert math.hypot(SIDEWAYS, hardest) < 0.9 * 9.81


def test_the_surrogate_fits_its_data_and_is_uncertain_elsewhere():
    rng = np.random.default_rng(0)
    points = rng.random((40, 2))
    values = np.sin(5.0 * points[:, 0])
    model = GaussianProcess.fitted(points, values)
    means, spreads = model.at(points)
    np.testing.assert_allclose(means, values, atol=0.02)
    assert spreads.max() < 0.05
    # The second coordinate says nothing.
    assert model.scales[1] > 2.0 * model.scales[0]
    few = GaussianProcess.fitted(points[:2], values[:2])
    assert few.at(np.array([[0.5, 0.5]]))[1] > 5 * model.at(np.array([[0.5, 0.5]]))[1]


def test_a_search_finds_what_one_in_hundreds_of_points_is_like():
    """A corner of 0.3 % of a cube that grades towards it, in a fifth of the points that drawing
    them would take."""
    pytest.importorskip("cmaes")

    class Corner:
        spaces = (None,)

        def dimensions(self, space: int) -> int:
            return 3

        def __call__(self, space: int, point) -> Evaluation:
            score = 0.13 - float(np.abs(np.asarray(point) - 0.85).sum())
            given = dict.fromkeys(Evaluation.__dataclass_fields__)
            given |= {"space": 0, "point": tuple(point), "score": 20.0 * score}
            given |= {"at_fault": score > 0, "avoided": True, "implausibility": 0.0}
            return Evaluation(**given | {"cell": ("front", "", "")})

    firsts = [
        search(Corner(), SearchBudget(300, seed, stop_at_first=True)).archive.first
        for seed in range(3)
    ]
    assert max(firsts) < 0.2 * math.log(2) / (4 / 3 * 0.13**3)


def test_bystanders_do_not_hide_how_near_the_named_objects_came(scene):
    """Parked cars are nearer to the ego than the one that brakes far ahead."""
    near, far = (
        Drive("pid", {"agents": {"drivers": {"car_blue": {"kind": "hard_brake", "gap": gap}}}})
        for gap in (25.0, 5.0)
    )
    driven = [drive_episode(scene, drive, load_planner("pid")) for drive in (near, far)]
    assert driven[0].danger.adversaries == {"car_blue"}
    assert driven[0].criticality > driven[1].criticality


def test_collisions_caused_by_others_do_not_end_a_search(scene):
    world = begin(scene, Drive("pid", {}), Needs(), privileged=False)
    danger = Danger(adversaries_of({}))
    danger.add(world)
    hit = {"collisions": 1, "first_impact": 4.0}
    struck = SimpleNamespace(accumulator=SimpleNamespace(at_fault={}, **hit))
    assert danger.criticality(struck) <= -1.0
    blamed = SimpleNamespace(accumulator=SimpleNamespace(at_fault={"vehicle": 1}, **hit))
    assert danger.criticality(blamed) == pytest.approx(0.7)


def test_a_case_considers_only_the_objects_it_names():
    assert adversaries_of({}) == frozenset()
    board = {"entities": [{"name": "Van"}, {"name": "Ego2", "object_id": "car_1"}]}
    edits = [{"op": "scale", "object_id": "car_2"}, {"op": "relight"}]
    assert adversaries_of({"storyboard": board}, edits) == {"Van", "Van.story", "car_1", "car_2"}


def test_searches_with_one_seed_are_identical(evaluate):
    pytest.importorskip("cmaes")
    one, again = (search(evaluate, SearchBudget(14, seed=3)) for _ in range(2))
    assert [e.point for e in one.evaluations] == [e.point for e in again.evaluations]
    drawn = random_search(evaluate, SearchBudget(4, seed=3))
    assert [e.point for e in drawn.evaluations] != [e.point for e in one.evaluations[:4]]


def test_a_search_may_end_with_the_first_failure(evaluate):
    pytest.importorskip("cmaes")
    state = search(evaluate, SearchBudget(40, stop_at_first=True))
    assert state.archive.first == len(state.evaluations)
    assert state.evaluations[-1].is_failure


def test_failures_are_saved_as_reproducible_cases_and_recordings(found, scene):
    report = json.loads((found / FAILURES).read_text())
    assert report["cells"] == len(report["failures"]) > 0
    for failure in report["failures"]:
        assert failure["replays"]
        recording = load_recording(found / failure["recording"])
        assert first_difference(recording, recording.replayer(scene)) is None
        assert sum(recording.accumulators()[-1].at_fault.values()) == 1
        [case] = json.loads((found / failure["case"]).read_text())["cases"]
        again = drive_episode(
            scene,
            Drive.of(Case.model_validate(case), "pid", 0),
            load_planner("pid"),
        )
        assert again.criticality == failure["criticality"]


class Cheap(Evaluator):
    """An evaluator with outcomes in closed form, which counts the episodes that it drives."""

    driven = 0

    def _driven(self, drive: Drive) -> dict:
        self.driven += 1
        car = drive.reset["agents"]["drivers"]["car_blue"]
        score = 0.3 - 0.1 * abs(car["gap"] - 7.0) - 0.2 * abs(car["braking"] - 6.1)
        hit = {"cell": ("front", f"{car['gap'] // 5:g}", "car"), "impact": {"speed": score / 3}}
        failed = {"at_fault": True, "avoided": True, **hit} if score > 0 else {"at_fault": False}
        measured = {"score": score, "criticality": score, "implausibility": 0.0}
        return {"avoided": None, "cell": None, "impact": {}} | measured | failed


def test_cut_off_anywhere_the_journal_leads_to_the_same_search(scene, tmp_path):
    """As after a kill at the end of each episode, or in the middle of the next one's record."""
    pytest.importorskip("cmaes")

    def searched(folder: Path, journal: bytes) -> tuple[Cheap, list, list]:
        folder.mkdir()
        (folder / JOURNAL).write_bytes(journal)
        with Journal(folder / JOURNAL) as opened:
            evaluate = Cheap(scene, [BRAKES], "pid", journal=opened)
            state = search(evaluate, SearchBudget(14))
            edges = [boundaries(evaluate, e) for e in state.archive.ordered()[:1]]
        return evaluate, [vars(e) for e in state.evaluations], edges

    whole, *expected = searched(tmp_path / "whole", b"")
    assert any(e["cell"] for e in expected[0])
    lines = (tmp_path / "whole" / JOURNAL).read_bytes().splitlines(keepends=True)
    assert len(lines) == whole.driven + 1
    for known in range(whole.driven):
        kept = b"".join(lines[: known + 1]) + lines[known + 1][: 20 * (known % 3)]
        resumed, *found = searched(tmp_path / str(known), kept)
        assert found == expected
        assert known + resumed.driven == whole.driven


def test_a_resumed_search_ends_with_the_same_files(found, scene_folder, tmp_path):
    lines = (found / JOURNAL).read_bytes().splitlines(keepends=True)
    kept = len(lines) * 3 // 4
    (tmp_path / JOURNAL).write_bytes(b"".join(lines[:kept]) + lines[kept][:-9])
    report = run_search([BRAKES], "pid", tmp_path, options_of(scene_folder))
    assert contents(tmp_path) == contents(found)
    assert report["driven_now"] == len(lines) - kept


def test_a_longer_search_drives_only_further_episodes(found, scene_folder, tmp_path):
    (tmp_path / JOURNAL).write_bytes((found / JOURNAL).read_bytes())
    options = replace(options_of(scene_folder, 30), shrink=0, probability=0)
    report = run_search([BRAKES], "pid", tmp_path, options)
    assert report["episodes"] == 30
    assert report["driven_now"] <= 6


KILLED_AFTER_THIRTY = """
import os, signal
from real2sim.cli import main
from real2sim_server.sweeps.sweep import Journal
add = Journal.add
def add_and_die(self, key, row):
    add(self, key, row)
    if len(self.rows) == 30:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.add = add_and_die
main()
"""


@pytest.mark.slow
def test_a_killed_search_ends_with_the_same_files_when_it_is_run_again(
    found, scene_folder, tmp_path
):
    space, out = tmp_path / "space.json", tmp_path / "out"
    space.write_text(BRAKES.model_dump_json(exclude_unset=True))
    command = ["search", str(space), "--planner", "pid", "--out", str(out), "--episodes", "24"]
    command += ["--shrink", "1", "--probability", "10", "--scenes", str(scene_folder)]
    ended = subprocess.call([sys.executable, "-c", KILLED_AFTER_THIRTY, *command])
    assert ended == -signal.SIGKILL
    assert {path.name for path in out.iterdir()} >= {JOURNAL}
    assert not (out / FAILURES).exists()
    figures = tmp_path / "figures.json"
    done = CliRunner().invoke(build_app(), [*command, "--json", str(figures)])
    assert done.exit_code == 0, done.output
    assert contents(out) == contents(found)
    driven = len(Journal(found / JOURNAL).rows)
    assert json.loads(figures.read_text())["driven_now"] == driven - 30


def test_episodes_of_a_changed_planner_are_not_taken_from_the_journal(tmp_path, monkeypatch):
    keys = set()
    for name in ("own_planner", "own.deep.planner"):
        for speed in (5.0, 6.0):
            source = tmp_path / f"{speed:g}" / f"{name.replace('.', '/')}.py"
            source.parent.mkdir(parents=True, exist_ok=True)
            source.write_text(f"class Own:\n    speed = {speed}\n")
            monkeypatch.chdir(tmp_path / f"{speed:g}")
            keys.add(Drive(f"{name}:Own", {}).key(""))
    assert len(keys) == 4


@pytest.mark.parametrize(
    ("failures", "limit_s"),
    [({"Exits": REASONS["Exits"]}, 60.0), *(pytest.param(*a, marks=SLOW) for a in AND_LIMITS)],
    ids=["exits", "misbehave", "never answer"],
)
def test_a_search_counts_failures_of_the_planner_itself_apart(
    failures, limit_s, scene_folder, tmp_path
):
    options = SearchOptions(
        SearchBudget(2), probability=1, scenes=scene_folder, plan_limit_s=limit_s
    )
    for name, reason in failures.items():
        out = tmp_path / name
        out.mkdir()
        with none_left_running(out):
            run_search([BRAKES], ALL[name], out, options)
        report = json.loads((out / FAILURES).read_text())
        assert (report["planner_failed"], report["at_fault"], report["failures"]) == (2, 0, [])
        assert report["first_error"].startswith(reason)
        assert report["spaces"][0]["probability"] is None
        assert "The planner itself failed in 2 of 2 episodes" in (out / PAGE).read_text()


def test_a_value_at_which_the_planner_itself_fails_is_no_safe_one(scene, evaluate):
    point = (1.0, 1.0)
    failure = evaluate(0, point)
    broken = Evaluator(scene, [BRAKES], ALL["CannotReset"])
    with contextlib.closing(broken):
        assert failure.at_fault
        assert boundaries(broken, failure) == []


def test_another_file_is_not_overwritten_as_a_journal_of_a_search(scene_folder, tmp_path):
    (tmp_path / JOURNAL).write_text("something else\n")
    with pytest.raises(CommandError, match="not a journal"):
        run_search([BRAKES], "pid", tmp_path, options_of(scene_folder))


def test_the_page_reports_what_was_found(found):
    page = (found / PAGE).read_text()
    report = json.loads((found / FAILURES).read_text())
    assert f"{report['avoidable']} avoidable collisions" in page
    assert page.count('class="card"') == report["cells"]
    assert page.count(">ego</text>") == page.count(">10 m</text>") == report["cells"]
    assert "Probability of a collision at fault" in page


def test_the_page_draws_the_lanes_around_the_ego(found):
    """A lane of 3.5 m along the ego, in the middle of a view of 44 m; one far away is left out."""
    report = json.loads((found / FAILURES).read_text())
    recording = load_recording(found / "recordings" / "failure_01.r2e")
    ego = recording.instants[-1].ego
    along = np.array([math.cos(ego.yaw), math.sin(ego.yaw), 0.0])
    centre = np.array([ego.x, ego.y, 0.0]) + np.outer([-90.0, 90.0], along)
    lanes = [
        Lane(name, "driving", centre + np.array([0.0, aside, 0.0]), np.full(2, 3.5))
        for name, aside in (("near", 0.0), ("far", 500.0))
    ]
    context = replace(recording.context, road_map=RoadMap(LaneGraph.of(lanes)))
    shown = SimpleNamespace(cell=None, impact={}, values={})
    mapped = replace(recording, context=context)
    failure = Failure("failure_01", shown, mapped, True, None, [], "films/failure_01.mp4")
    page = render_page(report, [failure])
    assert 'poster="films/failure_01.jpg"' in page
    [points] = re.findall(r'<polygon points="([^"]*)" [^>]*stroke=', page)
    across = {float(point.split(",")[0]) for point in points.split()}
    half = 1.75 * 300 / 44
    assert sorted(across) == pytest.approx([150 - half, 150 + half], abs=0.1)


def test_a_film_has_its_last_image_as_poster(found, scene, tmp_path):
    recording = load_recording(found / "recordings" / "failure_01.r2e")
    film, poster = tmp_path / "a.mp4", tmp_path / "a.jpg"
    film_episode(recording, recording.replayer(scene), scene, film, width=64, poster=poster)
    video, last = cv2.VideoCapture(str(film)), None
    while (frame := video.read())[0]:
        last = frame[1]
    assert last is not None
    # Films have an even number of rows.
    shown = cv2.imread(str(poster))[: len(last)]
    assert np.abs(shown.astype(float) - last).mean() < 12.0


def test_boundaries_separate_failures_from_passes(evaluate):
    failure = evaluate(0, [1.0, 1.0])
    edges = boundaries(evaluate, failure)
    assert edges
    for edge in edges:
        k = ["gap", "braking"].index(edge.parameter)
        p = BRAKES.parameters[edge.parameter]
        for value, fails in ((edge.last_fail, True), (edge.first_pass, False)):
            point = list(failure.point)
            point[k] = p.coordinate(value)
            assert evaluate(0, point).at_fault is fails
        assert edge.share <= 1.0


def test_the_archive_keeps_the_worst_of_each_cell():
    def failure(score, cell):
        given = dict.fromkeys(Evaluation.__dataclass_fields__)
        given |= {
            "score": score,
            "cell": (cell, "", ""),
            "at_fault": True,
            "avoided": True,
            "implausibility": 0.0,
        }
        return Evaluation(**given)

    archive = Archive()
    assert archive.add(failure(0.5, "a"), 7)
    assert not archive.add(failure(0.4, "a"), 8)
    assert archive.add(failure(0.6, "a"), 9)
    assert archive.add(failure(0.1, "b"), 10)
    assert [e.score for e in archive.ordered()] == [0.6, 0.1]
    assert archive.first == 7


def test_the_wilson_interval_matches_published_values():
    found = wilson(81, 263)  # Newcombe 1998, table I: 0.2553 to 0.3662
    assert (found.low, found.high) == (
        pytest.approx(0.2553, abs=1e-4),
        pytest.approx(0.3662, abs=1e-4),
    )


@pytest.mark.slow
def test_splitting_estimates_a_probability_too_small_to_sample():
    """Beyond 4 standard deviations along a diagonal: 3.2e-5."""
    truth = float(norm.sf(4.0))
    found = [
        splitting(
            lambda u: float(norm.ppf(u).sum() / math.sqrt(3)) - 4.0,
            3,
            particles=200,
            seed=seed,
            most_episodes=40_000,
        )
        for seed in range(3)
    ]
    for one in found:
        assert truth / 3 < one.value < truth * 3
    assert any(one.low <= truth <= one.high for one in found)


def test_splitting_that_does_not_reach_failure_gives_an_upper_bound():
    found = splitting(lambda u: -1.0 - float(u.sum()), 2, particles=20, most_episodes=300)
    assert found.value == 0.0
    assert 0.0 < found.high < 1.0
    assert "upper bound" in found.how


def test_sobol_indices_find_the_parameter_that_matters():
    rng = np.random.default_rng(0)
    points = rng.random((200, 3))
    scores = 4.0 * points[:, 0] + 2.0 * points[:, 1]
    found = sobol_indices(points.tolist(), scores.tolist(), ["a", "b", "c"])
    assert found["a"][0] == pytest.approx(0.8, abs=0.05)
    assert found["b"][1] == pytest.approx(0.2, abs=0.05)
    assert found["c"][1] < 0.03
    assert sobol_indices(points[:5].tolist(), scores[:5].tolist(), ["a", "b", "c"]) == {}


@pytest.mark.parametrize("name", sorted(p.stem for p in SHIPPED_SPACES.glob("*.yaml")))
def test_shipped_spaces_are_valid(name):
    assert load_space(name).case.name == name
