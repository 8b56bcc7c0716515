"""Deformation after impacts: what is drawn of an object, always alike."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import transform_from, yaw_quaternion
from real2sim_server.scene import GaussianCloud, SceneObject
from real2sim_server.simulation import impact as crash
from real2sim_server.world import World
from real2sim_server.world.replay import Entry, Replayer, action_payload, reset_payload

SIZE = (4.2, 1.8, 1.5)
MASS = 1500.0
COAST = Control(acceleration=0.0, steering=0.0)
GO_ON = {"action": "control", "on_collision": "continue", "contact": {"masses": {"car": MASS}}}


@pytest.fixture(scope="module", autouse=True)
def coarse_matter():
    """Every crash of these tests in a fraction of the usual time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crash, "PARTICLES", 500)
        yield


def shell(size: tuple[float, float, float] = SIZE) -> GaussianCloud:
    """Gaussians all over the surface of a box."""
    axes = [torch.linspace(-s / 2, s / 2, round(s / 0.1) + 1) for s in size]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    means = grid[((grid.abs() - torch.tensor(size) / 2).abs() < 1e-4).any(dim=1)]
    count = len(means)
    return GaussianCloud(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.05),
        opacities=torch.full((count,), 0.9),
        sh=torch.rand(count, 4, 3, generator=torch.Generator().manual_seed(0)),
    )


@pytest.fixture
def crash_scene(make_scene, moving):
    """``crash_scene(car=trajectory, ...)``: objects with bodywork to be dented."""

    def make(category: str = "car", *, speed: float = 10.0, **paths):
        scene = make_scene(moving(speed=speed), **paths)
        objects = {k: SceneObject(k, category, SIZE, shell(), v) for k, v in paths.items()}
        return replace(scene, objects=objects)

    return make


def world_of(scene, **spec) -> World:
    return World(scene, ScenarioState.of(scene), ResetSpec(**(GO_ON | spec)))


def drive_until_contact(world: World) -> list:
    for _ in range(60):
        if events := [e for e in world.step(COAST) if e.type == "collision"]:
            return events
    raise AssertionError("no contact")


def cloud_of(world: World, object_id: str = "car") -> GaussianCloud:
    ids = {o.object_id: k for k, o in enumerate(world.agents.objects, start=1)}
    return world.instances()[ids[object_id]].cloud


def bits(cloud: GaussianCloud) -> str:
    parts = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    return hashlib.sha256(b"".join(p.numpy().tobytes() for p in parts)).hexdigest()


# --- in the world -----------------------------------------------------------------------------


def test_an_impacted_car_is_drawn_deformed_where_it_was_hit(crash_scene, moving):
    scene = crash_scene(car=moving(20, 0, z=0.75), other=moving(20, 5, z=0.75))
    world = world_of(scene)
    drive_until_contact(world)
    for _ in range(3):
        world.step(COAST)
    before, after = scene.objects["car"].cloud.means, cloud_of(world).means
    pushed = (after - before)[:, 0]
    rear, front = before[:, 0] < -SIZE[0] / 2 + 0.1, before[:, 0] > 0.5
    low = before[:, 2] < 0.0
    assert pushed[rear & low].mean() > 0.04
    assert pushed[front].abs().max() < 0.02
    assert torch.equal(cloud_of(world, "other").means, before)


def test_a_dent_grows_for_a_tenth_of_a_second_and_then_stays(crash_scene, moving):
    world = world_of(crash_scene(car=moving(20, 0, z=0.75)), dt_us=20_000, horizon=400)
    while not world.impacts:
        world.step(COAST)
    rear = world.scene.objects["car"].cloud.means[:, 0] < -2.05
    depths, drawn = [], []
    for _ in range(18):
        world.step(COAST)
        drawn.append(cloud_of(world).means)
        shift = (drawn[-1] - world.scene.objects["car"].cloud.means)[:, 0]
        depths.append(float(shift[rear].max()))
    assert 0 < depths[0] < 0.7 * depths[-1]
    still = torch.stack([(d == drawn[-1]).all(dim=1) for d in drawn[-5:]]).all(dim=0)
    # The bumper at the rear hangs by one end, and goes on to sink for a second.
    assert still[world.scene.objects["car"].cloud.means[:, 0] > -1.6].all()
    assert still.double().mean() > 0.9


def test_a_loose_bumper_and_fragments_come_to_rest_and_then_stay(crash_scene, moving):
    world = world_of(crash_scene(speed=15.0, car=moving(20, 0, z=0.75)), dt_us=20_000, horizon=400)
    while not world.impacts:
        world.step(COAST)
    broken = world.steps
    kept = {}
    for after in (40, 45, 70, 75, 150, 155):
        while world.steps < broken + after:
            world.step(COAST)
        kept[after] = bits(cloud_of(world)), bits(world.instances()[-1].cloud)
    assert kept[40][0] != kept[45][0]
    assert kept[40][1] != kept[45][1]
    assert len({kept[k][0] for k in (70, 75, 150, 155)}) == 1
    assert kept[150] == kept[155]


def test_what_is_drawn_does_not_depend_on_what_was_drawn_before(crash_scene, moving):
    world = world_of(crash_scene(car=moving(20, 0.4, z=0.75)), dt_us=20_000, horizon=400)
    while not world.impacts:
        world.step(COAST)
    unseen = world_of(crash_scene(car=moving(20, 0.4, z=0.75)), dt_us=20_000, horizon=400)
    while unseen.steps < world.steps:
        unseen.step(COAST)
    drawn = []
    for _ in range(6):
        world.step(COAST)
        unseen.step(COAST)
        world.deformation.solve(world.t_us)
        drawn.append(bits(cloud_of(world)))
    assert bits(cloud_of(unseen)) == drawn[-1]
    assert len(set(drawn)) > 3


def test_an_image_solves_no_more_of_a_crash_than_it_shows(crash_scene, moving, monkeypatch):
    world = world_of(crash_scene(car=moving(20, 0, z=0.75)), dt_us=20_000, horizon=400)
    while not world.impacts:
        world.step(COAST)
    solved: list[float] = []
    step = crash.Solver.step
    monkeypatch.setattr(crash.Solver, "step", lambda s, t: (solved.append(t), step(s, t))[1])
    spans = []
    for _ in range(15):
        world.step(COAST)
        before = len(solved)
        world.deformation.solve(world.t_us)
        spans.append(sum(solved[before:]))
    # Of each 20 ms what they hold, and what fills its last frame; nothing once it is over.
    assert sum(spans) > 0.1
    assert max(spans) < 0.05
    assert spans[-3:] == [0, 0, 0]


def test_what_the_crash_does_not_reach_stays_as_it_was(crash_scene, moving):
    world = world_of(crash_scene(car=moving(20, 0, z=0.75)))
    drive_until_contact(world)
    for _ in range(5):
        world.step(COAST)
    before, after = world.scene.objects["car"].cloud, cloud_of(world)
    same = (after.means == before.means).all(dim=1)
    assert 0.2 < same.double().mean() < 0.9
    assert torch.equal(after.quats[same], before.quats[same])


def test_the_same_crash_leaves_the_same_dent_in_a_replay_and_in_a_fork(crash_scene, moving):
    scene, spec = crash_scene(car=moving(20, 0.4, z=0.75)), ResetSpec(**GO_ON)
    entries = [Entry("reset", 0, reset_payload(spec))]
    entries += [Entry("action", k, action_payload(COAST)) for k in range(25)]
    replayer = Replayer.on(scene, ScenarioState.of(scene))
    for entry in entries:
        world = replayer.apply(entry)
    fork = world.fork()
    again = Replayer.on(scene, ScenarioState.of(scene))
    for entry in entries:
        other = again.apply(entry)
        other.instances()
    assert bits(cloud_of(world)) == bits(cloud_of(other))
    assert bits(world.instances()[-1].cloud) == bits(other.instances()[-1].cloud)
    fork.step(COAST)
    assert bits(cloud_of(fork)) == bits(cloud_of(world))
    assert bits(cloud_of(world)) != bits(scene.objects["car"].cloud)


def test_what_broke_lies_on_the_road_unless_the_episode_is_from_before(crash_scene, moving):
    scene = crash_scene(car=moving(20, 0, z=0.75))
    drawn = {}
    for breakage in (True, False):
        world = world_of(scene, contact=GO_ON["contact"] | {"breakage": breakage})
        drive_until_contact(world)
        for _ in range(12):
            world.step(COAST)
        drawn[breakage] = world.instances()
    assert len(drawn[True]) == len(drawn[False]) + 1
    fragments = drawn[True][-1]
    assert fragments.instance_id == drawn[True][1].instance_id
    assert fragments.semantic == drawn[True][1].semantic
    means = fragments.cloud.means.numpy()
    assert (means[:, 2] > scene.ground.height_at(means[:, :2])).all()
    assert bits(drawn[True][1].cloud) != bits(drawn[False][1].cloud)
    assert len(drawn[False][1].cloud) == len(scene.objects["car"].cloud)


@pytest.mark.parametrize(
    ("category", "speed", "spec"),
    [
        ("car", 10.0, {"contact": {"dents": False}}),
        ("pedestrian", 10.0, {}),
        ("car", 1.0, {}),
    ],
)
def test_what_is_switched_off_alive_or_hit_slowly_is_not_deformed(
    crash_scene, moving, category, speed, spec
):
    scene = crash_scene(category, speed=speed, car=moving(5.5 + 1.5 * speed, 0, z=0.75))
    world = world_of(scene, **spec)
    drive_until_contact(world)
    world.step(COAST)
    assert torch.equal(cloud_of(world).means, scene.objects["car"].cloud.means)


def test_a_car_pushed_into_the_next_is_dented_at_both_ends(crash_scene, moving):
    scene = crash_scene(car=moving(20, 0, z=0.75), next=moving(24.8, 0, z=0.75))
    world = world_of(scene)
    for _ in range(40):
        world.step(COAST)
    rest = scene.objects["car"].cloud.means
    pushed = (cloud_of(world).means - rest)[:, 0]
    assert pushed[rest[:, 0] < -2.05].max() > 0.05
    assert pushed[rest[:, 0] > 2.05].min() < -0.02
    assert (cloud_of(world, "next").means - rest)[rest[:, 0] < -2.05, 0].max() > 0.02


# --- the crash itself -------------------------------------------------------------------------


def crasher(x: float, y: float, vx: float, *, yaw: float = 0.0, mass: float = MASS):
    body = crash.vehicle_body(SIZE, mass=mass, friction=0.4)
    pose = transform_from(np.array([x, y, SIZE[2] / 2]), yaw_quaternion(yaw))
    return crash.ImpactBody(body, pose, np.array([vx, 0.0, 0.0]))


@pytest.mark.parametrize(("mass", "y"), [(1500.0, 0.0), (3000.0, 0.0), (1500.0, 0.7)])
def test_momentum_of_both_stays_and_delta_v_is_that_of_the_rigid_exchange(mass, y):
    first, second = crasher(-4.15, y, 10.0), crasher(0.0, 0.0, 0.0, mass=mass)
    front, hit = crash.simulate_impact(first, second)
    total = MASS * front.delta_v + mass * hit.delta_v
    np.testing.assert_allclose(total, 0.0, atol=1e-3 * MASS * 10)
    if y == 0.0:
        rigid = 1.1 * mass / (MASS + mass) * 10.0
        assert -front.delta_v[0] == pytest.approx(rigid, rel=0.12)


def test_both_dents_together_are_as_deep_as_the_mutual_stiffness_says():
    first, second = crasher(-4.15, 0.0, 10.0), crasher(0.0, 0.0, 0.0)
    depth = sum(dent.depth for dent in crash.simulate_impact(first, second))
    energy = 0.25 * MASS * 10.0**2
    assert depth == pytest.approx((2 * energy / 405e3) ** 0.5, rel=0.35)


def test_bodies_that_pass_each_other_are_not_deformed():
    assert crash.simulate_impact(crasher(-4.0, 2.5, 10.0), crasher(0.0, 0.0, 0.0)) is None
