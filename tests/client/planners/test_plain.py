"""The vectorized planners equal the reference implementation written point by point."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim.planners import FollowRoute, Idm, PidFollowRoute
from real2sim.planners.follow_route import Comfort, Path, Profile, delays_of_poses, speed_limits

from . import plain
from .road import agent, observation

TOLERANCE = 1e-9
"""For positions [m] and headings [rad], because the order of summation differs."""
DELAYS = delays_of_poses(speed=8.0, horizon=3.0, spacing=0.25)

bends = st.floats(-0.08, 0.08)
agents = st.lists(
    st.builds(
        agent,
        st.floats(-20.0, 60.0),
        st.floats(-8.0, 8.0),
        speed=st.floats(0.0, 12.0),
        yaw=st.floats(-math.pi, math.pi),
    ),
    max_size=5,
)


@st.composite
def scenes(draw):
    """An observation at a random pose near a curved route."""
    heading = np.cumsum(np.full(20, 2.0 * draw(bends)))
    steps = 2.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    start = [draw(st.floats(-3.0, 3.0)), draw(st.floats(-3.0, 3.0))]
    return observation(
        np.cumsum(np.concatenate([[start], steps]), axis=0),
        speed=draw(st.floats(-1.0, 15.0)),
        position=(draw(st.floats(-50.0, 50.0)), draw(st.floats(-50.0, 50.0)), 0.0),
        yaw=draw(st.floats(-math.pi, math.pi)),
        agents=draw(agents),
    )


@given(scenes())
@settings(max_examples=40, deadline=None)
def test_follow_route_matches_the_reference(obs):
    expected = plain.follow_route(obs, speed=8.0, delays=DELAYS)
    np.testing.assert_allclose(FollowRoute().plan(obs).poses, expected, rtol=0, atol=TOLERANCE)


@given(scenes())
@settings(max_examples=40, deadline=None)
def test_idm_matches_the_reference(obs):
    expected = plain.idm(obs, speed=8.0, delays=DELAYS)
    np.testing.assert_allclose(Idm().plan(obs).poses, expected, rtol=0, atol=TOLERANCE)


@given(scenes())
@settings(max_examples=40, deadline=None)
def test_speed_limits_match_the_reference(obs):
    arc, points = plain.path_of(obs.route)
    expected = plain.speed_limits(arc, points, 8.0, Comfort())
    found = speed_limits(Path.along(obs.route), cruise=8.0, comfort=Comfort())
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE)


def test_planners_stand_still_on_a_route_with_fewer_than_two_points():
    for route in (np.zeros((0, 2)), np.array([[3.0, 1.0]])):
        obs = observation(route, agents=[agent(5.0, 0.0)])
        np.testing.assert_allclose(
            FollowRoute().plan(obs).poses, plain.follow_route(obs, speed=8.0, delays=DELAYS)
        )
        assert PidFollowRoute().plan(obs).acceleration == 0.0


@given(st.floats(-2.0, 12.0))
def test_a_profile_is_linear_between_its_points_and_constant_beyond(where):
    arc, values = np.array([0.0, 1.0, 4.0, 10.0]), np.array([2.0, 5.0, -1.0, 0.5])
    assert Profile(arc, values).at(where) == np.interp(where, arc, values)
