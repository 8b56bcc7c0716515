"""Vehicle models against textbook cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from real2sim_proto.episode import EgoSpec
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.world.controller import make_tracker
from real2sim_server.world.driving import GRAVITY, Command, vehicle_parameters
from real2sim_server.world.driving.trackers import lagging_gains
from real2sim_server.world.driving.vehicle import axle_forces, fiala
from real2sim_server.world.ego_motion import Motion, advance_motion, constant_law
from real2sim_server.world.plan import PlannedTrajectory, ReferenceTrajectory

IDEAL = {"steering_lag": 0.0, "drive_lag": 0.0}
NUPLAN = {"steering_lag": 0.05, "drive_lag": 0.2}
DELAYED = {"steering_delay_us": 100_000, "drive_delay_us": 100_000}
DYNAMIC = EgoSpec(dynamics="dynamic_bicycle")


def driven(spec: EgoSpec, motion: Motion, seconds: float, driver) -> list[Motion]:
    """Motions every 100 ms, with commands updated every 10 ms."""
    motions = []
    for _ in range(round(seconds * 10)):
        for _ in range(10):
            motion = advance_motion(motion, constant_law(driver(motion)), spec, 10_000)
        motions.append(motion)
    return motions


def cornering(spec: EgoSpec, speed: float, steering: float) -> Motion:
    """Steady-state cornering at constant speed."""

    def keep(motion: Motion) -> Command:
        return Command(5.0 * (speed - motion.speed), steering)

    return driven(spec, Motion(0, 0, 0, speed), 10.0, keep)[-1]


@pytest.mark.parametrize("speed", [5.0, 10.0, 20.0, 30.0])
def test_steady_cornering_needs_ackermann_plus_the_understeer_gradient(speed):
    # delta = L/R + K a_y (Gillespie 1992, eq. 6-15), at 2 m/s^2, where tyres are linear.
    radius = speed**2 / 2.0
    vehicle = vehicle_parameters(DYNAMIC)
    steering = vehicle.wheelbase / radius + vehicle.understeer * 2.0
    motion = cornering(DYNAMIC, speed, steering)

    assert motion.speed / motion.yaw_rate == pytest.approx(radius, rel=0.05)


def test_the_understeer_gradient_is_that_of_a_mid_size_car():
    degrees_per_g = math.degrees(vehicle_parameters(DYNAMIC).understeer * GRAVITY)

    assert degrees_per_g == pytest.approx(1.16, abs=0.01)


def test_equal_tyres_give_neutral_steering():
    spec = EgoSpec(
        dynamics="dynamic_bicycle", vehicle={"front_cornering": 12.0, "rear_cornering": 12.0}
    )
    slow, fast = (cornering(spec, v, 0.02) for v in (8.0, 16.0))

    assert slow.speed / slow.yaw_rate == pytest.approx(fast.speed / fast.yaw_rate, rel=0.03)


def test_an_oversteering_car_is_unstable_above_its_critical_speed():
    # v_crit = sqrt(-L/K) (Gillespie 1992, eq. 6-16).
    spec = EgoSpec(
        dynamics="dynamic_bicycle", vehicle={"front_cornering": 15.0, "rear_cornering": 9.0}
    )
    vehicle = vehicle_parameters(spec)
    critical = math.sqrt(-vehicle.wheelbase / vehicle.understeer)
    assert 15 < critical < 40

    def yaw_after(speed: float) -> float:
        nudged = Motion(0, 0, 0, speed, yaw_rate=0.01)
        straight = driven(spec, nudged, 4.0, lambda m: Command(5 * (speed - m.speed), 0.0))
        return abs(straight[-1].yaw_rate)

    assert yaw_after(0.8 * critical) < 0.002
    assert yaw_after(1.3 * critical) > 0.05


def test_lateral_acceleration_is_limited_by_friction():
    motion = cornering(DYNAMIC, 25.0, 0.3)

    assert abs(motion.speed * motion.yaw_rate) < 1.05 * 0.9 * GRAVITY


@pytest.mark.parametrize(("friction", "expected"), [(0.9, 8.0), (0.5, 0.5 * GRAVITY)])
def test_braking_distance_is_limited_by_brakes_or_friction(friction, expected):
    spec = EgoSpec(dynamics="dynamic_bicycle", vehicle={"friction": friction}, actuators=IDEAL)
    motions = driven(spec, Motion(0, 0, 0, 20.0), 6.0, lambda _m: Command(-50.0, 0.0))

    assert motions[-1].speed == 0.0
    assert motions[-1].x == pytest.approx(20.0**2 / (2 * expected), rel=0.01)


def test_the_dynamic_model_is_kinematic_at_low_speed():
    kinematic = driven(EgoSpec(), Motion(0, 0, 0, 1.5), 5.0, lambda _m: Command(0.0, 0.3))
    dynamic = driven(DYNAMIC, Motion(0, 0, 0, 1.5), 5.0, lambda _m: Command(0.0, 0.3))

    assert dynamic[-1] == kinematic[-1]


def test_the_model_is_smooth_through_walking_pace():
    motions = driven(DYNAMIC, Motion(0, 0, 0, 8.0), 6.0, lambda _m: Command(-1.5, 0.1))
    rates = np.array([m.yaw_rate for m in motions[5:]])

    assert np.abs(np.diff(rates)).max() < 0.05


def test_a_tyre_is_linear_at_small_slip_and_saturates():
    assert fiala(1e-4, 50e3, 4e3) == pytest.approx(5.0, rel=1e-3)
    assert fiala(0.5, 50e3, 4e3) == 4e3
    assert fiala(-0.5, 50e3, 4e3) == -4e3
    assert fiala(0.1, 50e3, 0.0) == 0.0
    # At the edge of sliding the force arrives with slope zero.
    edge = math.atan(3 * 4e3 / 50e3)
    assert fiala(edge - 1e-4, 50e3, 4e3) == pytest.approx(4e3, rel=1e-5)


def test_braking_in_a_bend_reduces_cornering_force():
    vehicle = vehicle_parameters(DYNAMIC)
    free, braked = (
        axle_forces(vehicle, (20.0, 0.0, 0.0), steering=0.2, acceleration=a) for a in (0.0, -8.0)
    )
    load = vehicle.mass * (GRAVITY * vehicle.rear + 8.0 * vehicle.height) / vehicle.wheelbase

    assert free[0] == pytest.approx(0.9 * vehicle.mass * GRAVITY * 0.56, rel=0.02)
    assert braked[0] == pytest.approx(load * math.sqrt(0.9**2 - (8 / GRAVITY) ** 2), rel=1e-3)


# --- actuators --------------------------------------------------------------------------------


def test_a_delayed_brake_acts_after_its_dead_time():
    spec = EgoSpec(actuators={**IDEAL, "drive_delay_us": 250_000})
    motions = driven(spec, Motion(0, 0, 0, 10.0), 1.0, lambda _m: Command(-4.0, 0.0))

    assert [m.speed for m in motions[:2]] == [10.0, 10.0]
    assert motions[-1].speed == pytest.approx(10.0 - 4.0 * 0.75)


def test_steering_lag_is_first_order():
    spec = EgoSpec(actuators={"steering_lag": 0.2}, max_steer_rate=10.0)
    motions = driven(spec, Motion(0, 0, 0, 5.0), 0.4, lambda _m: Command(0.0, 0.1))

    assert motions[1].steering == pytest.approx(0.1 * (1 - math.exp(-1)), rel=0.01)
    assert motions[3].steering == pytest.approx(0.1 * (1 - math.exp(-2)), rel=0.01)


# --- tracking ---------------------------------------------------------------------------------


def lane_change(speed: float) -> tuple[list[int], list[tuple[float, float, float]]]:
    """A lane change of 3.5 m to the left over 60 m, a quintic polynomial."""
    times, poses = [], []
    for k in range(1, 81):
        x = speed * k * 0.1
        u = min(max((x - 20.0) / 60.0, 0.0), 1.0)
        slope = 3.5 * 30 * u * u * (1 - u) ** 2 / 60.0
        poses.append((x, 3.5 * u**3 * (10 - 15 * u + 6 * u * u), math.atan(slope)))
        times.append(k * 100_000)
    return times, poses


def worst_offset(spec: EgoSpec, speed: float) -> float:
    times, poses = lane_change(speed)
    motion = Motion(0, 0, 0, speed)
    errors = []
    for k in range(70):
        reference = ReferenceTrajectory(
            motion,
            start_us=k * 100_000,
            trajectory=PlannedTrajectory.of(times[k:], poses[k:]),
            spec=spec,
        )
        motion = make_tracker(reference, spec).advance(motion, 0.0, 100_000)
        x, y, yaw = poses[k]
        errors.append(abs((motion.y - y) * math.cos(yaw) - (motion.x - x) * math.sin(yaw)))
    assert abs(errors[-1]) < 0.1
    return max(errors)


MODELS = ["kinematic_bicycle", "dynamic_bicycle"]
TRACKERS = ["pursuit", "lqr", "ilqr"]


@pytest.mark.parametrize("dynamics", MODELS)
@pytest.mark.parametrize("actuators", [IDEAL, NUPLAN, NUPLAN | DELAYED, {"steering_lag": 0.1}])
@pytest.mark.parametrize(
    ("tracker", "tolerance"), [*((t, 0.2) for t in TRACKERS), ("perfect", 1e-3)]
)
def test_a_lane_change_at_15_metres_per_second_is_tracked(dynamics, tracker, actuators, tolerance):
    spec = EgoSpec(dynamics=dynamics, tracker=tracker, actuators=actuators)

    assert worst_offset(spec, 15.0) < tolerance


def test_default_actuators_lag_like_nuplan():
    # KinematicBicycleModel: accel_time_constant 0.2 s, steering_angle_time_constant 0.05 s.
    assert EgoSpec() == EgoSpec(actuators=NUPLAN)


@pytest.mark.parametrize("dynamics", MODELS)
@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize(
    "actuators",
    [
        {"steering_lag": 0.1},
        DELAYED | IDEAL,
        NUPLAN | DELAYED,
        {"steering_lag": 0.3, "drive_lag": 0.5},
        {**NUPLAN, "steering_delay_us": 200_000, "drive_delay_us": 50_000},
    ],
)
@pytest.mark.parametrize("radius", [math.inf, 60.0])
def test_trackers_are_stable_with_slow_actuators(dynamics, tracker, actuators, radius):
    spec = EgoSpec(dynamics=dynamics, tracker=tracker, actuators=actuators)
    speed, times = 12.0, [k * 100_000 for k in range(1, 101)]
    turns = [speed * t * 1e-6 / radius for t in times]
    poses = [(radius * math.sin(a), radius * (1 - math.cos(a)), a) for a in turns]
    if math.isinf(radius):
        poses = [(speed * t * 1e-6, 0.0, 0.0) for t in times]
    motion, offsets = Motion(0, 0.5, 0, speed), []
    for k in range(80):
        reference = ReferenceTrajectory(
            motion,
            start_us=k * 100_000,
            trajectory=PlannedTrajectory.of(times[k:], poses[k:]),
            spec=spec,
        )
        motion = make_tracker(reference, spec).advance(motion, 0.0, 100_000)
        x, y, yaw = poses[k]
        offsets.append(abs((motion.y - y) * math.cos(yaw) - (motion.x - x) * math.sin(yaw)))

    assert max(offsets) < 0.8
    assert max(offsets[-20:]) < 0.13


def test_trackers_without_foresight_assume_ideal_actuators():
    slow = {**NUPLAN, **DELAYED, "foreseen": False}
    motion, commands = Motion(0, 0.5, 0, 12.0), []
    for actuators in (slow, IDEAL):
        spec = EgoSpec(tracker="lqr", actuators=actuators)
        plan = PlannedTrajectory.of([1_000_000, 2_000_000], [(12.0, 0.0, 0.0), (24.0, 0.0, 0.0)])
        reference = ReferenceTrajectory(motion, start_us=0, trajectory=plan, spec=spec)
        commands.append(make_tracker(reference, spec).command(motion, 0.2))

    assert commands[0] == commands[1]


def test_a_plan_lasts_until_its_delayed_commands_act():
    # A single pose one dead time ahead. Otherwise the vehicle would brake at every step.
    spec = EgoSpec(tracker="lqr", actuators={**IDEAL, **DELAYED})
    motion = Motion(0, 0, 0, 10.0)
    for k in range(30):
        trajectory = PlannedTrajectory.of([100_000 * (k + 1)], [(motion.x + 1.0, 0.0, 0.0)])
        reference = ReferenceTrajectory(
            motion, start_us=k * 100_000, trajectory=trajectory, spec=spec
        )
        motion = make_tracker(reference, spec).advance(motion, 0.0, 100_000)

    assert motion.speed == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("lag", [0.01, 0.1, 0.333, 1.0, 3.6])
def test_gains_with_lag_solve_the_riccati_equation(lag):
    A = np.array([[0.0, 1, 0], [0, 0, 1], [0, 0, -1 / lag]])
    B = np.array([[0.0], [0], [1 / lag]])
    P = solve_continuous_are(A, B, np.diag([1.0, 0, 0]), np.eye(1))
    expected = (B.T @ P)[0]

    np.testing.assert_allclose((1.0, *lagging_gains(lag)), expected, rtol=1e-6)


def test_gains_without_lag_are_those_of_a_double_integrator():
    assert lagging_gains(0.0) == (math.sqrt(2.0), 0.0)
    np.testing.assert_allclose(lagging_gains(1e-6), (math.sqrt(2.0), 0.0), atol=1e-5)


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr", "perfect"])
def test_every_tracker_drives_an_episode(make_world, tracker):
    world = make_world(spec={"ego": {"tracker": tracker}, "horizon": 30})
    while not world.over:
        times = [world.t_us + 100_000 * (k + 1) for k in range(20)]
        poses = [(1.0 * (k + 1), 0.0, 0.0) for k in range(20)]
        world.step(TrajectoryPlan(times_us=times, poses=poses))

    assert world.motion.x == pytest.approx(30.0, abs=0.3)
    assert abs(world.motion.y) < 1e-6


@pytest.mark.parametrize("tracker", ["lqr", "ilqr"])
def test_trackers_obey_vehicle_limits(tracker):
    spec = EgoSpec(tracker=tracker)
    motion = Motion(0, 0, 0, 10.0)
    reference = ReferenceTrajectory(
        motion,
        start_us=0,
        trajectory=PlannedTrajectory.of(
            [500_000, 1_000_000], [(-20.0, 30.0, 2.0), (60.0, -50.0, -2.0)]
        ),
        spec=spec,
    )
    tracker_ = make_tracker(reference, spec)
    for k in range(8):
        after = tracker_.advance(motion, 0.1 * k, 100_000)
        assert -8.0 - 1e-9 <= after.acceleration <= 4.0 + 1e-9
        assert abs(after.steering - motion.steering) <= 0.08 + 1e-9
        motion = after
