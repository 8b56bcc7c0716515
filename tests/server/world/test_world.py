from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto import ErrorCode, encode
from real2sim_proto.drive import Obs, ResetSpec
from real2sim_proto.operations import Delete, Duplicate, Translate
from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
from real2sim_server.edit import EditError, ScenarioState
from real2sim_server.world import World, WorldError

CONTROL = {"action": "control"}
POSE = {"action": "pose"}
COAST = Control(acceleration=0.0, steering=0.0)


def observed(world: World) -> bytes:
    return encode(world.observe().obs_fields())


def test_an_episode_starts_at_the_recorded_state(make_world):
    world = make_world(spec={"start_us": 6_000_000})

    assert (world.steps, world.t_us, world.over) == (0, 6_000_000, False)
    assert world.motion.speed == pytest.approx(10.0)
    recorded = world.scene.ego.transform(6_000_000)
    np.testing.assert_allclose(world.T_world_vehicle, recorded, atol=1e-12)


def test_observations_are_valid_messages(make_world, moving):
    world = make_world(car=moving(30, 5, z=0.8), spec={"privileged": True})
    world.step()
    obs = Obs(frames=[], **world.observe().obs_fields())

    assert (obs.step, obs.t_us) == (1, 5_100_000)
    assert obs.ego.position == pytest.approx((1, 0, 0), abs=1e-3)
    assert obs.ego.size == world.scene.ego_size
    assert [a.object_id for a in obs.agents] == ["car"]
    assert {"distance", "route_progress", "collisions", "pdms"} <= set(obs.metrics)


def test_agents_are_filled_only_when_privileged(make_world, moving):
    assert make_world(car=moving(30, 5)).observe().obs_fields()["agents"] == []


def test_agents_move_as_recorded(make_world, moving):
    world = make_world(car=moving(30, 5, speed=4.0, yaw=np.pi / 2), spec={"privileged": True})
    for _ in range(5):
        world.step()
    (agent,) = world.observe().obs_fields()["agents"]

    assert agent["position"] == pytest.approx([30, 7, 0])
    assert agent["velocity"] == pytest.approx([0, 4, 0], abs=1e-9)
    assert agent["size"] == pytest.approx([4, 2, 1.6])


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.1, -2.5])
def test_the_ego_quaternion_matches_its_pose(make_world, moving, yaw):
    world = make_world(moving(speed=5.0, yaw=yaw))
    w, x, y, z = world.observe().ego_fields()["quaternion"]

    assert (x, y) == pytest.approx((0, 0))
    assert np.exp(1j * yaw) == pytest.approx((w + 1j * z) ** 2)


def test_control_actuates_directly(make_world):
    ideal = {"actuators": {"steering_lag": 0.0, "drive_lag": 0.0}}
    world = make_world(spec={**CONTROL, "ego": ideal})
    for _ in range(10):
        world.step(Control(acceleration=-2.0, steering=0.1))

    assert world.motion.speed == pytest.approx(8.0)
    assert world.motion.steering == pytest.approx(0.1)


def test_pose_places_the_ego_on_the_ground(make_world):
    world = make_world(spec=POSE)
    world.step(PoseCommand(x=2.0, y=0.5, yaw=0.1))

    np.testing.assert_allclose(world.T_world_vehicle[:3, 3], [2, 0.5, 0], atol=1e-12)
    assert world.motion.yaw == pytest.approx(0.1)
    assert world.motion.speed == pytest.approx(
        (2 * np.cos(0.05) + 0.5 * np.sin(0.05)) / np.sinc(0.05 / np.pi) / 0.1
    )


def test_no_plan_keeps_the_last_one(make_world):
    kept, repeated = make_world(spec=CONTROL), make_world(spec=CONTROL)
    plan = Control(acceleration=1.0, steering=0.2)
    kept.step(plan)
    kept.step()
    repeated.step(plan)
    repeated.step(plan)

    assert kept.motion == repeated.motion


@pytest.mark.parametrize("action", ["trajectory", "control", "pose"])
def test_the_log_is_followed_before_the_first_plan(make_world, action):
    world = make_world(spec={"action": action})
    for _ in range(10):
        world.step()

    assert world.motion.x == pytest.approx(10.0, abs=0.01)


def test_a_plan_of_another_kind_is_refused_and_changes_nothing(make_world):
    world = make_world()
    before = observed(world)

    with pytest.raises(WorldError, match=r"'control' in an episode .* 'trajectory'") as refused:
        world.step(COAST)

    assert refused.value.code == ErrorCode.INVALID_ACTION
    assert observed(world) == before


def test_a_plan_for_the_past_is_refused(make_world):
    world = make_world()

    with pytest.raises(WorldError, match="it is 5000000 us already") as refused:
        world.step(TrajectoryPlan(times_us=[5_000_000], poses=[(1, 0, 0)]))

    assert refused.value.code == ErrorCode.INVALID_ACTION
    assert "leave out the present pose" in refused.value.hint


def test_the_episode_ends_at_the_end_of_the_log(make_world):
    world = make_world()
    events = []
    while not world.over:
        events += world.step()

    assert world.steps == 120
    assert world.t_us == world.scene.end_us
    assert (world.truncated, world.terminated, world.reason) == (True, False, "horizon")
    assert [e.type for e in events] == ["horizon"]


def test_an_episode_ends_at_its_horizon(make_world):
    world = make_world(spec={"horizon": 3})
    for _ in range(3):
        world.step()

    assert world.truncated


def test_stepping_a_finished_episode_is_refused(make_world):
    world = make_world(spec={"horizon": 1})
    world.step()

    with pytest.raises(WorldError, match="ended at step 1: horizon") as refused:
        world.step()
    assert refused.value.code == ErrorCode.EPISODE_OVER


@pytest.mark.parametrize(
    ("spec", "code", "message"),
    [
        ({"start_us": 4_999_999}, ErrorCode.TIME_OUT_OF_RANGE, r"\[5000000, 17000000\]"),
        ({"start_us": 17_000_000}, ErrorCode.TIME_OUT_OF_RANGE, "does not fit the log"),
        ({"horizon": 121}, ErrorCode.TIME_OUT_OF_RANGE, "120 steps"),
        ({"sensors": [{"camera": "back"}]}, ErrorCode.UNKNOWN_CAMERA, "no camera 'back'"),
        (
            {"sensors": [{"camera": "front", "period_us": 150_000}]},
            ErrorCode.INVALID_REQUEST,
            "not a multiple of dt_us 100000",
        ),
        (
            {"sensors": [{"camera": "front"}, {"camera": "front"}]},
            ErrorCode.INVALID_REQUEST,
            "more than once",
        ),
    ],
)
def test_episodes_that_cannot_run_are_refused(make_world, spec, code, message):
    with pytest.raises(WorldError, match=message) as refused:
        make_world(spec=spec)

    assert refused.value.code == code
    assert refused.value.hint


def test_sensors_are_due_at_their_period(make_world):
    sensors = [{"camera": "front"}, {"camera": "left", "period_us": 300_000}]
    world = make_world(spec={"sensors": sensors})
    due = []
    for _ in range(4):
        due.append([s.camera for s in world.due_sensors()])
        world.step()

    assert due == [["front", "left"], ["front"], ["front"], ["front", "left"]]


def test_metrics_measure_the_drive(make_world):
    world = make_world(spec=POSE)
    world.step(PoseCommand(x=3.0, y=4.0, yaw=0.0))
    world.step(PoseCommand(x=6.0, y=4.0, yaw=0.0))

    expected = {"distance": 8.0, "route_progress": 6.0, "lateral_offset": 4.0, "collisions": 0.0}
    found = world.metrics()
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_leaving_the_recorded_path_is_reported_once(make_world):
    world = make_world(spec=POSE)
    ys = [9.0, 11.0, 12.0, 5.0, -15.0]
    events = [
        [e.type for e in world.step(PoseCommand(x=5.0, y=y, yaw=0.0)) if e.type == "left_log"]
        for y in ys
    ]

    assert events == [[], ["left_log"], [], [], ["left_log"]]


def test_driving_past_the_end_of_the_log_stays_in_lane(make_world):
    world = make_world(spec=POSE)
    events = [e.type for k in range(40) for e in world.step(PoseCommand(x=3.5 * k, y=0.3, yaw=0))]

    assert world.motion.x > world.scene.ego.positions[-1, 0] + 15
    assert events == ["left_log"]
    assert world.metrics()["lateral_offset"] == pytest.approx(0.3)
    assert not world.accumulator.left_lane


def test_an_edit_shows_at_once_and_is_reported_at_the_next_step(make_world, moving):
    world = make_world(car=moving(30, 5), spec={"privileged": True})
    outcome = world.apply([Translate(object_id="car", y=3), Duplicate(object_id="car", x=20)])

    assert outcome.created == ("car_copy1",)
    assert world.revision == 1
    ys = [a["position"][1] for a in world.observe().obs_fields()["agents"]]
    assert ys == [8, 8]
    assert [i.instance_id for i in world.instances()][:3] == [0, 1, 2]
    assert [(e.type, dict(e.data)) for e in world.step()] == [("edited", {"revision": 1.0})]
    assert world.step() == []


def test_a_refused_edit_changes_nothing(make_world, moving):
    world = make_world(car=moving(30, 5))
    before = world.state

    with pytest.raises(EditError):
        world.apply([Delete(object_id="car"), Delete(object_id="car")])

    assert world.state is before
    assert world.revision == 0


def test_an_edit_for_another_revision_is_refused(make_world, moving):
    world = make_world(car=moving(30, 5))
    world.apply([Translate(object_id="car", x=1)])

    with pytest.raises(EditError) as refused:
        world.apply([Translate(object_id="car", x=1)], base_revision=0)
    assert refused.value.code == ErrorCode.STALE_REVISION


def test_an_edit_does_not_affect_other_worlds_of_the_scene(make_scene, moving):
    scene = make_scene(car=moving(30, 5))
    state = ScenarioState.of(scene)
    first, second = (World(scene, state, ResetSpec(privileged=True)) for _ in range(2))
    before = observed(second)
    first.apply([Delete(object_id="car")])
    first.step()

    assert observed(second) == before


def drive_somewhere(world: World) -> list[bytes]:
    """An episode with plans, an edit and a contact."""
    seen = []
    for k in range(30):
        times = [world.t_us + 200_000 * (i + 1) for i in range(5)]
        poses = [(2.1 * (i + 1), 0.02 * k * np.sin(i + k), 0.01 * k) for i in range(5)]
        if k == 10:
            world.apply([Translate(object_id="car", y=-2.0)])
        world.step(TrajectoryPlan(times_us=times, poses=poses))
        seen.append(observed(world))
    return seen


def test_equal_actions_give_equal_results(make_world, moving):
    spec = {"seed": 3, "privileged": True, "on_collision": "continue"}
    first, second = (make_world(car=moving(30, 5, speed=2.0), spec=spec) for _ in range(2))

    assert drive_somewhere(first) == drive_somewhere(second)


def test_a_step_can_be_rendered_before_it_is_evaluated(make_world, moving):
    def drawn(world: World) -> bytes:
        poses = [i.T_world_object for i in world.instances()[1:]]
        return encode({"ego": world.T_world_vehicle, "objects": poses, "t_us": world.t_us})

    spec = {"privileged": True, "on_collision": "continue"}
    world = make_world(car=moving(30, 0, z=0.8, speed=2.0), spec=spec)
    stepped = world.fork()
    while not world.over:
        world.move()
        before = drawn(world)
        world.evaluate()
        stepped.step()
        assert drawn(world) == before
        assert observed(world) == observed(stepped)
    assert world.metrics()["collisions"] > 0


def test_evaluating_again_changes_nothing(make_world):
    world = make_world()
    events = world.step()
    before = observed(world)

    assert world.evaluate() == events
    assert observed(world) == before


def test_a_fork_continues_identically_and_independently(make_world, moving):
    spec = {"privileged": True, "on_collision": "continue"}
    world = make_world(car=moving(60, 5, speed=2.0), spec=spec)
    world.step(TrajectoryPlan(times_us=[world.t_us + 2_000_000], poses=[(20, 3, 0)]))
    copied = world.fork()
    copied.apply([Delete(object_id="car")])
    copied.step()

    assert (world.steps, world.revision, len(world.agents.objects)) == (1, 0, 1)
    assert drive_somewhere(world.fork()) == drive_somewhere(world)


def test_a_level_ego_has_no_minus_zeros_on_the_wire(make_world):
    fields = make_world().observe().ego_fields()

    assert "-0.0" not in str(fields["quaternion"])
