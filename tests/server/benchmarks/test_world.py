from __future__ import annotations

import json

import pytest

from real2sim_bench import world
from real2sim_server.scene.io import read_packed


@pytest.mark.slow
def test_a_run_measures_every_case_compiled_and_uncompiled(capsys):
    figures = world.run()

    assert json.loads(json.dumps(figures)) == figures
    assert figures.keys() == world.CASES.keys()
    assert all(case["uncompiled_over_compiled"] > 1 for case in figures.values())
    assert "idm traffic" in capsys.readouterr().out


def test_step_times_are_consistent_with_their_halves():
    case = world._case(read_packed(world.SHIPPED), {"horizon": 12}, 2)

    assert case["steps"] == 24
    assert case["step"]["max"] <= sum(case[half]["max"] for half in world.HALVES)
    assert case["step"]["p50"] >= max(case[half]["p50"] for half in world.HALVES)
