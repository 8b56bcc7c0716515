"""Riding: what turns, turns by the distance; hands and feet are where they belong."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.body import body_model, joint_transforms
from real2sim_server.body.bicycle import GEAR, TYRE, plan_ride
from real2sim_server.body.model import JOINTS, joint_positions

MODEL = body_model()
T = np.arange(0.0, 4.0, 0.1)
BUILDS = ["man", "tall_woman", "small_girl", "heavy_man"]


def _ride(build: str, speed: float = 4.0, turn: float = 0.0):
    yaw = turn * T
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    places = np.concatenate([[[0.0, 0.0]], np.cumsum(heading[:-1] * speed * 0.1, axis=0)])
    return plan_ride(MODEL.shaped(build), T, np.column_stack([places, 0 * T]), yaw)


@pytest.mark.parametrize("build", BUILDS)
def test_balls_of_the_feet_stay_over_the_pedals(build):
    ride = _ride(build)
    times = np.linspace(0, 3.9, 60)
    joints = joint_positions(ride.body, joint_transforms(ride.body, ride.pose(times)))
    for index, side in enumerate("lr"):
        pedal = ride.bicycle.pedal(ride.at(times)[0], index)
        away = joints[:, JOINTS.index(f"ball_{side}")] - pedal
        assert np.abs(away[:, :2]).max() < 1e-6
        assert np.ptp(away[:, 2]) < 1e-6


@pytest.mark.parametrize("build", BUILDS)
def test_hands_hold_the_grips(build):
    ride = _ride(build)
    joints = joint_positions(ride.body, joint_transforms(ride.body, ride.pose([1.0, 2.0])))
    for side, sign in (("l", 1), ("r", -1)):
        wrist = joints[:, JOINTS.index(f"hand_{side}")]
        grip = ride.bicycle.scale * np.array([0.2, 0.28 * sign, 1.03])
        assert np.linalg.norm(wrist - grip, axis=1).max() < 0.1


def test_wheels_roll_without_slipping():
    """The lowest point of a tyre stands still: it moves back as fast as the bicycle moves on."""
    ride = _ride("man")
    near = ride.bicycle_vertices([1.0, 1.001])
    tyre = np.unique(ride.bicycle.triangles[ride.bicycle.surfaces == TYRE])
    low = tyre[near[0, tyre, 2].argmin()]
    assert (near[1, low, 0] - near[0, low, 0]) / 0.001 == pytest.approx(-4.0, rel=0.05)
    assert near[:, tyre, 2].min() == pytest.approx(0.0, abs=0.004)


def test_cranks_turn_by_the_gear():
    bicycle = _ride("man").bicycle
    once = 2 * np.pi * bicycle.wheel_radius * GEAR
    assert bicycle.crank_angle(once) == pytest.approx(2 * np.pi)
    np.testing.assert_allclose(bicycle.pedal([once], 0), bicycle.pedal([0.0], 0), atol=1e-12)


def test_left_and_right_pedal_are_opposite():
    bicycle = _ride("man").bicycle
    middle = (bicycle.pedal([0.7], 0) + bicycle.pedal([0.7], 1)) / 2
    np.testing.assert_allclose(middle, bicycle.scale * np.array([[-0.08, 0.0, 0.29]]), atol=1e-9)


def test_riders_lean_into_bends():
    """tan(roll) = v^2 / (g r)."""
    left = _ride("man", speed=5.0, turn=0.5)
    _, roll = left.at([2.0])
    assert roll[0] == pytest.approx(np.arctan(5.0 * 0.5 / 9.81), rel=0.02)
    joints = joint_positions(left.body, joint_transforms(left.body, left.pose([2.0])))
    assert joints[0, JOINTS.index("head"), 1] > 0.2


def test_legs_are_never_quite_straight():
    ride = _ride("woman")
    joints = joint_positions(
        ride.body, joint_transforms(ride.body, ride.pose(np.linspace(0, 3, 60)))
    )
    hip, knee, ankle = (joints[:, JOINTS.index(f"{n}_l")] for n in ("thigh", "calf", "foot"))
    whole = np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
    straight = np.linalg.norm(ankle - hip, axis=1) / whole
    assert 0.94 < straight.max() < 0.97
