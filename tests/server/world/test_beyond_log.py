"""Episodes longer than the recording: loops, extended routes and spawned road users."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import OPERATION, Translate
from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import Trajectory
from real2sim_server.world import World, WorldError
from real2sim_server.world.path import LoggedPath
from real2sim_server.world.recording import digest, record, recording_of_bytes, to_bytes
from real2sim_server.world.replay import Entry, Replayer, action_payload, reset_payload, stored_spec

COAST = Control(acceleration=0.0, steering=0.0)
CONTROL = {"action": "control", "privileged": True}
LOOP = {"beyond_log": "loop", "horizon": 300}
SPAWN = {"density": 40, "lanes": [{"offset": 0.0}, {"offset": 3.5, "oncoming": True}]}
LENGTH = 120.0
"""Length of the recorded drive [m]: 12 s at 10 m/s."""


def bend(radius: float = 120.0, speed: float = 10.0) -> Trajectory:
    """A left bend at constant speed."""
    times = 5_000_000 + np.arange(121) * 100_000
    angle = (times - times[0]) * 1e-6 * speed / radius
    positions = np.stack(
        [radius * np.sin(angle), radius * (1 - np.cos(angle)), np.zeros(len(angle))], axis=1
    )
    return Trajectory(times, positions, np.stack([yaw_quaternion(a) for a in angle]))


def following(world: World, *, speed: float = 10.0) -> TrajectoryPlan:
    """A plan along the route of the observation."""
    route = np.vstack([[0.0, 0.0], world.observe().route])
    ways = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
    at = speed * 0.25 * np.arange(1, 9)
    x, y = np.interp(at, ways, route[:, 0]), np.interp(at, ways, route[:, 1])
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    times = tuple(world.t_us + 250_000 * k for k in range(1, 9))
    return TrajectoryPlan(times_us=times, poses=list(zip(x, y, yaw, strict=True)))


def spawned(world: World) -> list[str]:
    return [o.object_id for o in world.agents.objects if o.object_id.startswith("spawned:")]


# --- the clock ------------------------------------------------------------------------------------


def test_a_horizon_beyond_the_log_is_refused_by_default(make_world):
    with pytest.raises(WorldError, match="longer than the 120 steps") as refused:
        make_world(spec={"horizon": 200})
    assert refused.value.code == ErrorCode.TIME_OUT_OF_RANGE
    assert "beyond_log" in str(refused.value.hint)


@pytest.mark.parametrize("beyond_log", ["loop", "extend"])
def test_without_a_horizon_an_episode_lasts_an_hour(make_world, beyond_log):
    world = make_world(spec=CONTROL | {"beyond_log": beyond_log})
    assert world.horizon == 36_000
    for _ in range(130):
        world.step(COAST)
    assert not world.over
    assert ResetSpec(beyond_log=beyond_log, dt_us=1000, horizon=None).horizon == 1_000_000


def test_stored_episodes_without_a_horizon_end_with_the_log():
    fields = ResetSpec(beyond_log="loop", horizon=5).model_dump()
    assert stored_spec(fields).horizon == 5
    assert stored_spec(fields | {"horizon": None}).horizon is None
    assert ResetSpec().horizon is None


def test_a_loop_matches_the_log_before_its_end(make_world, moving):
    car = moving(40, 0, z=0.8, speed=6.0)
    as_today = make_world(car=car, spec=CONTROL | {"horizon": 60})
    looping = make_world(car=car, spec=CONTROL | {"horizon": 60, "beyond_log": "loop"})
    for _ in range(60):
        as_today.step(COAST)
        looping.step(COAST)
        assert digest(looping) == digest(as_today)


# --- extend ---------------------------------------------------------------------------------------


def test_an_extended_route_continues_its_bend_and_straightens(make_world):
    world = make_world(bend(), spec=CONTROL | {"beyond_log": "extend", "horizon": 400})
    path, end = world._path, LoggedPath(bend()).length
    yaws = [path.at(end + way)[3] for way in (0.0, 20.0, 40.0, 150.0, 300.0)]
    assert yaws[1] - yaws[0] == pytest.approx(20 / 120, rel=0.3)
    assert 0 < yaws[2] - yaws[1] < yaws[1] - yaws[0]
    assert yaws[4] == pytest.approx(yaws[3], abs=0.02)


def test_an_extended_episode_is_driven_to_its_horizon_and_scored(make_world):
    spec = {"beyond_log": "extend", "horizon": 300, "privileged": True}
    world = make_world(bend(), spec=spec)
    while not world.over:
        world.step(following(world))
    metrics = world.metrics()
    assert world.reason == "horizon"
    assert world.steps == 300
    assert metrics["route_progress"] == pytest.approx(300.0, abs=5.0)
    assert metrics["on_road"] == 1.0
    assert metrics["route_completion"] == pytest.approx(1.0, abs=0.02)
    assert abs(metrics["lateral_offset"]) < 0.3


# --- loop -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def laps(make_world):
    """A 30 s drive on a 12 s loop: the final world, all events and all motions."""
    world = make_world(bend(), spec=LOOP | {"privileged": True, "ego": {"tracker": "lqr"}})
    events, motions = [], [world.motion]
    while not world.over:
        events += world.step(following(world))
        motions.append(world.motion)
    return world, events, motions


def test_the_ego_returns_to_the_start_with_an_event_for_each_lap(laps):
    world, events, _ = laps
    looped = [e for e in events if e.type == "looped"]
    assert [e.data["lap"] for e in looped] == [1.0, 2.0]
    assert world.lap == 2
    assert world.observe().obs_fields()["lap"] == 2


def test_the_looped_event_holds_the_transform_across_the_seam(laps):
    _, events, motions = laps
    seam = next(e for e in events if e.type == "looped")
    k = (seam.t_us - 5_000_000) // 100_000
    before, after = motions[k], motions[k + 1]
    turn, x, y = (seam.data[name] for name in ("turn", "x", "y"))
    moved = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    here = moved @ [before.x, before.y] + [x, y]
    assert math.dist(here, (after.x, after.y)) == pytest.approx(before.speed * 0.1, abs=0.1)


def test_scores_are_continuous_across_the_seam(laps):
    world, _, _ = laps
    metrics = world.metrics()
    assert metrics["distance"] == pytest.approx(300.0, abs=5.0)
    assert metrics["route_progress"] == pytest.approx(300.0, abs=5.0)
    assert metrics["comfortable"] == 1.0
    assert metrics["on_road"] == 1.0
    assert metrics["pdms"] == pytest.approx(1.0, abs=0.02)
    infeasible = next(s for s in world.scores() if s.name == "kinematic_infeasibility")
    assert infeasible.value == 0.0


@pytest.mark.parametrize("action", ["trajectory", "pose"])
def test_world_frame_plans_are_transformed_across_the_seam(make_world, action):
    world = make_world(bend(), spec=LOOP | {"action": action, "horizon": 200})
    while world.steps < 119:
        ahead = world._path.at(world._path_point.s + 1.0)
        if action == "pose":
            plan = PoseCommand(x=ahead[0], y=ahead[1], yaw=ahead[3])
        else:
            plan = following(world)
        world.step(plan)
    times = [world.t_us + 100_000 * k for k in range(1, 11)]
    places = [world._path.at(world._path_point.s + 1.0 * k) for k in range(1, 11)]
    if action == "pose":
        world.step(PoseCommand(x=places[0][0], y=places[0][1], yaw=places[0][3]))
        world.step(PoseCommand(x=places[1][0], y=places[1][1], yaw=places[1][3]))
    else:
        poses = [(x, y, yaw) for x, y, _, yaw in places]
        world.step(TrajectoryPlan(times_us=times, poses=poses, frame="world"))
        for _ in range(7):
            world.step()
        assert world.lap == 1
    assert abs(world.observe().metrics["lateral_offset"]) < 0.3


def test_parked_cars_stay_and_moving_cars_leave_after_a_lap(make_world, moving):
    cars = {"parked": moving(50, 6, z=0.8), "mover": moving(40, 0, z=0.8, speed=12.0)}
    world = make_world(spec=CONTROL | LOOP, **cars)
    while world.steps < 150:
        world.step(COAST)
    assert world.lap == 1
    assert [o.object_id for o in world.agents.objects] == ["parked"]


def test_duplicate_tracks_of_a_parked_car_are_merged(make_scene, moving):
    whole = moving(50, 6, z=0.8)
    first = Trajectory(whole.times_us[:60], whole.positions[:60], whole.quaternions[:60])
    shifted = whole.positions[70:] + np.array([0.4, 0.1, 0.0])
    later = Trajectory(whole.times_us[70:], shifted, whole.quaternions[70:])
    scene = make_scene(first=first, later=later)
    world = World(scene, ScenarioState.of(scene), ResetSpec(**CONTROL, **LOOP))
    for _ in range(150):
        world.step(COAST)
    assert [o.object_id for o in world.agents.objects] == ["first"]


def test_an_edit_in_a_later_lap_takes_effect(make_world, moving):
    world = make_world(spec=CONTROL | LOOP, parked=moving(50, 6, z=0.8))
    for _ in range(140):
        world.step(COAST)
    world.apply([Translate(object_id="parked", y=2.0)])
    world.step(COAST)
    assert world.agents.positions[0, 1] == pytest.approx(8.0)


def test_drivers_keep_their_plans_after_an_edit_despite_other_episodes(make_scene, moving):
    scene = make_scene(driven=moving(50, 6, z=0.8), other=moving(70, 6, z=0.8))
    state = ScenarioState.of(scene)
    agents = {"drivers": {"driven": {"kind": "external"}}}
    world = World(scene, state, ResetSpec(**CONTROL, **LOOP, agents=agents))
    world.set_agent_plan("driven", [world.t_us + 1_000_000], [(60.0, 6.0, 0.0)])
    World(scene, state, ResetSpec(**CONTROL, **LOOP | {"horizon": 200}))
    world.step(COAST)
    world.apply([Translate(object_id="other", y=1.0)])
    for _ in range(9):
        world.step(COAST)
    places = {
        o.object_id: p for o, p in zip(world.agents.objects, world.agents.positions, strict=True)
    }
    assert places["driven"][0] == pytest.approx(60.0)


def test_a_drive_too_short_to_loop_is_refused(make_world, moving):
    with pytest.raises(WorldError, match="too short to be driven in a loop"):
        make_world(moving(speed=1.0), spec=LOOP)


# --- spawned road users ---------------------------------------------------------------------------


@pytest.fixture
def street(make_world, moving):
    """Make a looped episode with spawned cars."""

    def make(seed: int = 0, *, spec: dict | None = None, **spawn):
        agents = {"spawn": SPAWN | spawn}
        cars = {"look": moving(30, 8, z=0.8, speed=8.0), "parked": moving(60, -6, z=0.8)}
        fields = LOOP | {"privileged": True, "seed": seed, "agents": agents} | (spec or {})
        return make_world(spec=fields, **cars)

    return make


def test_spawned_cars_appear_and_disappear_without_contact(street):
    world, seen, most = street(), set(), 0
    while not world.over:
        world.step(following(world, speed=8.0))
        seen |= set(spawned(world))
        most = max(most, len(spawned(world)))
        assert not world._contacts.touching
    assert world.reason == "horizon"
    assert len(seen) > 12
    assert 2 <= most <= 16
    assert len(spawned(world)) < len(seen)


def test_cars_spawn_10_to_80_metres_from_the_ego(street):
    world, before = street(), set()
    for _ in range(150):
        now = set(spawned(world))
        for k, subject in enumerate(world.agents.objects):
            if subject.object_id in now - before:
                away = math.hypot(
                    *(world.agents.positions[k, :2] - [world.motion.x, world.motion.y])
                )
                assert 10.0 < away < 80.0
        before = now
        world.step(following(world))


def test_oncoming_cars_drive_against_the_ego_in_their_lane(street):
    world = street(lanes=[{"offset": 3.5, "oncoming": True}], density=60)
    for _ in range(60):
        world.step(following(world))
        for k, subject in enumerate(world.agents.objects):
            if subject.object_id.startswith("spawned:"):
                assert world.agents.velocities[k, 0] <= 0.0
                assert world.agents.positions[k, 1] == pytest.approx(3.5, abs=0.2)


def test_spawned_cars_have_unique_ids_and_instances(street):
    world = street(density=100)
    for _ in range(100):
        world.step(following(world))
        objects = world.agents.objects
        assert len({o.object_id for o in objects}) == len(objects)
        assert len({o.instance_id for o in objects}) == len(objects)


def test_the_number_of_spawned_cars_is_limited(street):
    world = street(density=200, most=3)
    for _ in range(60):
        world.step(following(world))
        assert len(spawned(world)) <= 3


def test_spawning_depends_only_on_the_seed(street):
    def drive(seed: int) -> list[str]:
        world, found = street(seed), []
        for _ in range(80):
            world.step(following(world))
            found.append(digest(world))
        return found

    assert drive(1) == drive(1)
    assert drive(1) != drive(2)


def test_an_edit_keeps_spawned_cars(street):
    world = street()
    for _ in range(30):
        world.step(following(world))
    before = spawned(world)
    world.apply([Translate(object_id="parked", y=-1.0)])
    assert spawned(world) == before != []


def test_editing_a_randomly_spawned_road_user_is_refused():
    with pytest.raises(ValueError, match=r"'spawned:1' was created by agents.spawn .* 'spawned_1'"):
        Translate(object_id="spawned:1", y=-1.0)
    with pytest.raises(ValueError, match="cannot be edited"):
        OPERATION.validate_python({"op": "delete", "object_id": "spawned:1"})


def test_spawned_cars_can_be_struck(street):
    # No driver can avoid an ego that approaches at 20 m/s.
    world = street(
        spec={"on_collision": "continue", "action": "control"}, lanes=[{"offset": 0.0}], density=60
    )
    hit = None
    while hit is None and not world.over:
        for event in world.step(Control(acceleration=4.0, steering=0.0)):
            hit = event.object_id if event.type == "collision" else hit
    assert hit.startswith("spawned:")


def test_an_unknown_look_is_refused(street):
    with pytest.raises(WorldError, match="'ghost', which is not an object") as refused:
        street(looks=["ghost"])
    assert refused.value.code == ErrorCode.UNKNOWN_OBJECT


def test_spawning_needs_a_vehicle_in_the_scene(make_world):
    with pytest.raises(WorldError, match="has no appearance"):
        make_world(spec={"agents": {"spawn": SPAWN}})


def test_cars_also_spawn_in_episodes_that_end_with_the_log(street):
    world = street(spec={"beyond_log": "end", "horizon": 100})
    while not world.over:
        world.step(following(world))
    assert world.reason == "horizon"
    assert spawned(world)


# --- replay ---------------------------------------------------------------------------------------


def test_recorded_laps_with_traffic_replay_with_the_same_scores(make_scene, moving):
    scene = make_scene(bend(), look=moving(30, 8, z=0.8, speed=8.0))
    beside = {"density": 40, "lanes": [{"offset": 3.5, "oncoming": True}]}
    spec = ResetSpec(**LOOP, privileged=True, seed=3, agents={"spawn": beside})
    world = World(scene, ScenarioState.of(scene), spec)
    entries, found = [Entry("reset", 0, reset_payload(spec))], []
    while not world.over and world.steps < 160:
        plan = following(world, speed=9.0)
        entries.append(Entry("action", world.steps, action_payload(plan)))
        world.step(plan)
        found.append(digest(world))
    made = record(Replayer.on(scene, ScenarioState.of(scene)), entries, scene_hash="h")
    read = recording_of_bytes(to_bytes(made), "it")
    assert list(read.digests[1:]) == found
    assert world.lap == 1
    assert [s.fields() for s in read.rescore()] == [s.fields() for s in world.scores()]
