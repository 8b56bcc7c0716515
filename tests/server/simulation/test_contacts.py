"""What contacts say about support and impact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.edit import ScenarioState
from real2sim_server.physics import Plane
from real2sim_server.scene import SceneObject
from real2sim_server.simulation.rollout import SimulateOptions, simulate
from real2sim_server.simulation.simulator import ContactLog
from real2sim_server.simulation.structure import ObjectPhysics
from tests.server.conftest import box_cloud, make_tiny_scene, standing

MASS, GRAVITY, DT = 1000.0, np.array([0.0, 0.0, -9.81]), 0.01


def recorded(steps: int, *struck: tuple[int, np.ndarray]):
    """A car that stands for a number of steps and is struck in some, by the ground alone."""
    log = ContactLog()
    for step in range(steps):
        carried = -MASS * GRAVITY * DT
        extra = sum((np.asarray(j, float) for k, j in struck if k == step), np.zeros(3))
        log.add("car", "ground", carried + extra, 0.0, step * DT)
    return log.records({"car": MASS}, GRAVITY)[0]


def test_carrying_a_weight_is_not_an_impact():
    record = recorded(200)
    assert record.delta_v == pytest.approx(9.81 * 2.0)
    assert record.impact_delta_v < 0.1 + 1e-9


@pytest.mark.parametrize("impulse", [(0.0, 0.0, 5000.0), (3000.0, 4000.0, 0.0)])
def test_an_impact_counts_in_full_on_top_of_the_weight(impulse):
    assert recorded(200, (50, np.array(impulse))).impact_delta_v == pytest.approx(5.0, abs=0.1)


def test_sleep_between_contacts_needs_no_impulse():
    log, fall = ContactLog(), np.array([0.0, 0.0, 4.5 * MASS])
    for step in range(500):
        carried = -MASS * GRAVITY * DT
        if step in (0, *range(400, 500)):
            log.add("car", "ground", carried + fall * (step == 0), 0.0, step * DT)
        log.add_sleep({"car"}, step * DT, DT)
    [record] = log.records({"car": MASS}, GRAVITY)
    assert record.impact_delta_v == pytest.approx(4.5, abs=0.1)


def test_equal_falls_give_equal_impacts_whatever_falls_nearby():
    """A landed block sleeps; its support is checked again when the other one lands."""
    size, heights = (0.8, 0.6, 0.6), {"low": 1.05, "low_too": 1.05, "high": 4.0}
    objects = {
        name: SceneObject(
            name, "box", size, box_cloud(400, size, (0.9, 0.1, 0.1), seed=5),
            standing(4.0 + 3 * k, 0.0, size[2] / 2 + height),
        )
        for k, (name, height) in enumerate(heights.items())
    }  # fmt: skip
    scene = replace(make_tiny_scene(), objects=objects)
    options = SimulateOptions(
        objects=dict.fromkeys(heights, ObjectPhysics()), colliders=[Plane(name="ground")], road=(),
        duration=3.0,
    )  # fmt: skip
    result = simulate(scene, ScenarioState.of(scene), options)
    found = {c.object_id: c.impact_delta_v for c in result.contacts if c.other == "ground"}
    speeds = {name: np.sqrt(2 * 9.81 * height) for name, height in heights.items()}
    assert found == pytest.approx(speeds, rel=0.06)


def test_without_gravity_every_impulse_is_an_impact():
    log = ContactLog()
    log.add("car", "wall", np.array([0.0, 0.0, 7.0 * MASS]), 0.0, 0.0)
    assert log.records({"car": MASS}, np.zeros(3))[0].impact_delta_v == pytest.approx(7.0)
