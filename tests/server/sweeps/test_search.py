"""Searches: what is found is the planner's fault, avoidable, and comes out the same again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from real2sim.planners import Needs, load_planner
from real2sim_server.policies.suite import Case
from real2sim_server.scene.io import load_scene
from real2sim_server.sweeps.episode import Danger, Drive, adversaries_of, begin, drive_episode
from real2sim_server.sweeps.evaluation import (
    SIDEWAYS,
    Evaluation,
    Evaluator,
    drive_reference,
    manoeuvres,
    plan_of,
)
from real2sim_server.sweeps.failure import boundaries
from real2sim_server.sweeps.optimise import (
    Archive,
    GaussianProcess,
    SearchBudget,
    random_search,
    search,
)
from real2sim_server.sweeps.search import (
    FAILURES,
    PAGE,
    SearchOptions,
    run_search,
    sobol_indices,
    splitting,
    wilson,
)
from real2sim_server.sweeps.spec import SHIPPED_SPACES, Space, load_space
from real2sim_server.world.recording import first_difference, load_recording

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
    options = SearchOptions(SearchBudget(24), shrink=1, probability=10, scenes=scene_folder)
    run_search([BRAKES], "pid", out, options)
    return out


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


def test_the_page_reports_what_was_found(found):
    page = (found / PAGE).read_text()
    report = json.loads((found / FAILURES).read_text())
    assert f"{report['avoidable']} avoidable collisions" in page
    assert page.count('class="card"') == report["cells"]
    assert "Probability of a collision at fault" in page


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
