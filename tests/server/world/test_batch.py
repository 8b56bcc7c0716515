"""Batched worlds match single worlds: motions, objects, contacts and episode ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from real2sim_proto.base import Pose
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import EraseRegion
from real2sim_proto.plans import Control, TrajectoryPlan
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState, apply_operations
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed
from real2sim_server.world import World
from real2sim_server.world.batch import BatchWorld
from real2sim_server.world.common import WorldError

CLOSE = 1e-9
PLAN_US = np.arange(1, 11) * 200_000


@pytest.fixture(scope="module")
def street() -> Scene:
    return read_packed(SHIPPED)


def compare(batch: BatchWorld, w: int, world: World, at_fault: int) -> None:
    """Assert that world ``w`` of the batch equals the single world."""
    assert np.array(world.motion.numbers) == pytest.approx(batch.motions[w], abs=CLOSE)
    assert world.T_world_vehicle == pytest.approx(batch.poses[w], abs=CLOSE)
    assert world.T_world_body == pytest.approx(batch.body_pose(w), abs=CLOSE)
    assert world.path_point.s == pytest.approx(batch.route_s[w], abs=CLOSE)
    assert world.path_point.offset == pytest.approx(batch.route_offset[w], abs=CLOSE)
    assert world.observe().route == pytest.approx(batch.routes()[w], abs=1e-4)
    ours, theirs = batch.agents(w), world.agents
    rows = {o.object_id: k for k, o in enumerate(ours.objects)}
    assert set(rows) == {o.object_id for o in theirs.objects}
    order = [rows[o.object_id] for o in theirs.objects]
    for name in ("positions", "quaternions", "velocities", "sizes", "transforms"):
        assert getattr(ours, name)[order] == pytest.approx(getattr(theirs, name), abs=CLOSE)
    assert (world.terminated, world.truncated) == (batch.terminated[w], batch.truncated[w])
    assert world.accumulator.off_road == batch.off_road[w]
    assert world.contacts.touching == batch.touching[w]
    ids = [i.instance_id for i in world.instances()]
    assert sorted(i.instance_id for i in batch.instances(w)) == sorted(ids)
    assert sum(world.accumulator.at_fault.values()) == at_fault


def drive_beside(
    scene: Scene, fields: dict[str, Any], worlds: int, steps: int, plan_us: Any = PLAN_US
) -> BatchWorld:
    """A batch, compared after each step with single worlds that take the same actions."""
    spec, state = ResetSpec(**fields), ScenarioState.of(scene)
    batch = BatchWorld(scene, spec, worlds, state=state)
    single = [World(scene, state, spec) for _ in range(worlds)]
    random = np.random.default_rng(4)
    bias = random.uniform(-0.03, 0.03, worlds)
    for _ in range(steps):
        running = ~batch.over
        speeds = random.uniform(2.0, 14.0, worlds)
        if spec.action == "control":
            push = random.uniform(-1.0, 3.0, worlds)
            actions = np.stack([push, bias + random.uniform(-0.05, 0.05, worlds)], axis=1)
            plans: list[Any] = [Control(acceleration=a, steering=b) for a, b in actions.tolist()]
            done = batch.step(actions)
        else:
            way = speeds[:, None] * plan_us * 1e-6
            actions = np.stack([way, bias[:, None] * way, 0 * way + bias[:, None]], axis=2)
            now = batch.times_us
            plans = [
                TrajectoryPlan(
                    times_us=(now[w] + plan_us).tolist(), poses=actions[w].tolist(), frame="vehicle"
                )
                for w in range(worlds)
            ]
            done = batch.step(actions, plan_us=plan_us)
        for w in np.flatnonzero(running).tolist():
            single[w].step(plans[w])
            compare(batch, w, single[w], int(done.at_fault[w]))
    return batch


@pytest.mark.parametrize(
    "fields",
    [
        {"action": "control"},
        {"action": "control", "agents": {"default": "idm"}},
        {"action": "control", "ego": {"dynamics": "dynamic_bicycle"}, "dt_us": 40_000},
        {"action": "control", "dt_us": 500_000},
        {"action": "trajectory", "ego": {"tracker": "lqr"}},
        {"action": "trajectory", "ego": {"tracker": "pursuit", "dynamics": "dynamic_bicycle"}},
    ],
)
def test_batched_worlds_match_single_worlds(street: Scene, fields: dict[str, Any]) -> None:
    drive_beside(street, fields, worlds=5, steps=30)


def test_successive_single_pose_plans_match_single_worlds(street: Scene) -> None:
    fields = {"action": "trajectory", "ego": {"tracker": "lqr"}}
    drive_beside(street, fields, worlds=3, steps=15, plan_us=np.array([200_000]))


def test_contacts_end_episodes_as_in_single_worlds(street: Scene) -> None:
    batch = drive_beside(street, {"action": "control"}, worlds=8, steps=45)
    assert batch.terminated.any()
    assert batch.off_road.any()


def test_objects_appear_and_disappear_as_in_single_worlds(
    make_scene: Callable[..., Scene], moving: Callable[..., Any]
) -> None:
    def during(trajectory: Any, first: int, last: int) -> Any:
        part = slice(first, last)
        parts = (trajectory.times_us, trajectory.positions, trajectory.quaternions)
        return type(trajectory)(*(values[part] for values in parts))

    scene = make_scene(
        ahead=moving(14, speed=8.0),
        comes=during(moving(30, 4, speed=5.0), 8, 60),
        goes=during(moving(-20, -4, speed=9.0), 0, 12),
    )
    for default in ("log", "idm"):
        fields = {"action": "control", "agents": {"default": default}, "horizon": 40}
        drive_beside(scene, fields, worlds=3, steps=40)


def test_brake_lamps_show_as_in_single_worlds(
    make_scene: Callable[..., Scene], moving: Callable[..., Any]
) -> None:
    scene = make_scene(car=moving(14, speed=8.0), stands=moving(60))
    spec, state = ResetSpec(action="control", agents={"default": "idm"}), ScenarioState.of(scene)
    batch, world = BatchWorld(scene, spec, 1, state=state), World(scene, state, spec)
    seen = []
    for _ in range(50):
        batch.step([[-4.0, 0.0]])
        world.step(Control(acceleration=-4.0, steering=0.0))
        shown = batch.shown([0])
        assert shown is not None
        lit = world.lamps == {"car": ("brake",)}
        assert shown.there[0].tolist() == [True, True, True, lit]
        assert len(world.instances()) == len(batch.instances(0)) == 3 + lit
        seen.append(lit)
    assert not seen[0]
    assert seen[-1]


def test_reset_restarts_only_the_selected_worlds(street: Scene) -> None:
    spec = ResetSpec(action="control", horizon=3)
    batch = BatchWorld(street, spec, 4)
    first = batch.motions.copy()
    for _ in range(3):
        batch.step(np.tile([2.0, 0.0], (4, 1)))
    assert batch.truncated.all()
    later = street.start_us + 2_000_000
    batch.reset(np.array([1, 3]), start_us=[None, later])
    assert batch.over.tolist() == [True, False, True, False]
    assert np.array_equal(batch.motions[1], first[1])
    assert batch.times_us[3] == later
    world = World(street, ScenarioState.of(street), spec.model_copy(update={"start_us": later}))
    batch.step(np.tile([2.0, 0.0], (4, 1)))
    world.step(Control(acceleration=2.0, steering=0.0))
    compare(batch, 3, world, 0)


def test_finished_worlds_do_not_move(street: Scene) -> None:
    batch = BatchWorld(street, ResetSpec(action="control", horizon=1), 2)
    batch.step(np.zeros((2, 2)))
    before = batch.motions.copy(), batch.times_us.copy()
    done = batch.step(np.ones((2, 2)))
    assert np.array_equal(batch.motions, before[0])
    assert np.array_equal(batch.times_us, before[1])
    assert done.progress.tolist() == [0.0, 0.0]


def test_results_do_not_depend_on_the_number_of_threads(street: Scene) -> None:
    threads, found = numba.get_num_threads(), []
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            batch = BatchWorld(street, ResetSpec(action="control"), 7)
            for k in range(15):
                batch.step(np.tile([1.0, 0.01 * k], (7, 1)))
            found.append(batch.motions.copy())
    finally:
        numba.set_num_threads(threads)
    assert np.array_equal(found[0], found[-1])


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"action": "pose"}, "action"),
        ({"on_collision": "continue"}, "on_collision"),
        ({"ego": {"tracker": "ilqr"}}, "ego.tracker"),
        ({"ego": {"tracker": "perfect"}}, "ego.tracker"),
        ({"ego": {"actuators": {"drive_delay_us": 50_000}}}, "ego.actuators"),
        ({"agents": {"default": "constant_velocity"}}, "agents.default"),
        ({"agents": {"drivers": {"car_0": {"kind": "idm"}}}}, "agents"),
        ({"warmup_us": 100_000}, "warmup_us"),
        ({"latency": {"model": "fixed", "fixed_us": 1}}, "latency"),
        ({"contact": {"background": True}}, "contact.background"),
        ({"beyond_log": "extend"}, "beyond_log"),
    ],
)
def test_unsupported_options_are_refused(street: Scene, fields: dict[str, Any], named: str) -> None:
    with pytest.raises(WorldError, match=named):
        BatchWorld(street, ResetSpec(**fields), 2)


@pytest.mark.parametrize(
    ("action", "actions", "plan_us"),
    [
        ("control", np.zeros((3, 2)), None),
        ("control", np.full((2, 2), np.nan), None),
        ("trajectory", np.zeros((2, 2, 3)), [100_000, 100_000]),
        ("trajectory", np.zeros((2, 2, 3)), None),
    ],
)
def test_malformed_actions_are_refused(
    street: Scene, action: str, actions: np.ndarray, plan_us: list[int] | None
) -> None:
    batch = BatchWorld(street, ResetSpec(action=action), 2)
    with pytest.raises(ValueError, match=r"actions|plan_us"):
        batch.step(actions, plan_us=plan_us)


@pytest.mark.parametrize("default", ["log", "idm"])
def test_shown_arrays_match_the_instances(street: Scene, default: Any) -> None:
    batch = BatchWorld(street, ResetSpec(action="control", agents={"default": default}), 2)
    batch.reset([1], start_us=[street.start_us + 3_000_000])
    shown = batch.shown([0, 1])
    assert shown is not None
    for w in (0, 1):
        drawn = batch.instances(w)
        there = np.flatnonzero(shown.there[w]).tolist()
        assert [shown.things[k].instance_id for k in there] == [i.instance_id for i in drawn]
        assert all(shown.things[k].cloud is i.cloud for k, i in zip(there, drawn, strict=True))
        for k, instance in list(zip(there, drawn, strict=True))[1:]:
            assert np.array_equal(shown.poses[w, k], instance.T_world_object)
            assert shown.times_us[w] == instance.t_us


def test_edited_worlds_have_no_shared_arrays(street: Scene) -> None:
    region = EraseRegion(pose=Pose(position=(0, 0, 0)), size=(1, 1, 1))
    state = apply_operations(ScenarioState.of(street), [region]).state
    assert BatchWorld(street, ResetSpec(action="control"), 2, state=state).shown([0]) is None
