from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from real2sim_proto.episode import ResetSpec
from real2sim_server.console import CommandError
from real2sim_server.policies.suite import (
    DEMO_SUITE,
    SHIPPED_SUITES,
    Case,
    EpisodeGrid,
    cases_as_recorded,
    load_suite,
)

BRAKES = {"agents": {"drivers": {"car": {"kind": "hard_brake", "gap": 20.0}}}}


def gap(options) -> float:
    return options["agents"]["drivers"]["car"]["gap"]


def test_seed_0_is_the_unmodified_case_and_others_stay_within_the_jitter():
    case = Case(name="a", scene="s", reset=BRAKES, jitter={"agents.drivers.car.gap": 3.0})
    gaps = [gap(case.reset_for(seed)) for seed in range(50)]
    assert gaps[0] == 20.0
    assert len(set(gaps)) == 50
    assert all(17.0 <= g <= 23.0 for g in gaps)
    assert gap(case.reset_for(7)) == gaps[7]
    assert case.reset == BRAKES


def test_times_are_jittered_in_clock_steps():
    case = Case(name="a", scene="s", reset={"start_us": 500_000}, jitter={"start_us": 500_000})
    starts = {case.reset_for(seed)["start_us"] for seed in range(40)}
    assert all(start % 100_000 == 0 and 0 <= start <= 1_000_000 for start in starts)
    assert len(starts) > 5


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({}, "exactly one of scene and scenario"),
        ({"scene": "s", "scenario": "t"}, "exactly one"),
        ({"scene": "s", "reset": {"seed": 3}}, "seed"),
        ({"scene": "s", "reset": {"dt": 3}}, "dt"),
        ({"scene": "s", "jitter": {"agents.drivers.car.gap": 1.0}}, "not a number"),
        ({"scene": "s", "operations": [{"op": "fly"}]}, "fly"),
    ],
)
def test_an_invalid_case_is_refused_with_the_reason(fields, says):
    with pytest.raises(ValidationError, match=says):
        Case(name="a", **fields)


def test_a_suite_is_read_from_a_file(tmp_path):
    file = tmp_path / "suite.json"
    file.write_text(json.dumps({"cases": [{"name": "a", "scene": "s", "reset": BRAKES}]}))
    (case,) = load_suite(file)
    assert gap(case.reset_for(0)) == 20.0


@pytest.mark.parametrize("text", ["{", "{}", '{"cases": []}', '{"cases": [{"name": "a b"}]}', "[]"])
def test_an_invalid_suite_file_is_refused(tmp_path, text):
    file = tmp_path / "suite.json"
    file.write_text(text)
    with pytest.raises(CommandError):
        load_suite(file)


def test_duplicate_case_names_are_refused():
    with pytest.raises(CommandError, match="own"):
        cases_as_recorded(["street", "street"], [])


@pytest.mark.parametrize("name", sorted(file.stem for file in SHIPPED_SUITES.glob("*.json")))
def test_cases_of_shipped_suites_are_valid_for_all_seeds(name):
    for case in load_suite(name):
        for seed in range(20):
            ResetSpec.model_validate(case.reset_for(seed))


def test_the_demo_suite_is_shipped():
    assert {case.name for case in load_suite(DEMO_SUITE)} == {
        "as_recorded",
        "lead_brakes",
        "cut_in",
    }


def test_a_local_file_takes_precedence_over_a_shipped_suite(tmp_path, monkeypatch):
    (tmp_path / DEMO_SUITE).write_text('{"cases": [{"name": "mine", "scene": "s"}]}')
    monkeypatch.chdir(tmp_path)
    assert [case.name for case in load_suite(DEMO_SUITE)] == ["mine"]


def test_episodes_are_the_product_of_random_cases_planners_and_seeds():
    cases = [
        Case(name=name, scene=name, reset=BRAKES, jitter={"agents.drivers.car.gap": 1.0})
        for name in ("a", "b")
    ]
    grid = EpisodeGrid(cases, ("pid", "idm"), (0, 1, 2))
    assert len({(p, c.name, s) for p, c, s in grid.episodes()}) == 2 * 2 * 3


@pytest.mark.parametrize("jitter", [{}, {"agents.drivers.car.gap": 0.0}])
def test_a_case_without_randomness_is_driven_once(jitter):
    case = Case(name="a", scene="s", reset=BRAKES, jitter=jitter)
    grid = EpisodeGrid([case], ("pid", "idm"), (0, 1, 2))
    assert [(policy, seed) for policy, _, seed in grid.episodes()] == [("pid", 0), ("idm", 0)]


@pytest.mark.parametrize(
    "reset",
    [
        {"randomization": {"start": {"lateral": 0.5}}},
        {"randomization": {"latency_us": 50_000}},
        {"agents": {"spawn": {}}},
    ],
)
def test_a_case_with_a_random_reset_is_driven_with_every_seed(reset):
    grid = EpisodeGrid([Case(name="a", scene="s", reset=reset)], ["pid"], range(3))
    assert [seed for _, _, seed in grid.episodes()] == [0, 1, 2]
    assert [case.reset_for(seed)["seed"] for _, case, seed in grid.episodes()] == [0, 1, 2]


def test_reset_options_apply_to_recorded_scenes():
    (case,) = cases_as_recorded(["street"], [], {"randomization": {"latency_us": 10_000}})
    assert case.is_random
    with pytest.raises(CommandError, match="randomisation"):
        cases_as_recorded(["street"], [], {"randomisation": {}})
