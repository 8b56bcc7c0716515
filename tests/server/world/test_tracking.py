"""Closed-loop tracking of plans."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.geometry import quaternion_yaw, yaw_quaternion
from real2sim_server.logs import open_log
from real2sim_server.scene import Trajectory
from real2sim_server.world import World
from real2sim_server.world.replay import stored_spec

START_US = 5_000_000
IDEAL = {"actuators": {"steering_lag": 0.0, "drive_lag": 0.0}}


def s_curve(*, speed: float, curvature: float) -> Trajectory:
    """An S-curve at constant speed with curvature between -``curvature`` and ``curvature``."""
    way = np.arange(121 * 100) * speed * 1e-3
    yaw = np.cumsum(curvature * np.sin(way / 15)) * speed * 1e-3
    x, y = np.cumsum(np.cos(yaw)) * speed * 1e-3, np.cumsum(np.sin(yaw)) * speed * 1e-3
    positions = np.stack([x, y, 0 * x], axis=1)[::100]
    return Trajectory(START_US + np.arange(121) * 100_000, positions, yaw_quaternion(yaw[::100]))


def logged_plan(world: World, *, poses: int, spacing_us: int, frame: str) -> TrajectoryPlan:
    """The recorded future as a plan."""
    ego, motion = world.scene.ego, world.motion
    wanted = [world.t_us + spacing_us * (i + 1) for i in range(poses)]
    times = [t for t in wanted if t <= ego.end_us] or [ego.end_us]
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    plan = []
    for t_us in times:
        (x, y, _), quaternion = ego.pose(t_us)
        yaw = float(quaternion_yaw(quaternion))
        if frame == "vehicle":
            dx, dy = x - motion.x, y - motion.y
            x, y, yaw = cos * dx + sin * dy, cos * dy - sin * dx, yaw - motion.yaw
        plan.append((x, y, yaw))
    return TrajectoryPlan(times_us=times, poses=plan, frame=frame)


def errors(world: World, **plan) -> np.ndarray:
    """Distance [m] from the recorded position at every step of the episode."""
    distances = []
    while not world.over:
        world.step(logged_plan(world, **plan) if plan else None)
        (x, y, _), _ = world.scene.ego.pose(world.t_us)
        distances.append(math.hypot(x - world.motion.x, y - world.motion.y))
    return np.array(distances)


@pytest.mark.parametrize("frame", ["vehicle", "world"])
@pytest.mark.parametrize(("poses", "spacing_us"), [(30, 100_000), (8, 500_000), (2, 500_000)])
def test_a_curved_drive_is_followed_within_30_cm(make_world, frame, poses, spacing_us):
    world = make_world(s_curve(speed=9.0, curvature=0.05))

    assert errors(world, poses=poses, spacing_us=spacing_us, frame=frame).max() < 0.3


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
@pytest.mark.parametrize(("speed", "curvature"), [(9.0, 0.05), (14.0, 0.04), (20.0, 0.012)])
def test_single_pose_plans_are_followed_within_5_cm(make_world, tracker, speed, curvature):
    ego = s_curve(speed=speed, curvature=curvature)
    world = make_world(ego, spec={"ego": {"tracker": tracker, **IDEAL}})

    assert errors(world, poses=1, spacing_us=100_000, frame="vehicle").max() < 0.05


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
def test_single_pose_plans_are_followed_within_20_cm_by_lagging_actuators(make_world, tracker):
    ego = s_curve(speed=14.0, curvature=0.04)
    world = make_world(ego, spec={"ego": {"tracker": tracker}})

    assert errors(world, poses=1, spacing_us=100_000, frame="vehicle").max() < 0.2


def test_without_a_plan_the_log_is_followed(make_world):
    assert errors(make_world(s_curve(speed=9.0, curvature=0.05))).max() < 0.3


def test_a_tight_turn_at_walking_pace_is_followed(make_world):
    world = make_world(s_curve(speed=1.5, curvature=0.15))

    assert errors(world, poses=30, spacing_us=100_000, frame="vehicle").max() < 0.2


def test_a_start_and_a_stop_are_followed(make_world):
    seconds = np.arange(121) * 0.1
    # Starts at 2 s with 1.5 m/s^2 and stops at 10 s.
    speed = np.clip(np.minimum(1.5 * (seconds - 2), 1.5 * (10 - seconds)), 0, None)
    x = np.cumsum(speed) * 0.1
    positions = np.stack([x, 0 * x, 0 * x], axis=1)
    ego = Trajectory(
        START_US + np.arange(121) * 100_000, positions, np.tile([1.0, 0, 0, 0], (121, 1))
    )
    world = make_world(ego)

    assert errors(world, poses=30, spacing_us=100_000, frame="vehicle").max() < 0.3
    assert world.motion.speed < 0.05


def braking(seconds: float) -> float:
    """Position [m] of a vehicle that brakes from 10 m/s at 3 m/s^2 after 1 s."""
    braked = min(max(seconds - 1, 0.0), 10 / 3)
    return 10 * min(seconds, 1.0) + 10 * braked - 1.5 * braked**2


def driven(world: World, place, *, spacing_us: int, poses: int, steps: int) -> np.ndarray:
    """Errors [m], speeds [m/s] and reverse flags, replanning ``place(seconds)`` at every step."""
    found = []
    for _ in range(steps):
        times = [world.t_us + spacing_us * (k + 1) for k in range(poses)]
        places = [(place((t - START_US) * 1e-6), 0.0, 0.0) for t in times]
        world.step(TrajectoryPlan(times_us=times, poses=places, frame="world"))
        error = world.motion.x - place((world.t_us - START_US) * 1e-6)
        found.append((error, world.motion.speed, world.motion.reversing))
    return np.array(found)


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
@pytest.mark.parametrize(("poses", "spacing_us"), [(30, 100_000), (8, 500_000)])
def test_a_stop_replanned_at_every_step_ends_at_the_planned_position(
    make_world, tracker, poses, spacing_us
):
    world = make_world(spec={"ego": {"tracker": tracker}})

    found = driven(world, braking, spacing_us=spacing_us, poses=poses, steps=60)

    assert np.abs(found[:, 0]).max() < 0.1
    assert found[-1, 1] == 0.0


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
@pytest.mark.parametrize("speed", [0.5, 1.5, 5.0])
def test_single_pose_plans_are_caught_up_without_oscillation(make_world, tracker, speed):
    ego = s_curve(speed=speed + 0.3, curvature=0.0)
    world = make_world(ego, spec={"ego": {"tracker": tracker}})

    found = driven(world, lambda t: speed * t, spacing_us=100_000, poses=1, steps=60)

    assert np.abs(found[:, 0]).max() < 0.15
    assert np.abs(found[30:, 0]).max() < 0.01
    assert found[30:, 1] == pytest.approx(speed, abs=0.01)
    assert not found[:, 2].any()


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
def test_the_vehicle_stops_at_a_fixed_single_pose(make_world, tracker):
    ego = s_curve(speed=0.0, curvature=0.0)
    world = make_world(ego, spec={"ego": {"tracker": tracker}})

    found = driven(world, lambda _: 0.2, spacing_us=100_000, poses=1, steps=60)

    assert abs(found[-1, 0]) < 0.03
    assert found[:, 1].min() >= 0.0
    assert found[-1, 1] == pytest.approx(0.0, abs=1e-4)


def test_backward_single_poses_are_followed_in_reverse_gear(make_world):
    world = make_world(s_curve(speed=0.0, curvature=0.0))

    found = driven(world, lambda t: -0.5 * t, spacing_us=100_000, poses=1, steps=60)

    assert abs(found[-1, 0]) < 0.02
    assert found[-1, 2]
    assert np.abs(np.diff(found[:, 2])).sum() <= 1


def test_old_logs_use_tracker_version_1():
    fields = ResetSpec().model_dump(mode="json")
    assert stored_spec(fields).ego.tracker_version == 2
    del fields["ego"]["tracker_version"]
    assert stored_spec(fields).ego.tracker_version == 1


def test_a_vehicle_beside_its_plan_returns_to_it(make_world):
    world = make_world()
    plan = TrajectoryPlan(
        times_us=[world.t_us + 100_000 * i for i in range(1, 120)],
        poses=[(1.0 * i, 1.0, 0.0) for i in range(1, 120)],
        frame="world",
    )
    offsets = []
    for _ in range(40):
        world.step(plan if world.steps == 0 else None)
        offsets.append(world.motion.y)

    assert offsets[-1] == pytest.approx(1.0, abs=0.02)
    assert max(offsets) < 1.1
    assert world.motion.speed == pytest.approx(10.0, abs=0.05)


def test_the_vehicle_stops_gently_after_the_end_of_a_plan(make_world):
    world = make_world(spec={"ego": IDEAL})
    plan = TrajectoryPlan(times_us=[world.t_us + 500_000], poses=[(5.0, 0.0, 0.0)])
    world.step(plan)
    braking = []
    while world.motion.speed > 0:
        world.step()
        braking.append(world.motion.acceleration)

    assert min(braking) == pytest.approx(-2.0)
    assert world.motion.x == pytest.approx(5.0 + 10.0**2 / (2 * 2.0), abs=0.2)
    assert abs(world.motion.y) < 1e-6


def test_a_standing_plan_close_ahead_is_an_emergency_stop(make_world):
    world = make_world(spec={"ego": IDEAL})
    stop = TrajectoryPlan(
        times_us=[world.t_us + 500_000 * i for i in range(1, 9)],
        poses=[(2.0, 0.0, 0.0)] * 8,
        frame="world",
    )
    for _ in range(30):
        world.step(stop if world.steps == 0 else None)

    assert world.motion.speed == 0.0
    assert world.motion.x == pytest.approx(10.0**2 / (2 * 8.0), abs=0.5)


def test_limits_hold_for_infeasible_plans(make_world):
    world = make_world()
    before = world.motion
    for _ in range(20):
        world.step(
            TrajectoryPlan(
                times_us=[world.t_us + 100_000, world.t_us + 200_000],
                poses=[(-30.0, 40.0, 3.0), (90.0, -80.0, -2.0)],
            )
        )
        now = world.motion
        assert -8.0 - 1e-9 <= now.acceleration <= 4.0 + 1e-9
        assert abs(now.steering - before.steering) <= 0.08 + 1e-9
        assert abs(now.steering) <= 0.6
        before = now


def test_a_real_traffic_jam_is_followed(make_world, test_data: Path):
    world = make_world(open_log(test_data / "kitti_jam").ego)

    assert errors(world, poses=30, spacing_us=100_000, frame="vehicle").max() < 0.05
