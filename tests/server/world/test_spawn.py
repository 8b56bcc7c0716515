"""Road users that edits add to and remove from a running episode."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Delete, Spawn
from real2sim_proto.plans import Control
from real2sim_server.edit import (
    EditError,
    ScenarioState,
    apply_operations,
    pack_state,
    unpack_state,
)
from real2sim_server.world import World
from real2sim_server.world.recording import digest, first_difference, record
from real2sim_server.world.replay import (
    Entry,
    Replayer,
    action_payload,
    agent_payload,
    edit_payload,
    reset_payload,
)

COAST = Control(acceleration=0.0, steering=0.0)
CONTROL = {"action": "control", "privileged": True}
AHEAD = {"recorded_id": "car", "place": {"ahead": 30.0}, "speed": 8.0}


@pytest.fixture
def street(make_world, moving):
    """Make a world with one parked car to copy the appearance from."""
    return lambda **spec: make_world(car=moving(40, 9, z=0.8), spec=CONTROL | spec)


def agent(world: World, object_id: str = "spawned_1") -> dict | None:
    agents = world.observe().obs_fields()["agents"]
    return next((a for a in agents if a["object_id"] == object_id), None)


def test_a_car_spawned_ahead_appears_at_once_and_drives_on(street):
    world = street()
    for _ in range(10):
        world.step(COAST)
    outcome = world.apply([Spawn(**AHEAD)])
    assert outcome.created == ("spawned_1",)
    found = agent(world)
    assert found["position"] == pytest.approx([world.motion.x + 30.0, 0.0, 0.8], abs=1e-6)
    assert found["velocity"] == pytest.approx([8.0, 0.0, 0.0])
    before = found["position"][0]
    for _ in range(10):
        world.step(COAST)
    assert agent(world)["position"][0] - before == pytest.approx(8.0, abs=1.0)


def test_a_car_spawned_behind_the_ego_follows_it(street):
    world = street()
    world.apply([Spawn(recorded_id="car", place={"ahead": -15.0}, speed=10.0)])
    for _ in range(60):
        world.step(Control(acceleration=-2.0, steering=0.0))
    gap = world.motion.x - agent(world)["position"][0]
    assert 4.0 < gap < 12.0


def test_an_oncoming_car_keeps_to_its_lane(street):
    world = street()
    place = {"ahead": 60.0, "offset": 3.5, "oncoming": True}
    world.apply([Spawn(recorded_id="car", place=place, speed=8.0)])
    for _ in range(30):
        world.step(COAST)
    found = agent(world)
    assert found["velocity"][0] < -5.0
    assert found["position"][1] == pytest.approx(3.5, abs=0.05)


def test_a_world_pose_and_a_driver_can_be_given(street):
    world = street()
    pose = {"position": (50.0, -2.0, 5.0), "quaternion": (1.0, 0.0, 0.0, 0.0)}
    spec = {"pose": pose, "speed": 6.0, "driver": {"kind": "constant_velocity"}}
    world.apply([Spawn(recorded_id="car", object_id="mine", **spec)])
    assert agent(world, "mine")["position"] == pytest.approx([50.0, -2.0, 0.8])
    for _ in range(10):
        world.step(COAST)
    assert agent(world, "mine")["position"] == pytest.approx([56.0, -2.0, 0.8])


def test_an_external_driver_follows_the_agent_plan(street):
    world = street()
    world.apply([Spawn(**AHEAD, driver={"kind": "external"})])
    world.set_agent_plan("spawned_1", [world.t_us + 100_000], [(25.0, 1.0, 0.5)])
    world.step(COAST)
    assert agent(world)["position"][:2] == pytest.approx([25.0, 1.0])


def test_a_deleted_spawned_car_disappears(street):
    world = street()
    world.apply([Spawn(**AHEAD)])
    world.step(COAST)
    world.apply([Delete(object_id="spawned_1")])
    assert agent(world) is None
    world.step(COAST)
    assert agent(world) is None


def test_a_spawned_car_can_appear_later(street):
    world = street()
    world.apply([Spawn(**AHEAD, start_us=world.t_us + 500_000)])
    seen = []
    for _ in range(8):
        world.step(COAST)
        seen.append(agent(world) is not None)
    assert seen == [False] * 4 + [True] * 4


def test_a_car_spawned_beyond_the_log_crosses_the_seam(street):
    world = street(beyond_log="loop", horizon=300)
    while world.steps < 230:
        world.step(COAST)
    world.apply([Spawn(**AHEAD | {"speed": 10.0})])
    while world.lap < 2:
        world.step(COAST)
    gap = agent(world)["position"][0] - world.motion.x
    assert 20.0 < gap < 45.0


def test_a_car_spawned_in_a_scenario_drives_in_every_episode(make_scene, moving):
    scene = make_scene(car=moving(40, 9, z=0.8))
    pose = {"position": (30.0, 0.0, 0.0)}
    spawn = Spawn(recorded_id="car", pose=pose, speed=8.0)
    state = apply_operations(ScenarioState.of(scene), [spawn]).state
    kept = unpack_state(ScenarioState.of(scene), pack_state(state))
    for begun in (state, kept):
        world = World(scene, begun, ResetSpec(**CONTROL))
        for _ in range(40):
            world.step(Control(acceleration=-3.0, steering=0.0))
        assert agent(world)["velocity"][0] == pytest.approx(8.0, abs=0.5)


def test_the_driver_of_the_reset_takes_precedence(make_scene, moving):
    scene = make_scene(car=moving(40, 9, z=0.8))
    pose = {"position": (30.0, 0.0, 0.0)}
    state = apply_operations(
        ScenarioState.of(scene), [Spawn(recorded_id="car", pose=pose, speed=8.0)]
    ).state
    drivers = {"spawned_1": {"kind": "hard_brake", "gap": 100.0, "delay": 0.0}}
    world = World(scene, state, ResetSpec(**CONTROL, agents={"drivers": drivers}))
    for _ in range(20):
        world.step(COAST)
    assert agent(world)["velocity"][0] == 0.0


def test_spawned_cars_are_part_of_replay(make_scene, moving):
    scene = make_scene(car=moving(40, 9, z=0.8))

    def replayer() -> Replayer:
        return Replayer.on(scene, ScenarioState.of(scene))

    spec = ResetSpec(**CONTROL)
    operations = [Spawn(**AHEAD), Spawn(**AHEAD | {"place": {"ahead": 45.0}})]
    external = Spawn(**AHEAD | {"place": {"ahead": 60.0}}, driver={"kind": "external"})
    entries = [Entry("reset", 0, reset_payload(spec))]
    entries += [Entry("action", k, action_payload(COAST)) for k in range(5)]
    entries += [Entry("edit", 5, edit_payload([*operations, external]))]
    entries += [Entry("agent", 5, agent_payload("spawned_3", [6_000_000], [(90.0, 3.0, 0.0)]))]
    entries += [Entry("action", k, action_payload(COAST)) for k in range(5, 9)]
    entries += [Entry("edit", 9, edit_payload([Delete(object_id="spawned_1")]))]
    entries += [Entry("action", k, action_payload(COAST)) for k in range(9, 12)]
    made = record(replayer(), entries, scene_hash="h")
    assert first_difference(made, replayer()) is None
    assert made.instants[-1].others.ids == ("car", "spawned_2", "spawned_3")


def test_a_fork_continues_identically(street):
    world = street()
    world.apply([Spawn(**AHEAD)])
    world.step(COAST)
    fork = world.fork()
    world.step(COAST)
    fork.step(COAST)
    assert digest(fork) == digest(world)


def test_a_place_relative_to_the_ego_needs_a_session(make_scene, moving):
    state = ScenarioState.of(make_scene(car=moving(40, 9, z=0.8)))
    with pytest.raises(EditError, match="running session") as refused:
        apply_operations(state, [Spawn(**AHEAD)])
    assert refused.value.code == ErrorCode.INVALID_OPERATION


@pytest.mark.parametrize(
    "wrong",
    [
        {"recorded_id": "car"},
        {"place": {"ahead": 5.0}},
        {"recorded_id": "car", "asset_id": "a", "place": {"ahead": 5.0}},
        {"recorded_id": "car", "place": {"ahead": 5.0}, "pose": {"position": (0, 0, 0)}},
    ],
)
def test_a_spawn_needs_exactly_one_look_and_one_place(wrong):
    with pytest.raises(ValidationError, match="either"):
        Spawn(**wrong)


def test_an_unknown_look_is_refused(street):
    with pytest.raises(EditError, match="no object 'ghost'"):
        street().apply([Spawn(recorded_id="ghost", place={"ahead": 30.0})])


def test_idm_follows_the_bend_of_the_route(make_scene, moving):
    from real2sim_server.scene import Trajectory

    times = moving(0).times_us
    angle = (times - times[0]) * 1e-6 * 10.0 / 60.0
    ego = Trajectory(
        times,
        np.stack([60 * np.sin(angle), 60 * (1 - np.cos(angle)), 0 * angle], axis=1),
        np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1),
    )
    scene = make_scene(ego, car=moving(40, 90, z=0.8))
    world = World(scene, ScenarioState.of(scene), ResetSpec(**CONTROL, on_collision="continue"))
    world.apply([Spawn(recorded_id="car", place={"ahead": 20.0, "offset": 3.0}, speed=8.0)])
    for _ in range(30):
        world.step(COAST)
    x, y, _ = agent(world)["position"]
    assert np.hypot(x, y - 60.0) == pytest.approx(57.0, abs=0.1)
