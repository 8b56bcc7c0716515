"""Reverse gear: commands and plans that drive backwards."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_proto.episode import EgoSpec, ResetSpec
from real2sim_proto.plans import Control, TrajectoryPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.world import World, WorldError
from real2sim_server.world.batch import BatchWorld
from real2sim_server.world.controller import EgoController
from real2sim_server.world.driving import VEHICLE_MODELS
from real2sim_server.world.ego_motion import Motion
from real2sim_server.world.plan import PlannedTrajectory
from real2sim_server.world.replay import stored_spec

BEHIND, ASIDE = 11.0, 2.5
"""Parking gap relative to the stopped vehicle [m]."""

Pose = tuple[float, float, float]


def smooth(u: float) -> float:
    """A step from 0 to 1 with zero velocity and acceleration at both ends."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)


def parking(t_us: int) -> Pose:
    """Stop past the gap after 2 s from 2 m/s, wait 1 s, then reverse into it."""
    t = t_us * 1e-6
    way = 2 * t - t * t / 2 if t < 2 else 2.0
    back = BEHIND * smooth((t - 3) / 8)
    u = back / BEHIND
    bend = ASIDE / BEHIND * 30 * (u * (1 - u)) ** 2
    return way - back, -ASIDE * smooth(u), math.atan(bend)


def plan_of(t_us: int, poses: int = 30) -> TrajectoryPlan:
    times = [t_us + 100_000 * k for k in range(1, poses + 1)]
    return TrajectoryPlan(times_us=times, poses=[parking(t) for t in times], frame="world")


def parked(make_scene, *, anew: bool = True, **ego) -> tuple[Motion, float]:
    """The motion after parking, and the largest distance from the plan [m]."""
    controller = EgoController(ResetSpec(ego=ego), make_scene().ego)
    motion, worst = Motion(0.0, 0.0, 0.0, 2.0), 0.0
    for t_us in range(0, 12_000_000, 100_000):
        if anew or not t_us:
            plan = plan_of(t_us) if anew else plan_of(t_us, 120)
            controller = controller.with_plan(plan, motion, t_us, t_us)
        controller, motion = controller.advance(motion, t_us, 100_000)
        x, y, _ = parking(t_us + 100_000)
        worst = max(worst, math.hypot(motion.x - x, motion.y - y))
    return motion, worst


@pytest.mark.parametrize("dynamics", ["kinematic_bicycle", "dynamic_bicycle"])
@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr", "perfect"])
def test_a_reverse_parking_plan_is_followed(make_scene, tracker, dynamics):
    motion, worst = parked(make_scene, tracker=tracker, dynamics=dynamics)

    assert worst < 0.2
    assert (motion.x, motion.y) == pytest.approx((2 - BEHIND, -ASIDE), abs=0.15)
    assert abs(motion.yaw) < 0.12
    assert abs(motion.speed) < 0.05


@pytest.mark.parametrize("tracker", ["pursuit", "lqr", "ilqr"])
def test_a_plan_with_both_gears_is_followed_despite_dead_times(make_scene, tracker):
    delays = {"drive_delay_us": 100_000, "steering_delay_us": 100_000}

    assert parked(make_scene, anew=False, tracker=tracker, actuators=delays)[1] < 0.2


def test_a_vehicle_without_reverse_gear_does_not_reverse(make_scene):
    motion, _ = parked(make_scene, tracker="pursuit", max_reverse_speed=0.0)

    assert motion.speed >= 0.0
    assert not motion.reversing


def commanded(make_world, *commands: tuple[str, float, int], **ego) -> World:
    world = make_world(spec={"action": "control", "ego": ego})
    for gear, acceleration, steps in commands:
        for _ in range(steps):
            world.step(Control(acceleration=acceleration, steering=0.3, gear=gear))
    return world


def test_a_reverse_command_takes_effect_at_standstill(make_world):
    rolling = commanded(make_world, ("reverse", 4.0, 20))
    assert rolling.motion.speed > 0
    world = commanded(make_world, ("reverse", 4.0, 50))

    assert -5.0 <= world.motion.speed < -1.0
    # In reverse, steering left moves the rear to the left: the front turns right.
    assert world.motion.yaw_rate < 0
    ego = world.observe().ego_fields()
    assert (ego["gear"], ego["speed"]) == ("reverse", world.motion.speed)
    assert world.metrics()["feasible"] == 1.0


def test_reverse_speed_is_limited_and_braking_stops(make_world):
    fast = commanded(make_world, ("reverse", 4.0, 100), max_reverse_speed=3.0)
    stopped = commanded(make_world, ("reverse", 4.0, 50), ("reverse", -4.0, 40))

    assert fast.motion.speed == -3.0
    assert stopped.motion.speed == 0.0
    assert math.copysign(1.0, stopped.motion.speed) == 1.0


@pytest.mark.parametrize("delay_us", [0, 200_000])
def test_pending_braking_does_not_accelerate_in_reverse(make_world, delay_us):
    world = commanded(
        make_world,
        ("drive", -8.0, 30),
        ("reverse", 0.0, 30),
        actuators={"drive_delay_us": delay_us, "drive_lag": 0.5},
    )

    assert world.motion.reversing
    assert world.motion.speed == 0.0


def test_a_command_without_a_gear_never_reverses(make_world):
    world = make_world(spec={"action": "control"})
    for _ in range(40):
        world.step(Control(acceleration=-8.0, steering=0.0))

    assert world.motion.speed == 0.0
    assert "gear" not in world.observe().ego_fields()


def test_reverse_commands_need_a_reverse_gear(make_world):
    with pytest.raises(WorldError, match="max_reverse_speed is 0") as refused:
        commanded(make_world, ("reverse", 1.0, 1), max_reverse_speed=0.0)
    assert refused.value.code == "INVALID_ACTION"


def test_a_model_without_reverse_refuses_the_command(make_world, make_scene, monkeypatch):
    forwards = VEHICLE_MODELS["kinematic_bicycle"]._replace(backwards=None)
    monkeypatch.setitem(VEHICLE_MODELS, "kinematic_bicycle", forwards)

    with pytest.raises(WorldError, match="cannot go backwards"):
        commanded(make_world, ("reverse", 1.0, 1))
    assert parked(make_scene)[0].speed >= 0.0


def test_noise_of_a_standing_plan_does_not_change_gear(make_world, moving):
    world = make_world(moving(speed=0.0))
    random = np.random.default_rng(2)
    for _ in range(20):
        times = [world.t_us + 100_000 * k for k in range(1, 11)]
        poses = [(x, 0.0, 0.0) for x in random.uniform(-0.02, 0.02, 10)]
        world.step(TrajectoryPlan(times_us=times, poses=poses, frame="vehicle"))

    assert not world.motion.reversing
    assert abs(world.motion.x) < 0.1


def test_reversing_does_not_depend_on_the_time_step(make_world):
    places = []
    for dt_us, steps in ((20_000, 250), (100_000, 50), (1_000_000, 5)):
        world = make_world(spec={"action": "control", "dt_us": dt_us})
        for _ in range(steps):
            world.step(Control(acceleration=4.0, steering=0.1, gear="reverse"))
        places.append(world.motion[:4])

    assert places[0] == pytest.approx(places[1], abs=0.02)
    assert places[2] == pytest.approx(places[1], abs=0.02)


def test_batched_worlds_reverse_like_single_worlds(make_scene, moving):
    scene, spec = make_scene(moving(speed=2.0)), ResetSpec(ego={"tracker": "lqr"})
    state = ScenarioState.of(scene)
    single, batch = World(scene, state, spec), BatchWorld(scene, spec, 2, state=state)
    after_us = np.arange(1, 11) * 200_000
    backwards = False
    for step in range(50):
        sign = -1.0 if 5 <= step < 35 else 1.0
        poses = np.stack([sign * 0.3 * np.arange(1, 11)] + [np.zeros(10)] * 2, axis=1)
        times = (single.t_us + after_us).tolist()
        single.step(TrajectoryPlan(times_us=times, poses=poses.tolist(), frame="vehicle"))
        batch.step(np.stack([poses, np.abs(poses)]), plan_us=after_us)
        backwards |= single.motion.reversing
        assert single.motion.numbers == tuple(batch.motions[0])
        assert batch.motions[1, 3] > 0
    assert backwards
    assert not single.motion.reversing


def test_egos_of_older_versions_have_no_reverse_gear():
    assert stored_spec({"ego": {}}).ego.max_reverse_speed == 0.0
    assert stored_spec({}).ego.max_reverse_speed == 0.0
    assert EgoSpec().max_reverse_speed == 5.0


@pytest.mark.parametrize("turned", [0.0, 0.4, math.pi])
def test_plan_direction_does_not_depend_on_its_construction(turned):
    frame, times = (3.0, -7.0, 2.5), range(1, 9)
    rows = [(0.5 * k, 0.1 * k, turned) for k in times]
    found = PlannedTrajectory.of(list(times), rows, frame)
    again = PlannedTrajectory(found.times_us, found.poses)
    assert found.is_clear == found.leads_forwards == again.leads_forwards == (turned < 1)
