"""The soak bench: correct answers for every kind of planner, and memory growth."""

from __future__ import annotations

import json

import pytest

from real2sim_bench import soak
from real2sim_bench.soak import BEHAVIOURS

pytestmark = pytest.mark.network


def test_16_sessions_include_every_misbehaviour_and_half_behave_properly():
    behaviours = soak.behaviours(16)
    assert set(behaviours) == set(BEHAVIOURS)
    assert behaviours.count("proper") == 8


def test_memory_growth_is_measured_after_warm_up():
    memory = soak.Memory([0, 1, 2, 3, 4, 5], [10, 300, 400, 400, 400, 460])
    figures = memory.figures(2.0)
    assert (figures["start_mb"], figures["warm_mb"], figures["end_mb"]) == (10, 400, 460)
    assert figures["slope_mb_per_minute"] > 0


@pytest.mark.slow
def test_a_short_soak_answers_every_step(capsys):
    figures = soak.run(soak.SoakOptions(sessions=16, minutes=0.5, rate_hz=5.0))
    assert json.loads(json.dumps(figures)) == figures
    assert figures["failures"] == []
    assert all(row["steps"] > 0 for row in figures["by_habit"].values())
    assert sum(row["misdeeds"] for row in figures["by_habit"].values()) >= len(BEHAVIOURS) - 1
    assert "steps answered" in capsys.readouterr().out
