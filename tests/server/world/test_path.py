from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_server.geometry import multiply_quaternions, yaw_quaternion
from real2sim_server.scene import Trajectory
from real2sim_server.world import LoggedPath
from real2sim_server.world.path import command_ahead, route_ahead, strip_ahead


def along(xyz: list[tuple[float, float, float]], quaternions: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(xyz)) * 100_000, np.array(xyz), quaternions)


def circle(radius: float, angle: float) -> Trajectory:
    yaw = np.linspace(0, angle, 400)
    side = np.sign(radius)
    x, y = abs(radius) * np.sin(yaw), radius * (1 - np.cos(yaw))
    return along(np.stack([x, y, 0 * x], axis=1), yaw_quaternion(side * yaw))


def slope(*, pitch: float, roll: float) -> Trajectory:
    """East along a plane that rises to the east by ``pitch`` and to the south by ``roll``."""
    nose_up = np.array([math.cos(pitch / 2), 0, -math.sin(pitch / 2), 0])
    banked = np.array([math.cos(roll / 2), math.sin(roll / 2), 0, 0])
    attitude = multiply_quaternions(nose_up, banked)
    way = np.arange(30.0)
    positions = np.stack([way * math.cos(pitch), 0 * way, way * math.sin(pitch)], axis=1)
    return along(positions, np.tile(attitude, (30, 1)))


@settings(deadline=None)
@given(s=st.floats(0.5, 28), offset=st.floats(-8, 8))
def test_nearest_returns_arc_length_and_signed_offset(s, offset):
    path = LoggedPath(circle(20.0, 1.5))
    angle = s / 20
    x, y = (20 - offset) * math.sin(angle), 20 - (20 - offset) * math.cos(angle)
    found = path.nearest(x, y)

    assert found.s == pytest.approx(s, abs=0.05)
    assert found.offset == pytest.approx(offset, abs=0.01)
    assert found.yaw == pytest.approx(angle, abs=0.01)


@pytest.mark.parametrize("x", [-30.0, 45.0])
def test_a_path_extends_straight_beyond_its_ends(x):
    path = LoggedPath(along([(k, 0.0, 0.0) for k in range(21)], yaw_quaternion(np.zeros(21))))
    near = path.nearest(x, 1.5)
    assert near.offset == pytest.approx(1.5)
    assert near.s == pytest.approx(min(max(x, 0.0), 20.0))


def test_a_path_that_crosses_itself_is_followed_in_order():
    eight = np.linspace(0, 2 * np.pi, 400)
    x, y = 40 * np.sin(eight), 40 * np.sin(eight) * np.cos(eight)
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    path = LoggedPath(along(np.stack([x, y, 0 * x], axis=1), yaw_quaternion(yaw)))
    half = path.length / 2

    assert path.nearest(0.1, 0.0, near_s=half - 5).s == pytest.approx(half, abs=1)
    assert path.nearest(0.1, 0.0, near_s=2.0).s == pytest.approx(0, abs=1)


def test_nearest_finds_a_vehicle_far_from_the_hint():
    path = LoggedPath(circle(100.0, 3.0))

    assert path.nearest(100.0, 100.0, near_s=0.0).s == pytest.approx(50 * np.pi, abs=0.1)


def test_a_vehicle_that_never_moved_has_a_path_along_its_heading():
    path = LoggedPath(along([(1, 2, 3)] * 5, yaw_quaternion(np.full(5, np.pi / 2))))

    assert path.length == pytest.approx(1.0)
    assert path.nearest(0.5, 2.5).offset == pytest.approx(0.5)


def test_noise_of_a_standing_vehicle_adds_no_length():
    noise = np.random.default_rng(0).normal(scale=0.005, size=(100, 3))
    path = LoggedPath(along(noise, np.tile([1.0, 0, 0, 0], (100, 1))))

    assert path.length == pytest.approx(1.0)


def test_the_route_lies_on_the_recorded_path():
    path = LoggedPath(circle(30.0, 2.5))
    s, yaw = 15.0, 0.5
    x, y = 30 * math.sin(yaw), 30 * (1 - math.cos(yaw))
    route = route_ahead(path, s, x, y, yaw)

    assert route.shape == (20, 2)
    turns = 2.0 * np.arange(1, 21) / 30
    expected = np.stack([30 * np.sin(turns), 30 * (1 - np.cos(turns))], axis=1)
    np.testing.assert_allclose(route, expected, atol=0.02)


def test_the_route_continues_straight_beyond_the_recording():
    path = LoggedPath(circle(30.0, np.pi / 2))
    route = route_ahead(path, path.length, 30.0, 30.0, np.pi / 2)

    np.testing.assert_allclose(route[:, 0], 2.0 * np.arange(1, 21), atol=1e-6)
    np.testing.assert_allclose(route[:, 1], 0, atol=1e-6)


@pytest.mark.parametrize(("radius", "command"), [(20, "left"), (-20, "right"), (200, "straight")])
def test_the_command_matches_the_turn_of_the_path(radius, command):
    assert command_ahead(LoggedPath(circle(float(radius), 1.5)), 2.0) == command


def test_wrapped_headings_are_not_a_turn():
    yaw = np.pi - 0.05 + np.linspace(0, 0.1, 200)
    x = -np.arange(200.0)
    path = LoggedPath(along(np.stack([x, 0 * x, 0 * x], axis=1), yaw_quaternion(yaw)))

    assert command_ahead(path, 90.0) == "straight"


@pytest.mark.parametrize("offset", [0.0, 0.7])
@pytest.mark.parametrize("s", [-3.0, 0.0, 11.3, 60.0])
def test_the_strip_ahead_equals_the_path_exactly(s, offset):
    path = LoggedPath(circle(50, 1.5))
    found = strip_ahead(path.knots, s, offset)
    for i, (x, y, yaw) in enumerate(found.tolist()):
        px, py, _, heading = path.at(s + i)
        expected = (px - offset * math.sin(heading), py + offset * math.cos(heading), heading)
        assert (x, y, yaw) == expected
