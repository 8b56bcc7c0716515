"""Bodies of a simulation against theory, as ``real2sim validate`` has them."""

from __future__ import annotations

import pytest

from real2sim_server.simulation.experiments.crash_tests import THEORY

SLOW = {"thin_post"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in THEORY]
)
def test_theory_is_met(name):
    for check in THEORY[name]("cpu"):
        assert check.passed, check
