"""What contacts say of support and impact."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.simulation.contacts import ContactLog

MASS, GRAVITY, DT = 1000.0, np.array([0.0, 0.0, -9.81]), 0.01


def recorded(steps: int, *struck: tuple[int, np.ndarray]):
    """A car that stands for so many steps and is struck in some, by the ground alone."""
    log = ContactLog()
    for step in range(steps):
        carried = -MASS * GRAVITY * DT
        extra = sum((np.asarray(j, float) for k, j in struck if k == step), np.zeros(3))
        log.add("car", "ground", carried + extra, 0.0, step * DT)
    return log.records({"car": MASS}, GRAVITY)[0]


def test_what_only_carries_a_weight_is_no_impact():
    record = recorded(200)
    assert record.delta_v == pytest.approx(9.81 * 2.0)
    assert record.impact_delta_v < 0.1 + 1e-9


@pytest.mark.parametrize("impulse", [(0.0, 0.0, 5000.0), (3000.0, 4000.0, 0.0)])
def test_an_impact_counts_whole_beside_the_weight(impulse):
    assert recorded(200, (50, np.array(impulse))).impact_delta_v == pytest.approx(5.0, abs=0.1)


def test_without_gravity_every_impulse_is_an_impact():
    log = ContactLog()
    log.add("car", "wall", np.array([0.0, 0.0, 7.0 * MASS]), 0.0, 0.0)
    assert log.records({"car": MASS}, np.zeros(3))[0].impact_delta_v == pytest.approx(7.0)
