from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim.planners import FollowRoute
from real2sim.planners.follow_route import Comfort, Path, brake_ahead, speed_limits

from .road import STRAIGHT, agent, observation


def speeds(plan) -> np.ndarray:
    """Mean speed between consecutive poses of a plan, starting at the vehicle [m/s]."""
    points = np.array([(0.0, 0.0), *[pose[:2] for pose in plan.poses]])
    times = np.array([1_000_000, *plan.times_us]) * 1e-6
    return np.linalg.norm(np.diff(points, axis=0), axis=1) / np.diff(times)


def arc(radius: float, *, quarter: float = 1.0) -> np.ndarray:
    angles = np.linspace(0.0, quarter * math.pi / 2, 60)
    return np.stack([radius * np.sin(angles), radius * (1 - np.cos(angles))], axis=1)


def test_a_straight_road_is_driven_at_cruising_speed_along_the_centre():
    plan = FollowRoute(speed=8.0).plan(observation(STRAIGHT, speed=8.0))
    poses = np.array(plan.poses)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(speeds(plan), 8.0, rtol=1e-3)


def test_plans_reach_three_seconds_ahead_in_the_vehicle_frame():
    plan = FollowRoute().plan(observation(STRAIGHT))
    assert plan.frame == "vehicle"
    assert plan.times_us[0] == 1_250_000
    assert plan.times_us[-1] == 4_000_000


def test_acceleration_from_standstill_is_the_comfort_limit():
    plan = FollowRoute(speed=20.0).plan(observation(STRAIGHT))
    travelled = np.array(plan.poses)[:, 0]
    seconds = np.array(plan.times_us) * 1e-6 - 1.0
    np.testing.assert_allclose(travelled, 0.5 * Comfort().acceleration * seconds**2, rtol=0.02)


def test_a_bend_is_driven_at_the_lateral_acceleration_limit():
    comfort = Comfort()
    path = Path.along(np.concatenate([arc(15.0), arc(15.0)[-1] + [[0.0, 20.0]]]))
    limits = speed_limits(path, cruise=20.0, comfort=comfort)
    inside = limits[(path.arc > 5) & (path.arc < 18)]
    np.testing.assert_allclose(inside, math.sqrt(comfort.lateral * 15.0), rtol=0.05)


def test_braking_happens_before_a_bend():
    bend = np.concatenate([STRAIGHT[:40], STRAIGHT[39] + arc(10.0)[1:]])
    path = Path.along(bend)
    limits = speed_limits(path, cruise=15.0, comfort=Comfort())
    decelerations = -np.diff(limits**2) / (2 * np.diff(path.arc))
    assert decelerations.max() <= Comfort().braking + 1e-6
    assert limits[path.arc < 5].min() > limits[(path.arc > 42) & (path.arc < 50)].max()


def test_yaw_follows_the_path_in_a_bend():
    poses = np.array(FollowRoute(speed=5.0).plan(observation(arc(20.0), speed=5.0)).poses)
    angle = np.arctan2(poses[:, 0], 20.0 - poses[:, 1])
    np.testing.assert_allclose(poses[2:, 2], angle[2:], atol=0.03)


def test_a_lateral_offset_is_corrected_smoothly():
    route = STRAIGHT - [0.0, 2.0]
    plan = FollowRoute(speed=8.0, horizon=5.0).plan(observation(route, speed=8.0))
    poses = np.array(plan.poses)
    assert abs(poses[-1, 1] + 2.0) < 0.05
    assert np.all(np.diff(poses[:, 1]) <= 1e-9)
    assert np.abs(poses[:, 2]).max() < 0.3


def test_route_points_behind_the_vehicle_are_ignored():
    route = STRAIGHT - [30.0, 0.0]
    plan = FollowRoute().plan(observation(route, speed=5.0))
    assert plan.poses[0][0] > 0.0


def test_the_plan_stops_at_the_end_of_the_route():
    plan = FollowRoute(horizon=10.0).plan(observation(STRAIGHT[:16], speed=6.0))
    assert 14.0 < plan.poses[-1][0] <= 15.0
    assert speeds(plan)[-1] < 0.3


@pytest.mark.parametrize("route", [np.zeros((0, 2)), np.zeros((1, 2))])
def test_without_a_route_the_vehicle_stands_still(route):
    plan = FollowRoute().plan(observation(route))
    np.testing.assert_allclose(np.array(plan.poses), 0.0, atol=1e-9)


def test_the_plan_stops_behind_a_stationary_vehicle():
    plan = FollowRoute(horizon=12.0).plan(
        observation(STRAIGHT, speed=8.0, agents=(agent(30.0, 0.3),))
    )
    bumper = plan.poses[-1][0] + 0.75 * 4.6
    rear = 30.0 - 2.3
    half_a_metre_of_path = 0.5
    assert rear - bumper == pytest.approx(Comfort().gap, abs=half_a_metre_of_path)


def test_the_plan_slows_down_behind_a_slower_vehicle():
    plan = FollowRoute(speed=12.0, horizon=8.0).plan(
        observation(STRAIGHT * 3, speed=10.0, agents=(agent(20.0, 0.0, speed=4.0),))
    )
    assert speeds(plan)[-1] < 6.0


@pytest.mark.parametrize(
    "other",
    [agent(30.0, 3.5), agent(-15.0, 0.0), agent(30.0, -4.0, speed=5.0)],
    ids=["next lane", "behind", "parked lane"],
)
def test_agents_outside_the_corridor_are_ignored(other):
    free = FollowRoute().plan(observation(STRAIGHT, speed=8.0))
    assert FollowRoute().plan(observation(STRAIGHT, speed=8.0, agents=(other,))) == free


def test_agent_positions_are_transformed_to_the_vehicle_frame():
    yaw, position = 2.0, (50.0, -20.0, 0.0)
    ahead = (position[0] + 20 * math.cos(yaw), position[1] + 20 * math.sin(yaw))
    turned = observation(
        STRAIGHT, speed=8.0, position=position, yaw=yaw, agents=(agent(*ahead, yaw=yaw),)
    )
    straight = observation(STRAIGHT, speed=8.0, agents=(agent(20.0, 0.0),))
    np.testing.assert_allclose(
        FollowRoute().plan(turned).poses, FollowRoute().plan(straight).poses, atol=1e-6
    )


@settings(deadline=None)
@given(
    steps=st.lists(st.tuples(st.floats(0.1, 5.0), st.floats(-0.5, 0.5)), min_size=1, max_size=60),
    start=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    speed=st.floats(0, 20),
)
def test_plans_are_finite_and_within_speed_limits_on_any_route(steps, start, speed):
    heading = np.cumsum([turn for _, turn in steps])
    lengths = np.array([length for length, _ in steps])
    moves = lengths[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    route = np.concatenate([[start], start + np.cumsum(moves, axis=0)])
    plan = FollowRoute(speed=8.0).plan(observation(route, speed=speed))
    assert np.isfinite(plan.poses).all()
    assert speeds(plan).max() <= max(speed, 8.0) * 1.5 + 1.0


@given(st.lists(st.floats(0, 30), min_size=2, max_size=40), st.floats(0.5, 9))
def test_braking_limits_are_the_highest_reachable_speeds(values, braking):
    arc_lengths = np.arange(len(values), dtype=float)
    limits = np.array(values)
    lowered = brake_ahead(arc_lengths, limits, braking=braking)
    assert np.all(lowered <= limits)
    reachable = np.sqrt(lowered[1:] ** 2 + 2 * braking)
    np.testing.assert_allclose(lowered[:-1], np.minimum(limits[:-1], reachable))


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"spacing": 0.0}, {"spacing": 4.0}])
def test_invalid_speed_or_spacing_is_refused(options):
    with pytest.raises(ValueError, match="give a speed above 0"):
        FollowRoute(**options)
