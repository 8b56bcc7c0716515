"""Planners in processes of their own: what they do, and what is reported of it."""

from __future__ import annotations

import gc

import pytest

from real2sim.planners import FollowRoute, Needs, load_planner
from real2sim_proto.episode import ResetSpec
from real2sim_server.edit import ScenarioState
from real2sim_server.policies.planner_process import PlannerFailedError, PlannerProcesses
from real2sim_server.sweeps.episode import CameraFeed, observation_of
from real2sim_server.world import World
from tests.server import planners
from tests.server.planners import ALL, NEVER_ANSWER, REASONS, Sees, none_left_running

CAMERAS = Needs(modalities=("rgb",), cameras=("front",), width=48)


@pytest.fixture(scope="module")
def world(tiny_scene) -> World:
    return World(tiny_scene, ScenarioState.of(tiny_scene), ResetSpec(privileged=True))


def drive(planner, world, feed=None, steps=6):
    """Plans of a planner, and the positions that it drives to."""
    world, plans = world.fork(), []
    planner.reset(observation_of(world, feed))
    for _ in range(steps):
        plans.append(planner.plan(observation_of(world, feed)))
        world.step(plans[-1])
    return plans, (world.motion.x, world.motion.y, world.motion.yaw)


def test_a_planner_gives_the_same_bits_in_its_own_process(world):
    with PlannerProcesses() as processes:
        planner = processes.load("real2sim.planners.idm:Idm")
        there = drive(planner, world)
    assert there == drive(load_planner("idm"), world)


def test_images_and_needs_reach_a_planner_as_they_are(world):
    feed = CameraFeed.of(world.scene, CAMERAS)
    obs, name = observation_of(world, feed), f"{planners.__name__}:Sees"
    with PlannerProcesses() as processes:
        planner = processes.load(name)
        planner.reset(obs)
        assert planner.plan(obs).acceleration == Sees().plan(obs)["acceleration"]
        assert (planner.needs.privileged, planner.needs.action, planner.needs.width) == (
            True, "control", 48,
        )  # fmt: skip
        cameras = list(world.scene.rig)
        assert planner.needs.sensors(cameras) == Sees.needs.sensors(cameras)


def test_a_planner_has_needs_and_begin_only_where_it_declares_them():
    with PlannerProcesses() as processes:
        plain = processes.load(ALL["Exits"])
        assert hasattr(plain, "needs") == hasattr(FollowRoute(), "needs")
        assert not hasattr(plain, "begin")


def test_each_misbehaviour_is_reported_and_the_next_episode_starts_anew(world, tmp_path):
    with none_left_running(tmp_path), PlannerProcesses() as processes:
        for name, reason in REASONS.items():
            with pytest.raises(PlannerFailedError) as failed:
                drive(processes.load(ALL[name]), world)
            assert str(failed.value).startswith(reason)
        with pytest.raises(PlannerFailedError, match="exit code 3 at step 3"):
            drive(processes.load(ALL["Exits"]), world)


@pytest.mark.parametrize("name", NEVER_ANSWER)
def test_a_planner_that_does_not_answer_is_ended_after_its_limit(name, world, tmp_path):
    within = pytest.raises(PlannerFailedError, match=r"gave no \w+ within 1 s")
    with none_left_running(tmp_path), PlannerProcesses(limit_s=1.0) as processes, within:
        drive(processes.load(ALL[name]), world)


def test_forks_of_a_planner_do_not_answer_in_its_place(world, tmp_path):
    name = f"{planners.__name__}:GoodBesideItsForks"
    with none_left_running(tmp_path), PlannerProcesses() as processes:
        assert drive(processes.load(name), world) == drive(FollowRoute(), world)


def test_processes_end_with_the_object_that_holds_them(world, tmp_path):
    with none_left_running(tmp_path):
        drive(PlannerProcesses().load(ALL["Exits"]), world, steps=1)
        gc.collect()


def test_an_unknown_planner_is_refused():
    with PlannerProcesses() as processes, pytest.raises(ValueError, match="No module named"):
        processes.load("no_such_module:Planner")
