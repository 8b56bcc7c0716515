from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim.planners import PidFollowRoute
from real2sim.planners.pid import Gains, Pid

from .road import STRAIGHT, agent, observation

LEFT, RIGHT = (np.add(STRAIGHT, [0.0, side]) for side in (1.0, -1.0))


def test_a_pid_adds_proportional_integral_and_derivative_terms():
    pid = Pid(Gains(2.0, 0.5, 0.1), low=-100, high=100)
    assert pid(3.0, 0.0) == pytest.approx(6.0)
    assert pid(4.0, 0.5) == pytest.approx(8.0 + 1.0 + 0.2)


def test_the_integral_does_not_wind_up_while_the_output_saturates():
    pid = Pid(Gains(1.0, 1.0), low=-1.0, high=1.0)
    for _ in range(100):
        assert pid(50.0, 0.1) == 1.0
    assert pid(-0.5, 0.1) == pytest.approx(-0.55)


def drive(planner, *, aside: float, seconds: float = 15.0) -> list[tuple[float, float, float]]:
    """(y, yaw, speed) of a kinematic bicycle controlled by the planner along the x axis."""
    x, y, yaw, speed, dt = 0.0, aside, 0.0, 5.0, 0.1
    states = []
    for k in range(int(seconds / dt)):
        along = x + np.arange(2.0, 42.0, 2.0)
        c, s = math.cos(yaw), math.sin(yaw)
        route = np.stack([along - x, np.full(20, -y)], axis=1) @ np.array([[c, -s], [s, c]])
        obs = observation(route, speed=speed, yaw=yaw, t_us=round(k * dt * 1e6))
        plan = planner.plan(obs)
        x, y = x + speed * c * dt, y + speed * s * dt
        yaw += speed / 2.8 * math.tan(plan.steering) * dt
        speed = max(speed + plan.acceleration * dt, 0.0)
        states.append((y, yaw, speed))
    return states


def test_speed_and_route_are_reached_and_held():
    last = drive(PidFollowRoute(speed=8.0), aside=1.0)[-20:]
    assert all(abs(y) < 0.05 and abs(yaw) < 0.01 for y, yaw, _ in last)
    assert all(speed == pytest.approx(8.0, abs=0.15) for _, _, speed in last)


def test_steering_is_towards_the_route():
    assert PidFollowRoute().plan(observation(LEFT, speed=5.0)).steering > 0.0
    assert PidFollowRoute().plan(observation(RIGHT, speed=5.0)).steering < 0.0


def test_agents_on_the_route_are_ignored():
    free = PidFollowRoute().plan(observation(STRAIGHT, speed=8.0))
    blocked = PidFollowRoute().plan(observation(STRAIGHT, speed=8.0, agents=[agent(8.0, 0.0)]))
    assert blocked == free


def test_reset_clears_the_state_of_the_last_episode():
    planner, obs = PidFollowRoute(), observation(LEFT, speed=5.0)
    first = planner.plan(obs)
    planner.plan(observation(STRAIGHT, speed=2.0, t_us=2_000_000))
    planner.reset(obs)
    assert planner.plan(obs) == first
