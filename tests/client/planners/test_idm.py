from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim.planners import FollowRoute, Idm
from real2sim.planners.idm import Follower

from .road import STRAIGHT, agent, observation


def distances(plan) -> np.ndarray:
    return np.array([pose[0] for pose in plan.poses])


def test_the_free_road_acceleration_matches_the_model():
    follower = Follower(acceleration=1.5)
    assert follower.answer(0.0, 10.0, math.inf, 0.0) == pytest.approx(1.5)
    assert follower.answer(10.0, 10.0, math.inf, 0.0) == pytest.approx(0.0)
    assert follower.answer(5.0, 10.0, math.inf, 0.0) == pytest.approx(1.5 * (1 - 0.5**4))


def test_the_acceleration_is_zero_at_the_equilibrium_gap():
    follower, speed, desired = Follower(), 6.0, 10.0
    # v = v_leader: s = (s0 + v T) / sqrt(1 - (v / v0)^4), Treiber et al. 2000, eq. 4
    gap = (follower.gap + speed * follower.headway) / math.sqrt(1 - (speed / desired) ** 4)
    assert follower.answer(speed, desired, gap, 0.0) == pytest.approx(0.0, abs=1e-9)


def test_braking_is_limited_to_the_hardest_value():
    assert Follower(hardest=8.0).answer(15.0, 15.0, 5.0, 15.0) == -8.0


def test_the_desired_speed_is_reached_without_a_leader():
    plan = Idm(speed=8.0).plan(observation(STRAIGHT, speed=8.0))
    assert distances(plan)[-1] == pytest.approx(24.0, abs=0.3)


def test_the_plan_stops_before_a_stationary_car():
    ego_front, car_rear = 0.75 * 4.6, 30.0 - 2.3
    obs = observation(STRAIGHT, speed=8.0, agents=[agent(30.0, 0.0)])
    gone = distances(Idm(speed=8.0, horizon=12.0).plan(obs))
    assert gone[-1] < car_rear - ego_front - 1.0
    assert gone[-1] - gone[-5] < 0.5


def test_a_car_beside_the_route_is_ignored():
    free = Idm().plan(observation(STRAIGHT, speed=8.0))
    beside = Idm().plan(observation(STRAIGHT, speed=8.0, agents=[agent(20.0, 4.0)]))
    assert beside == free


def test_the_plan_is_longer_behind_a_moving_leader():
    stands = Idm().plan(observation(STRAIGHT, speed=8.0, agents=[agent(20.0, 0.0)]))
    drives = Idm().plan(observation(STRAIGHT, speed=8.0, agents=[agent(20.0, 0.0, speed=8.0)]))
    assert distances(drives)[-1] > distances(stands)[-1] + 5.0


@pytest.mark.parametrize("planner", [FollowRoute, Idm])
@pytest.mark.parametrize(
    "given", [{"speed": 0.0}, {"spacing": 0.0}, {"horizon": 0.2, "spacing": 0.25}]
)
def test_invalid_speed_or_spacing_is_refused(planner, given):
    with pytest.raises(ValueError, match="give a speed above 0 and a spacing"):
        planner(**given)
