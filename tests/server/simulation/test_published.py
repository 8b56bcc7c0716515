"""The vehicle preset against published crash figures."""

from __future__ import annotations

from dataclasses import replace

import pytest

from real2sim_server.simulation.experiments.published import (
    MALIBU_CRUSH,
    MALIBU_SPEED,
    PUBLISHED,
    BarrierTest,
    malibu_checks,
)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures_are_met(name):
    for check in PUBLISHED[name]("cpu"):
        assert check.passed, check


def test_a_crash_that_gains_energy_fails_its_check():
    test = BarrierTest(MALIBU_SPEED, MALIBU_CRUSH, restitution=0.013, energy_peak=1.0)
    assert all(check.passed for check in malibu_checks(test))
    gained = malibu_checks(replace(test, energy_peak=1.02))
    assert [check.name for check in gained if not check.passed] == ["largest energy over the first"]
