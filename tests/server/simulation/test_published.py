"""The vehicle preset compared with published crash figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.physics.body import box_particles
from real2sim_server.simulation.experiments.crash_tests import (
    MALIBU_CRUSH,
    MALIBU_DYNAMIC,
    MALIBU_PEAK,
    MALIBU_SPEED,
    MALIBU_TIME,
    PUBLISHED,
    CrashPulse,
    barrier_test,
    malibu_checks,
)
from real2sim_server.simulation.structure import STRUCTURES, vehicle_structure

MALIBU = CrashPulse(
    speed=MALIBU_SPEED,
    dynamic_crush=MALIBU_DYNAMIC,
    residual_crush=MALIBU_CRUSH,
    peak=MALIBU_PEAK,
    time_to_peak=MALIBU_TIME,
    duration=0.1,
    delta_v=MALIBU_SPEED,
    restitution=0.013,
    energy_peak=1.0,
)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures_are_met(name):
    for check in PUBLISHED[name]("cpu"):
        assert check.passed, check


def test_the_front_crushes_over_time_as_in_the_barrier_test():
    # The pulse alone: straightening afterwards would take half a second more.
    checks = malibu_checks(barrier_test(MALIBU_SPEED, "cpu", duration=0.13))
    assert [c.name for c in checks[:3] if not c.passed] == []


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"dynamic_crush": 0.22}, "Malibu dynamic crush"),
        ({"peak": 61.0}, "Malibu peak deceleration"),
        ({"time_to_peak": 0.03}, "Malibu time to the peak"),
        ({"residual_crush": 0.6}, "Malibu residual crush"),
        ({"energy_peak": 1.02}, "largest energy over the first"),
    ],
)
def test_a_crash_unlike_the_published_one_fails_the_check(changes, name):
    assert all(check.passed for check in malibu_checks(MALIBU))
    wrong = malibu_checks(replace(MALIBU, **changes))
    assert [check.name for check in wrong if not check.passed] == [name]


@pytest.mark.parametrize("category", STRUCTURES)
def test_each_side_of_a_vehicle_is_weaker_than_its_core(category):
    block = box_particles((6.0, 2.0, 1.6), spacing=0.2, density=1.0).with_mass(1800.0)
    materials, regions, particles = vehicle_structure(category, block, spacing=0.2)

    def young(x: float, y: float, z: float) -> float:
        place = np.linalg.norm(block.positions - (x, y, z), axis=1).argmin()
        return materials[regions[place]].young

    core = young(0, 0, -0.5)
    for place in ((2.9, 0, -0.5), (-2.9, 0, -0.5), (0, 0.9, -0.5), (0, -0.9, -0.5), (0, 0, 0.7)):
        assert young(*place) < core, place
    assert particles.mass == pytest.approx(1800.0)
    # The part above the beltline is light, so the centre of mass is below the middle.
    assert particles.centre_of_mass[2] < -0.1
