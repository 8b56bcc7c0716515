"""Deformation after impacts: drawn clouds and their reproducibility."""

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
    """Use few particles so that crashes run fast."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crash, "PARTICLES", 500)
        yield


def shell(size: tuple[float, float, float] = SIZE) -> GaussianCloud:
    """Gaussians on the surface of a box."""
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
    """``crash_scene(car=trajectory, ...)``: a scene whose objects have a body shell."""

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


def test_a_struck_car_is_deformed_at_the_impact(crash_scene, moving):
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


def test_a_dent_grows_during_the_impact_and_then_stays(crash_scene, moving):
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
    # The rear bumper hangs by one end and sinks for another second.
    assert still[world.scene.objects["car"].cloud.means[:, 0] > -1.6].all()
    assert still.double().mean() > 0.9


def test_loose_parts_and_fragments_come_to_rest(crash_scene, moving):
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


def test_a_frame_does_not_depend_on_earlier_frames(crash_scene, moving):
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


def test_a_frame_solves_the_crash_only_up_to_its_time(crash_scene, moving, monkeypatch):
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
    # Each image solves its 20 ms up to the next full frame, and nothing after the crash.
    assert sum(spans) > 0.1
    assert max(spans) < 0.05
    assert spans[-3:] == [0, 0, 0]


def test_gaussians_away_from_the_crash_are_unchanged(crash_scene, moving):
    world = world_of(crash_scene(car=moving(20, 0, z=0.75)))
    drive_until_contact(world)
    for _ in range(5):
        world.step(COAST)
    before, after = world.scene.objects["car"].cloud, cloud_of(world)
    same = (after.means == before.means).all(dim=1)
    assert 0.2 < same.double().mean() < 0.9
    assert torch.equal(after.quats[same], before.quats[same])


def test_replays_and_forks_reproduce_the_dent(crash_scene, moving):
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


def test_breakage_adds_fragments_above_the_ground(crash_scene, moving):
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
def test_disabled_dents_pedestrians_and_slow_impacts_do_not_deform(
    crash_scene, moving, category, speed, spec
):
    scene = crash_scene(category, speed=speed, car=moving(5.5 + 1.5 * speed, 0, z=0.75))
    world = world_of(scene, **spec)
    drive_until_contact(world)
    world.step(COAST)
    assert torch.equal(cloud_of(world).means, scene.objects["car"].cloud.means)


def test_a_car_pushed_into_another_is_dented_at_both_ends(crash_scene, moving):
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
def test_momentum_is_conserved_and_delta_v_matches_a_rigid_impact(mass, y):
    first, second = crasher(-4.15, y, 10.0), crasher(0.0, 0.0, 0.0, mass=mass)
    front, hit = crash.simulate_impact(first, second)
    total = MASS * front.delta_v + mass * hit.delta_v
    np.testing.assert_allclose(total, 0.0, atol=1e-3 * MASS * 10)
    if y == 0.0:
        rigid = 1.1 * mass / (MASS + mass) * 10.0
        assert -front.delta_v[0] == pytest.approx(rigid, rel=0.12)


def test_total_dent_depth_matches_the_mutual_stiffness():
    first, second = crasher(-4.15, 0.0, 10.0), crasher(0.0, 0.0, 0.0)
    depth = sum(dent.depth for dent in crash.simulate_impact(first, second))
    energy = 0.25 * MASS * 10.0**2
    assert depth == pytest.approx((2 * energy / 405e3) ** 0.5, rel=0.35)


def test_passing_bodies_are_not_deformed():
    assert crash.simulate_impact(crasher(-4.0, 2.5, 10.0), crasher(0.0, 0.0, 0.0)) is None
