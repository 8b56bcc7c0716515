"""Contacts between time steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_proto import decode, encode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import CameraRig, GaussianCloud, Scene, Trajectory
from real2sim_server.world import World
from real2sim_server.world.boxes import first_contacts
from real2sim_server.world.recording import first_difference, record
from real2sim_server.world.replay import (
    Entry,
    Replayer,
    action_payload,
    no_action_impact,
    reset_payload,
)

COAST = Control(acceleration=0.0, steering=0.0)
CAR = (4.0, 2.0)
FRONT = 3.65
"""Distance from the ego's rear axle to its front bumper [m]."""


def gaps(centres, yaws, sizes):
    """Largest gap between two boxes along a face normal; centres [T, 2] and yaws [T] of both."""
    apart = centres[1] - centres[0]
    found = []
    for yaw in yaws:
        for axis in (
            np.stack([np.cos(yaw), np.sin(yaw)], 1),
            np.stack([-np.sin(yaw), np.cos(yaw)], 1),
        ):
            reach = 0.0
            for (length, width), other in zip(sizes, yaws, strict=True):
                along = np.stack([np.cos(other), np.sin(other)], 1)
                across = np.stack([-np.sin(other), np.cos(other)], 1)
                reach = reach + length / 2 * np.abs((axis * along).sum(1))
                reach = reach + width / 2 * np.abs((axis * across).sum(1))
            found.append(np.abs((axis * apart).sum(1)) - reach)
    return np.max(found, axis=0)


def drive(world, plan=COAST):
    """Collision events until the end of the episode."""
    found = []
    while not world.over:
        found += [e for e in world.step(plan) if e.type == "collision"]
    return found


def first_collisions(world):
    """Collision events of the first step with a collision."""
    while not world.over:
        if found := [e for e in world.step(COAST) if e.type == "collision"]:
            return found
    return []


# --- the kernel -------------------------------------------------------------------------------


@settings(deadline=None, max_examples=100)
@given(seed=st.integers(0, 100_000))
def test_the_first_contact_matches_a_dense_sampling(seed):
    rng = np.random.default_rng(seed)
    fractions = np.linspace(0, 1, int(rng.integers(2, 5)))
    way = np.zeros((len(fractions), 5))
    way[:, 0] = fractions
    way[:, 1:3] = np.cumsum(rng.normal(scale=8.0, size=(len(fractions), 2)), axis=0)
    way[:, 3] = np.cumsum(rng.normal(scale=0.5, size=len(fractions)))
    a, b = rng.normal(scale=8.0, size=(2, 3)) * [1, 1, 0]
    yaws = rng.uniform(-4, 4, 2)
    size, other = (4.6, 1.85, 1.6), rng.uniform(0.4, 5.0, 3)
    t = np.linspace(0, 1, 10_001)
    turn = math.remainder(yaws[1] - yaws[0], math.tau)
    centres = np.stack([np.interp(t, way[:, 0], way[:, c]) for c in (1, 2)], 1)
    others = a[:2] + t[:, None] * (b - a)[:2]
    turned = (np.interp(t, way[:, 0], way[:, 3]), yaws[0] + t * turn)
    gap = gaps((centres, others), turned, (size[:2], other[:2]))

    first, touching = first_contacts(
        way,
        size,
        np.zeros(1, np.int64),
        (a[None], yaw_quaternion(yaws[:1])),
        (b[None], yaw_quaternion(yaws[1:])),
        other[None],
        0.0,
        1e-3,
    )
    # Overlaps shallower than the tolerance may be missed. There are no false contacts.
    if math.isfinite(first[0]):
        before = gap[t < first[0] - 2e-4]
        assert before.min(initial=1.0) > -2e-3
        assert np.interp(first[0], t, gap) < 1e-3
    else:
        assert gap.min() > -2e-3
    assert touching[0] == (gap[-1] < 0.0)


# --- drives -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("on_collision", "count"), [("terminate", 1000), ("continue", 200)])
def test_no_random_fast_drive_passes_through_a_car(make_scene, on_collision, count):
    # With momentum exchange, contacts start at substeps of 10 ms.
    late = 3e-3 if on_collision == "terminate" else 13e-3
    rng = np.random.default_rng(20)
    times = 5_000_000 + np.array([0, 3_000_000])
    t = np.linspace(0, 3, 1501)
    met, flat = 0, make_scene().ground
    for _ in range(count):
        speed, yaw = rng.uniform(10, 40), rng.uniform(-math.pi, math.pi)
        other = rng.uniform(0, 30) * np.array([math.cos(yaw), math.sin(yaw)])
        # Near the ego's centre at a random time of the drive.
        when = rng.uniform(0.4, 2.6)
        place = np.array([1.35 + speed * when, 0.0]) + rng.uniform(-3, 3, 2) - other * when
        positions = np.zeros((2, 3))
        positions[:, :2], positions[:, 2] = [place, place + 3 * other], 0.8
        car = Trajectory(times, positions, np.tile(yaw_quaternion(yaw), (2, 1)))
        way = np.zeros((2, 3))
        way[1, 0] = 3 * speed
        ego = Trajectory(times, way, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
        # Reuse the ground: fitting it for each scene is slow.
        scene = replace(make_scene(ego, car=car), stored_ground=flat)
        dt_us = int(rng.choice([50_000, 100_000, 200_000, 500_000, 1_000_000]))
        contact = {"dents": False}
        spec = ResetSpec(action="control", dt_us=dt_us, on_collision=on_collision, contact=contact)
        found = first_collisions(World(scene, ScenarioState.of(scene), spec))

        centres = np.stack([1.35 + speed * t, 0 * t], 1), place + t[:, None] * other
        size = scene.ego_size[:2]
        gap = gaps(centres, (0 * t, yaw + 0 * t), (size, CAR))
        begins = np.flatnonzero(gap < -0.01)
        if gap[0] > 0 and len(begins):
            met += 1
            (event,) = found
            contact = (event.data["contact_us"] - 5_000_000) * 1e-6
            assert t[np.argmax(gap < 0)] - 3e-3 <= contact <= t[begins[0]] + late
            velocity = np.array([speed, 0.0]) - other
            assert event.data["relative_speed"] == pytest.approx(np.hypot(*velocity), abs=1e-3)
        elif gap.min() > 0.01:
            assert not found
    assert met > count / 2


@pytest.mark.parametrize("dt_us", [50_000, 100_000, 500_000, 1_000_000])
def test_contact_time_place_and_speed_do_not_depend_on_the_time_step(make_world, moving, dt_us):
    at_once = {"actuators": {"steering_lag": 0.0, "drive_lag": 0.0}}
    spec = {"action": "control", "dt_us": dt_us, "ego": at_once}
    world = make_world(car=moving(45, 0, z=0.8), spec=spec)
    (event,) = drive(world, Control(acceleration=4.0, steering=0.0))

    # 10 t + 2 t^2 = 43 - 3.65.
    t = (-10 + math.sqrt(100 + 8 * (43 - FRONT))) / 4
    assert event.data["contact_us"] * 1e-6 == pytest.approx(5 + t, abs=1e-3)
    assert event.data["relative_speed"] == pytest.approx(10 + 4 * t, abs=0.05)
    assert (event.data["x"], event.data["y"]) == (pytest.approx(43, abs=0.01), 0.0)
    assert event.t_us == world.t_us
    assert (world.reason, world.metrics()["collisions"]) == ("collision", 1)


def test_a_turn_into_a_car_within_a_step_is_detected(make_world, moving):
    # A circle of 7 m radius: the arc of one step is far from its chord.
    spec = {"action": "control", "dt_us": 1_000_000, "ego": {"max_steer_rate": 10.0}}
    turn = Control(acceleration=0.0, steering=math.atan(2.8 / 7.0))
    aside = moving(7.6, 5.5, z=0.8)
    events = drive(make_world(aside=aside, spec=spec), turn)
    finely = drive(make_world(aside=aside, spec=spec | {"dt_us": 20_000}), turn)

    assert [e.object_id for e in events] == ["aside"]
    assert events[0].data["contact_us"] == pytest.approx(finely[0].data["contact_us"], abs=2e3)


@pytest.mark.parametrize("on_collision", ["terminate", "continue"])
def test_poses_that_jump_over_a_car_hit_it(make_world, moving, on_collision):
    spec = {"action": "pose", "dt_us": 500_000, "on_collision": on_collision}
    world = make_world(car=moving(15, 0, z=0.8), spec=spec)

    assert [e.object_id for e in world.step(PoseCommand(x=30, y=0, yaw=0))] == ["car"]


def test_the_perfect_tracker_hits_objects_on_its_plan(make_world, moving):
    spec = {"dt_us": 1_000_000, "ego": {"tracker": "perfect"}}
    world = make_world(aside=moving(12, 7, z=0.8), spec=spec)
    times = [world.t_us + 250_000 * k for k in range(1, 5)]
    # Out to the car and back within the step.
    poses = [(5.0, 3.0, 0.5), (12.0, 7.0, 0.0), (17.0, 3.0, -0.5), (20.0, 0.0, 0.0)]
    events = world.step(TrajectoryPlan(times_us=times, poses=poses, frame="world"))

    assert [e.object_id for e in events] == ["aside"]


def test_a_standing_ego_is_hit_by_a_car_crossing_within_a_step(make_world, moving):
    spec = {"action": "control", "dt_us": 1_000_000}
    crossing = moving(1.35, -20, z=0.8, speed=35.0, yaw=math.pi / 2)
    world = make_world(moving(), crossing=crossing, spec=spec)

    (event,) = drive(world)
    assert event.data["contact_us"] * 1e-6 == pytest.approx(5 + (20 - 2 - 0.925) / 35, abs=1e-3)
    assert event.data["relative_speed"] == pytest.approx(35.0)


def test_the_first_of_two_contacts_in_a_step_sets_the_impact_speed(make_world, moving):
    cars = {"far": moving(25, 0, z=0.8), "near": moving(15, 0, z=0.8, speed=4.0)}
    spec = {"action": "control", "dt_us": 1_000_000}
    world = make_world(moving(speed=30.0), **cars, spec=spec)

    assert [e.object_id for e in drive(world)] == ["near", "far"]
    assert world.accumulator.first_impact == pytest.approx(26.0)


def test_driving_under_a_bridge_at_high_speed_is_not_a_contact(make_world, moving):
    world = make_world(moving(speed=30.0), bridge=moving(20, 0, z=6.0), spec={"dt_us": 1_000_000})

    assert drive(world, None) == []


def test_objects_beside_a_turning_ego_are_hit_within_a_step(make_world, moving):
    spec = {"dt_us": 1_000_000, "action": "control", "on_collision": "continue"}
    world = make_world(moving(speed=6.0), aside=moving(5.0, 4.3, z=0.8), spec=spec)
    world.motion = world.motion._replace(steering=0.6)

    first, *_ = world.step(Control(acceleration=2.0, steering=0.6))
    assert (first.type, first.object_id) == ("collision", "aside")


# --- the background ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walled(make_scene) -> Scene:
    """A scene with a wall, one cell thick, beside the recorded path."""
    street = make_scene()
    x, z = np.meshgrid(np.arange(0.0, 60.0, 0.05), np.arange(0.5, 1.5, 0.2))
    points = np.stack([x, np.full_like(x, 6.1), z], -1).reshape(-1, 3)
    count = len(points)
    wall = GaussianCloud(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.05),
        opacities=torch.full((count,), 0.9),
        sh=torch.zeros(count, 1, 3),
    )
    rig = CameraRig(tuple(street.rig.cameras))
    return Scene("walled", wall, {}, None, rig, street.ego, street.ego.times_us)


@pytest.mark.parametrize("dt_us", [50_000, 1_000_000])
def test_a_fast_ego_does_not_pass_through_a_wall(walled, dt_us):
    spec = ResetSpec(dt_us=dt_us, contact={"background": True}, ego={"tracker": "perfect"})
    world = World(walled, ScenarioState.of(walled), spec)
    times = [world.t_us + 1_000_000 * k for k in (1, 2)]
    # Through the wall at 20 m/s.
    poses = [(16.0, 12.0, 0.6435), (32.0, 24.0, 0.6435)]
    events = drive(world, TrajectoryPlan(times_us=times, poses=poses, frame="world"))

    (event,) = events
    assert (event.object_id, world.reason) == (None, "collision")
    assert event.data["y"] == pytest.approx(6.1, abs=0.3)
    assert event.data["contact_us"] < 5_600_000


def test_driving_along_a_wall_is_not_a_contact(walled):
    spec = ResetSpec(dt_us=500_000, action="control", contact={"background": True})

    assert drive(World(walled, ScenarioState.of(walled), spec)) == []


def test_delta_v_at_a_wall_excludes_engine_thrust(walled):
    contact = {"background": True, "dents": False}
    spec = ResetSpec(action="control", on_collision="continue", contact=contact)
    world = World(walled, ScenarioState.of(walled), spec)
    fastest, impacts = 0.0, []
    while not world.over:
        world.step(Control(acceleration=4.0, steering=0.2))
        fastest = max(fastest, world.motion.speed)
        impacts += [impact.delta_v for impact in world.impacts]

    found = {s.name: s for s in world.scores()}["delta_v"]
    assert found.terms["impulse"] / world.context.ego_mass > fastest
    # The engine adds up to 0.8 m/s during the pulse.
    assert found.value == pytest.approx(max(impacts), abs=0.8)


# --- warm-up and recordings -------------------------------------------------------------------


@pytest.mark.parametrize("on_collision", ["terminate", "continue"])
def test_overlaps_during_the_warm_up_are_not_contacts(make_world, moving, on_collision):
    spec = {"warmup_us": 3_000_000, "horizon": 60, "on_collision": on_collision}
    world = make_world(car=moving(25, 0.0, z=0.8), spec=spec)

    assert drive(world, None) == []
    assert world.metrics()["collisions"] == 0
    assert world.steps == 60


def test_an_old_episode_without_swept_contacts_replays(make_scene, moving):
    scene = make_scene(moving(speed=30.0), car=moving(20, 0, z=0.8))
    spec = ResetSpec(dt_us=1_000_000, action="control", contact={"swept": False})
    fields = decode(reset_payload(spec))
    del fields["spec"]["contact"]["swept"]
    log = [Entry("reset", 0, encode(fields))]
    log += [Entry("action", k, action_payload(COAST)) for k in range(5)]
    made = record(Replayer.on(scene, ScenarioState.of(scene)), log, scene_hash="abc")

    assert len(made.instants) == 6
    assert first_difference(made, Replayer.on(scene, ScenarioState.of(scene))) is None


def test_the_no_action_impact_is_the_speed_at_first_contact(make_scene, moving):
    scene = make_scene(moving(speed=30.0), car=moving(20, 0, z=0.8, speed=5.0))
    log = [Entry("reset", 0, reset_payload(ResetSpec(dt_us=1_000_000)))]

    assert no_action_impact(Replayer.on(scene, ScenarioState.of(scene)), log) == pytest.approx(
        25.0, abs=1e-6
    )
