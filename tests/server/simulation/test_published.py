"""The vehicle preset against published crash figures."""

from __future__ import annotations

import pytest

from real2sim_server.simulation.experiments.published import PUBLISHED


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures_are_met(name):
    for check in PUBLISHED[name]():
        assert check.passed, check
