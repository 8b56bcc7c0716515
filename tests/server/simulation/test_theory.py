"""Simulated bodies compared with theory, as in ``real2sim validate``."""

from __future__ import annotations

import pytest

from real2sim_server.simulation.experiments.crash_tests import THEORY

SLOW = {"thin_post"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in THEORY]
)
def test_simulation_agrees_with_theory(name):
    for check in THEORY[name]("cpu"):
        assert check.passed, check
