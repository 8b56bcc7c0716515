from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from real2sim_proto.episode import EgoSpec
from real2sim_server.world.driving import Command
from real2sim_server.world.ego_motion import (
    Motion,
    advance_motion,
    constant_law,
    logged_motion,
    teleported,
)

SPEC = EgoSpec(actuators={"steering_lag": 0.0, "drive_lag": 0.0})


def hold(acceleration: float = 0.0, steering: float = 0.0):
    return constant_law(Command(acceleration, steering))


def drive_for(motion: Motion, seconds: float, *, dt_us: int = 100_000, **command: float) -> Motion:
    for _ in range(round(seconds * 1e6) // dt_us):
        motion = advance_motion(motion, hold(**command), SPEC, dt_us)
    return motion


@pytest.mark.parametrize("steering", [0.3, -0.1, 0.001])
def test_constant_steering_drives_the_bicycle_circle(steering):
    radius = SPEC.wheelbase / math.tan(steering)
    start = Motion(0.0, 0.0, 0.0, speed=7.0, steering=steering)
    motion = start
    for _ in range(50):
        motion = advance_motion(motion, hold(steering=steering), SPEC, 100_000)
        assert math.hypot(motion.x, motion.y - radius) == pytest.approx(abs(radius), abs=1e-9)
    assert motion.yaw == pytest.approx(5 * 7.0 / radius)
    assert motion.yaw_rate == pytest.approx(7.0 / radius)


@pytest.mark.parametrize("dt_us", [100_000, 33_333, 7_000])
def test_braking_distance_is_speed_squared_over_twice_the_deceleration(dt_us):
    motion = Motion(0.0, 0.0, 0.0, speed=13.0)
    motion = drive_for(motion, 4, dt_us=dt_us, acceleration=-5.0)

    assert motion.speed == 0.0
    assert motion.x == pytest.approx(13.0**2 / (2 * 5.0), abs=1e-9)


def test_braking_never_reverses():
    stopped = drive_for(Motion(0.0, 0.0, 0.0, speed=1.0), 3, acceleration=-8.0)

    assert drive_for(stopped, 1, acceleration=-8.0).x == stopped.x


def test_distance_under_acceleration_is_half_a_t_squared():
    motion = drive_for(Motion(0.0, 0.0, 0.0), 3, acceleration=2.0)

    assert motion.speed == pytest.approx(6.0)
    assert motion.x == pytest.approx(9.0)
    assert motion.acceleration == pytest.approx(2.0)


def test_acceleration_braking_and_speed_are_limited():
    start = Motion(0.0, 0.0, 0.0, speed=59.0)

    assert drive_for(start, 1, acceleration=100).speed == SPEC.max_speed
    assert drive_for(start, 1, acceleration=-100).speed == pytest.approx(59.0 - SPEC.max_braking)
    slow = Motion(0.0, 0.0, 0.0)
    assert drive_for(slow, 1, acceleration=100).speed == pytest.approx(SPEC.max_acceleration)


def test_steering_rate_and_angle_are_limited():
    motion = Motion(0.0, 0.0, 0.0, speed=5.0)

    assert drive_for(motion, 0.5, steering=1.5).steering == pytest.approx(0.4)
    assert drive_for(motion, 2, steering=1.5).steering == SPEC.max_steer
    assert drive_for(motion, 2, steering=-1.5).steering == -SPEC.max_steer


@given(
    speed=st.floats(0, 40),
    acceleration=st.floats(-10, 6),
    steering=st.floats(-0.7, 0.7),
    yaw=st.floats(-4, 4),
)
def test_motion_hardly_depends_on_the_time_step(speed, acceleration, steering, yaw):
    start = Motion(3.0, -2.0, yaw, speed=speed)
    command = {"acceleration": acceleration, "steering": steering}
    coarse = drive_for(start, 1, dt_us=100_000, **command)
    fine = drive_for(start, 1, dt_us=2_000, **command)

    assert coarse.speed == pytest.approx(fine.speed, abs=1e-9)
    assert math.hypot(coarse.x - fine.x, coarse.y - fine.y) < 0.01


@given(x=st.floats(-50, 50), y=st.floats(-50, 50), turn=st.floats(-3, 3))
def test_motion_is_invariant_to_the_initial_pose(x, y, turn):
    command = {"acceleration": 1.0, "steering": 0.2}
    here = drive_for(Motion(0.0, 0.0, 0.0, speed=6.0), 1, **command)
    there = drive_for(Motion(x, y, turn, speed=6.0), 1, **command)

    cos, sin = math.cos(turn), math.sin(turn)
    assert there.x == pytest.approx(x + cos * here.x - sin * here.y, abs=1e-9)
    assert there.y == pytest.approx(y + sin * here.x + cos * here.y, abs=1e-9)
    assert there.yaw == pytest.approx(turn + here.yaw)


def test_a_teleported_vehicle_has_the_velocities_of_its_displacement():
    radius, turn = 20.0, 0.05
    start = Motion(0.0, 0.0, 0.0, speed=5.0)
    pose = (radius * math.sin(turn), radius * (1 - math.cos(turn)), turn + math.tau)
    motion = teleported(start, pose, SPEC, 100_000)

    assert motion.speed == pytest.approx(radius * turn / 0.1)
    assert motion.acceleration == pytest.approx((10.0 - 5.0) / 0.1)
    assert motion.yaw_rate == pytest.approx(turn / 0.1)
    assert motion.steering == pytest.approx(math.atan(SPEC.wheelbase / radius))
    assert motion.yaw == pytest.approx(turn)


def test_logged_motion_has_the_speed_and_steering_of_the_log(make_scene):
    ego = make_scene().ego
    motion = logged_motion(ego, ego.start_us + 150_000, SPEC)

    assert (motion.x, motion.y, motion.yaw) == pytest.approx((1.5, 0, 0))
    assert motion.speed == pytest.approx(10.0)
    assert np.isclose(motion.steering, 0)
