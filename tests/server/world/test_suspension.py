"""Pitch and roll of the ego's body."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_proto import decode
from real2sim_proto.episode import EgoSpec, ResetSpec
from real2sim_proto.plans import Control, PoseCommand
from real2sim_server.world.driving import GRAVITY, vehicle_parameters
from real2sim_server.world.driving.vehicle import axle_forces
from real2sim_server.world.ego_motion import LEVEL, BodyAttitude, Motion, sprung, tilted
from real2sim_server.world.replay import reset_payload, stored_spec

SPRUNG = EgoSpec(suspension={})
BRAKING = Motion(0, 0, 0, 20.0, acceleration=-4.0)
TURNING_LEFT = Motion(0, 0, 0, 10.0, yaw_rate=0.3)
STEADY = Motion(0, 0, 0, 10.0)


def after(motion: Motion, seconds: float, *, dt: float = 0.1, start: BodyAttitude = LEVEL):
    attitude = start
    for _ in range(round(seconds / dt)):
        attitude = sprung(attitude, motion, motion, dt, SPRUNG)
    return attitude


def test_dive_angle_is_load_transfer_over_spring_stiffness():
    # Load transfer m a h / L on springs m_axle (2 pi f)^2 at both axles, less 30 %.
    m, h, length, a = 1500.0, 0.55, 2.8, 4.0
    front = m * 0.56 * (2 * math.pi * 1.3) ** 2
    rear = m * 0.44 * (2 * math.pi * 1.5) ** 2
    transfer = m * a * h / length
    pitch = 0.7 * (transfer / front + transfer / rear) / length

    assert after(BRAKING, 5.0).pitch == pytest.approx(pitch, rel=1e-3)
    assert math.degrees(pitch) == pytest.approx(1.44 * a / GRAVITY, abs=0.02)


def test_a_left_turn_rolls_right_by_four_degrees_per_g():
    roll = after(TURNING_LEFT, 5.0).roll

    assert math.degrees(roll) == pytest.approx(3.9 * 3.0 / GRAVITY, rel=0.02)


def test_roll_and_pitch_are_symmetric():
    right, driving = TURNING_LEFT._replace(yaw_rate=-0.3), BRAKING._replace(acceleration=4.0)

    assert after(right, 0.4).roll == pytest.approx(-after(TURNING_LEFT, 0.4).roll)
    assert after(driving, 0.4).pitch == pytest.approx(-after(BRAKING, 0.4).pitch)


def test_the_body_levels_at_constant_velocity():
    tilted_body = BodyAttitude(0.03, 0.1, -0.05, 0.2)

    assert after(STEADY, 10.0, start=tilted_body) == pytest.approx((0.0,) * 4, abs=1e-9)


def test_pitch_overshoots_like_a_damped_oscillator():
    rest = after(BRAKING, 10.0).pitch
    highest = max(after(BRAKING, 0.01 * k, dt=0.01).pitch for k in range(1, 80))

    overshoot = math.exp(-math.pi * 0.3 / math.sqrt(1 - 0.3**2))
    assert highest / rest - 1 == pytest.approx(overshoot, abs=0.01)


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.5, 1.0])
def test_attitude_does_not_depend_on_the_time_step(dt):
    assert after(BRAKING, 1.0, dt=dt) == pytest.approx(after(BRAKING, 1.0), abs=1e-12)


def test_tilt_is_limited_by_tyre_friction():
    impact = BRAKING._replace(acceleration=-200.0)
    most = BRAKING._replace(acceleration=-0.9 * GRAVITY)

    assert after(impact, 1.0) == after(most, 1.0)


def test_tyres_carry_the_load_transfer_of_the_springs():
    # The force of sliding tyres is friction times load, so it shows the transfer.
    vehicle = vehicle_parameters(EgoSpec(dynamics="dynamic_bicycle"))
    free, braked = (axle_forces(vehicle, (20.0, 0.0, 0.0), 0.5, a)[0] for a in (0.0, -4.0))
    grip = math.sqrt(0.9**2 - (4.0 / GRAVITY) ** 2)

    assert braked / grip - free / 0.9 == pytest.approx(1500.0 * 4.0 * 0.55 / 2.8)


def test_the_rear_rises_while_the_front_dives():
    T_world_body = tilted(np.eye(4), BodyAttitude(pitch=0.02), SPRUNG)
    rear, front = T_world_body @ [0, 0, 0, 1], T_world_body @ [2.8, 0, 0, 1]

    assert 0.0 < rear[2] < 0.04
    assert -0.04 < front[2] < 0.0
    np.testing.assert_allclose(T_world_body[:3, :3] @ T_world_body[:3, :3].T, np.eye(3), atol=1e-15)


def driven(make_world, **ego):
    world = make_world(spec={"action": "control", "ego": ego})
    for _ in range(10):
        world.step(Control(acceleration=-4.0, steering=0.05))
    return world


def test_suspension_affects_cameras_but_not_motion(make_world):
    rigid, sprung_world = driven(make_world, suspension=None), driven(make_world)

    assert rigid.T_world_body is rigid.T_world_vehicle
    np.testing.assert_array_equal(sprung_world.T_world_vehicle, rigid.T_world_vehicle)
    assert sprung_world.motion == rigid.motion
    ahead = sprung_world.T_world_body[:3, 0]
    assert math.radians(0.3) < -math.asin(ahead[2]) < math.radians(1.0)


def test_the_ego_quaternion_includes_the_tilt(make_world):
    world = driven(make_world, suspension={})
    w, x, y, z = world.observe().ego_fields()["quaternion"]

    assert 2 * (x * z - w * y) == pytest.approx(world.T_world_body[2, 0])
    assert 2 * (y * z + w * x) == pytest.approx(world.T_world_body[2, 1])


def test_a_fork_tilts_identically(make_world):
    world = driven(make_world, suspension={})
    copy = world.fork()
    for w in (world, copy):
        w.step(Control(acceleration=0.0, steering=0.0))

    np.testing.assert_array_equal(world.T_world_body, copy.T_world_body)


def test_a_teleported_ego_is_level(make_world):
    world = make_world(spec={"action": "pose", "ego": {"suspension": {}}})
    world.step(PoseCommand(x=30.0, y=0.0, yaw=0.0))

    assert world.T_world_body is world.T_world_vehicle


def test_an_old_log_has_no_suspension():
    fields = decode(reset_payload(ResetSpec(ego=SPRUNG)))["spec"]
    assert stored_spec(fields).ego.suspension == SPRUNG.suspension
    del fields["ego"]["suspension"]
    assert stored_spec(fields).ego.suspension is None
