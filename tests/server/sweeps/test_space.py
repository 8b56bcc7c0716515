"""Parameter spaces: what a point stands for, and where its values go."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from real2sim_proto.sweeps import GridMethod, ImportanceBump, ImportanceMethod, SpreadMethod
from real2sim_server.console import CommandError
from real2sim_server.sweeps.parameters import (
    Choice,
    FloatRange,
    IntRange,
    Normal,
    evaluate,
    names_in,
    points_of,
    values_at,
)
from real2sim_server.sweeps.spec import Space, load_space, load_sweep

units = st.floats(0.0, 1.0)
BRAKES = {"agents": {"drivers": {"car_blue": {"kind": "hard_brake"}}}}
CASE = {"name": "brakes", "scene": "tiny", "reset": BRAKES}


@pytest.mark.parametrize(
    "parameter",
    [
        FloatRange(low=-2.0, high=5.0),
        FloatRange(low=0.1, high=50.0, log=True),
        Normal(kind="normal", mean=1.0, std=2.0, low=-1.0, high=4.0),
    ],
)
@given(u=units)
def test_values_stay_in_range_and_map_back_to_their_coordinate(parameter, u):
    value = parameter.at(u)
    assert parameter.low - 1e-9 <= value <= parameter.high + 1e-9
    assert parameter.coordinate(value) == pytest.approx(u, abs=1e-6)


@given(u=units)
def test_whole_numbers_and_choices_are_those_allowed(u):
    assert IntRange(kind="int", low=-1, high=3).at(u) in {-1, 0, 1, 2, 3}
    assert Choice(kind="choice", values=["a", 2, True]).at(u) in ["a", 2, True]


def test_every_whole_number_is_equally_likely():
    drawn = [IntRange(kind="int", low=2, high=5).at((k + 0.5) / 400) for k in range(400)]
    assert [drawn.count(v) for v in (2, 3, 4, 5)] == [100] * 4


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("gap + 2 * speed", 19.0),
        ("-gap ** 2", -9.0),
        ("min(gap, speed) / 2", 1.5),
        ("sqrt(abs(gap - 7))", 2.0),
        ("radians(180)", math.pi),
    ],
)
def test_arithmetic_expressions_are_evaluated(text, value):
    assert evaluate(text, {"gap": 3.0, "speed": 8.0}) == pytest.approx(value)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')",
        "gap.real",
        "[1][0]",
        "lambda: 1",
        "gap if gap else 1",
        "2 ** 99999",
        "open('x')",
        "'a' * 3",
        "gap and 1",
        "min(x=1)",
        "(" * 120 + ")" * 120,
        "1 +",
    ],
)
def test_non_arithmetic_expressions_are_refused(text):
    with pytest.raises(ValueError, match=r"is (no|not)|exponent|allowed|characters"):
        evaluate(text, {"gap": 1.0})


def test_non_finite_results_are_refused_with_the_numbers():
    assert names_in("1 / (gap - 1)") == {"gap"}
    with pytest.raises(ValueError, match="gap = 1"):
        evaluate("1 / (gap - 1)", {"gap": 1.0})


def test_derived_values_are_computed_after_their_inputs():
    space = Space.model_validate(
        {
            "case": CASE,
            "parameters": {
                "gap": {"kind": "float", "low": 2, "high": 4},
                "delay": {
                    "kind": "derived",
                    "expression": "gap / 2",
                    "path": "agents.drivers.car_blue.delay",
                },
            },
        }
    )
    values = values_at(space.parameters, [0.5])
    case = space.case_at(values)
    assert values == {"gap": 3.0, "delay": 1.5}
    assert case.reset["agents"]["drivers"]["car_blue"]["delay"] == 1.5
    assert "delay" not in space.case.reset["agents"]["drivers"]["car_blue"]


def test_paths_lead_into_reset_and_operations():
    move = {"op": "translate", "object_id": "car_red", "y": 0.0}
    space = Space.model_validate(
        {
            "case": {**CASE, "operations": [move]},
            "parameters": {
                "aside": {"kind": "float", "low": -1, "high": 1, "path": "operations.0.y"},
                "start": {"kind": "float", "low": 0, "high": 1e5, "path": "reset.start_us"},
            },
        }
    )
    case = space.case_at({"aside": 0.25, "start": 1234.56})
    assert case.operations[0].y == 0.25
    assert case.reset["start_us"] == 1235


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("agents.drivers.car_blue.gapp", "gapp"),
        ("operations.0.y", "leads nowhere"),
        ("seed", "names 'seed'"),
    ],
)
def test_invalid_paths_are_refused(path, message):
    parameter = {"kind": "float", "low": 1, "high": 2, "path": path}
    with pytest.raises((ValidationError, ValueError), match=message):
        Space.model_validate({"case": CASE, "parameters": {"x": parameter}})


DRAWN = {
    "a": FloatRange(low=0, high=1),
    "b": IntRange(kind="int", low=1, high=3),
    "c": Choice(kind="choice", values=["x", "y"]),
}


def test_a_grid_has_every_combination_once():
    points, weights = points_of(GridMethod(kind="grid", levels={"a": 3}), DRAWN)
    found = {tuple(values_at(DRAWN, p).values()) for p in points}
    assert found == {(a, b, c) for a in (0.0, 0.5, 1.0) for b in (1, 2, 3) for c in "xy"}
    assert len(points) == 18
    assert (weights == 1).all()


@pytest.mark.parametrize("kind", ["random", "latin_hypercube", "sobol", "halton"])
def test_the_same_seed_gives_the_same_points(kind):
    one, again = (points_of(SpreadMethod(kind=kind, count=10, seed=4), DRAWN)[0] for _ in range(2))
    other, _ = points_of(SpreadMethod(kind=kind, count=10, seed=5), DRAWN)
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert one.shape == (10, 3)


@pytest.mark.parametrize("kind", ["sobol", "halton", "random"])
def test_more_points_extend_the_earlier_ones(kind):
    few, many = (points_of(SpreadMethod(kind=kind, count=n), DRAWN)[0] for n in (6, 20))
    np.testing.assert_array_equal(many[:6], few)


def test_a_latin_hypercube_has_one_point_in_every_slice():
    points, _ = points_of(SpreadMethod(kind="latin_hypercube", count=20), DRAWN)
    for column in points.T:
        assert sorted((column * 20).astype(int)) == list(range(20))


def test_importance_weights_undo_the_sampling_bias():
    """The probability of a corner is found from points drawn near it."""
    drawn = {"a": FloatRange(low=0, high=1), "b": FloatRange(low=0, high=1)}
    bumps = {"a": ImportanceBump(mean=0.98, std=0.05), "b": ImportanceBump(mean=0.98, std=0.05)}
    method = ImportanceMethod(kind="importance", count=20_000, towards=bumps)
    points, weights = points_of(method, drawn)
    inside = (points > 0.95).all(axis=1)
    assert inside.mean() > 0.1
    assert (weights * inside).mean() == pytest.approx(0.05**2, rel=0.1)
    assert weights.mean() == pytest.approx(1.0, rel=0.1)
    assert weights.max() <= 10.0 + 1e-9


def test_files_may_leave_plain_kinds_out(tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text(
        "case: {name: c, scene: tiny, reset: {agents: {drivers: {car_blue: {kind: hard_brake}}}}}\n"
        "parameters:\n"
        "  gap: {path: agents.drivers.car_blue.gap, low: 5, high: 20}\n"
        "  half: {expression: gap / 2}\n"
        "method: halton\n"
    )
    sweep = load_sweep(path)
    assert sweep.method.kind == "halton"
    assert set(sweep.parameters) == {"gap", "half"}
    assert set(load_space(path).parameters) == {"gap", "half"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "no mapping"),
        ("case: [", "is not a valid sweep"),
        ("a: &x [1]\nb: *x", "aliases"),
        ("case: {name: c, scene: tiny}\nparameters: {}", "parameters"),
        ("case: {name: c, scene: tiny}\nparameters: gap", "parameters"),
        ("case: {name: c, scenario: s}\nparameters: {x: {low: 0, high: 1}}", "names a scene"),
        ("!!python/object/apply:os.system ['true']", "is not a valid sweep"),
    ],
)
def test_invalid_sweep_files_are_refused_with_a_reason(tmp_path, text, message):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    with pytest.raises(CommandError, match=message):
        load_sweep(path)


def test_an_unknown_space_is_refused_with_the_known_ones():
    with pytest.raises(CommandError, match="no space 'nothing'"):
        load_space("nothing")
