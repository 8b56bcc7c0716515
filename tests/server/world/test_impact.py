"""Impacts: momentum, sliding to rest and reported values."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from real2sim_proto.operations import SetPhysics
from real2sim_proto.plans import Control
from real2sim_server.scene import GaussianCloud
from real2sim_server.world.collision.bodies import BodyProperties, BodyState, integrate_sliding
from real2sim_server.world.collision.contact import contact_impulse, contact_manifold, corners

COAST = Control(acceleration=0.0, steering=0.0)
GO_ON = {"action": "control", "on_collision": "continue", "privileged": True}
CAR = BodyProperties(mass=1500.0, inertia=2500.0, length=4.5, width=1.8)
MASS = 1500.0


def agent_of(world, object_id: str = "car") -> dict:
    found = {a["object_id"]: a for a in world.observe().obs_fields()["agents"]}
    return found[object_id]


def drive_until_contact(world, limit: int = 60) -> list:
    for _ in range(limit):
        events = [e for e in world.step(COAST) if e.type == "collision"]
        if events:
            return events
    raise AssertionError("no contact")


# --- the planar impact ------------------------------------------------------------------------


def momentum(*pairs: tuple[BodyState, BodyProperties]) -> np.ndarray:
    """Linear [N s] and angular momentum about the origin [N m s]."""
    total = np.zeros(3)
    for body, solid in pairs:
        px, py = solid.mass * body.vx, solid.mass * body.vy
        total += [px, py, body.x * py - body.y * px + solid.inertia * body.turn]
    return total


def after_impact(a: BodyState, b: BodyState, **options) -> tuple[BodyState, BodyState]:
    where = contact_manifold(corners(a, CAR), corners(b, CAR))
    given = contact_impulse((a, CAR), (b, CAR), where, **options)
    return (
        a.pushed(CAR, where.x, where.y, given.jx, given.jy),
        b.pushed(CAR, where.x, where.y, -given.jx, -given.jy),
    )


PAIRS = [
    (BodyState(0, 0, 0, 10, 0, 0), BodyState(4.4, 0, 0, 0, 0, 0)),
    (BodyState(0, 0.6, 0, 10, 0, 0), BodyState(4.4, 0, 0.1, 2, 0, 0)),
    (BodyState(0, 0, 0, 12, 0, 0.2), BodyState(3.0, 0.5, 1.57, 0, -8, 0)),
    (BodyState(0, 0, 0.3, 9, 4, 0), BodyState(3.9, 0.9, 2.9, -7, 1, 0)),
]


@pytest.mark.parametrize(("a", "b"), PAIRS)
@pytest.mark.parametrize("restitution", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_momentum_is_conserved_and_energy_does_not_grow(a, b, restitution, friction):
    c, d = after_impact(a, b, restitution=restitution, friction=friction)
    before = a.energy(CAR) + b.energy(CAR)
    np.testing.assert_allclose(momentum((c, CAR), (d, CAR)), momentum((a, CAR), (b, CAR)))
    assert c.energy(CAR) + d.energy(CAR) <= before * (1 + 1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.4, 1.0])
def test_a_central_impact_matches_the_textbook(restitution):
    a, b = PAIRS[0]
    c, d = after_impact(a, b, restitution=restitution, friction=0.5)
    assert c.vx == pytest.approx(10 * (1 - restitution) / 2)
    assert d.vx == pytest.approx(10 * (1 + restitution) / 2)
    assert (c.turn, d.turn) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_an_offset_impact_turns_both_bodies():
    c, d = after_impact(*PAIRS[1], restitution=0.1, friction=0.0)
    assert c.turn < -0.1
    assert d.turn < -0.1


def test_separating_bodies_exchange_no_impulse():
    a, b = BodyState(0, 0, 0, 0, 0, 0), BodyState(4.4, 0, 0, 5, 0, 0)
    where = contact_manifold(corners(a, CAR), corners(b, CAR))
    assert contact_impulse((a, CAR), (b, CAR), where, restitution=0.1, friction=0.5) is None


def test_only_overlapping_boxes_have_a_contact_manifold():
    assert (
        contact_manifold(
            corners(BodyState(0, 0, 0, 0, 0, 0), CAR), corners(BodyState(4.6, 0, 0, 0, 0, 0), CAR)
        )
        is None
    )
    turned = BodyState(0, 2.9, math.pi / 2, 0, 0, 0)
    assert (
        contact_manifold(corners(BodyState(0, 0, 0, 0, 0, 0), CAR), corners(turned, CAR))
        is not None
    )


# --- sliding to rest --------------------------------------------------------------------------


def test_sliding_distance_of_a_body_without_wheels_matches_friction():
    body, solid = BodyState(0, 0, 0, 10, 0, 0), BodyProperties(80.0, 5.0, 0.5, 0.5, friction=0.7)
    for _ in range(400):
        body = integrate_sliding(body, solid, 0.01)
    assert (body.vx, body.vy, body.turn) == (0.0, 0.0, 0.0)
    assert body.x == pytest.approx(10**2 / (2 * 0.7 * 9.81), rel=0.03)


def test_sideways_sliding_distance_matches_tyre_friction():
    solid = BodyProperties(1500.0, 2500.0, 4.5, 1.8, axles=(1.35, 1.35), friction=0.8)
    body = BodyState(0, 0, math.pi / 2, 8, 0, 0)
    for _ in range(400):
        body = integrate_sliding(body, solid, 0.01)
    assert body.vx == 0.0
    assert body.x == pytest.approx(8**2 / (2 * 0.8 * 9.81), rel=0.05)
    assert abs(body.y) < 0.1


def test_a_spinning_car_comes_to_rest():
    solid = BodyProperties(1500.0, 2500.0, 4.5, 1.8, axles=(1.35, 1.35), friction=0.8, drag=0.1)
    body = BodyState(0, 0, 0, 8, 2, 3.0)
    energies = []
    for _ in range(2000):
        body = integrate_sliding(body, solid, 0.01)
        energies.append(body.energy(solid))
    assert energies[-1] == 0.0
    assert max(np.diff(energies)) <= 1e-6


# --- in the world -----------------------------------------------------------------------------


def rear_end(make_world, moving, *, mass: float = MASS, restitution: float = 0.1):
    contact = {"masses": {"car": mass}, "restitution": restitution}
    return make_world(car=moving(20, 0, z=0.8), spec=GO_ON | {"contact": contact})


@pytest.mark.parametrize(("mass", "restitution"), [(1500.0, 0.1), (3000.0, 0.0), (800.0, 0.3)])
def test_delta_v_of_a_rear_end_impact_matches_theory(make_world, moving, mass, restitution):
    # delta-v = (1 + e) m2 / (m1 + m2) v.
    world = rear_end(make_world, moving, mass=mass, restitution=restitution)
    (event,) = drive_until_contact(world)
    theory = (1 + restitution) * mass / (MASS + mass) * 10.0

    assert event.data["delta_v"] == pytest.approx(theory, rel=0.1)
    assert event.data["object_delta_v"] == pytest.approx(theory * MASS / mass, rel=0.1)
    assert event.data["impulse"] == pytest.approx(MASS * event.data["delta_v"])
    for _ in range(3):
        world.step(COAST)
    crash = {s.name: s for s in world.scores()}["delta_v"]
    assert crash.value == pytest.approx(theory, rel=0.1)


def test_both_cars_move_on_and_come_to_rest(make_world, moving):
    world = rear_end(make_world, moving)
    drive_until_contact(world)
    total = MASS * (world.motion.speed + agent_of(world)["velocity"][0])
    assert total == pytest.approx(MASS * 10.0, rel=0.03)
    while not world.over:
        world.step(Control(acceleration=-5.0, steering=0.0))
    assert world.reason == "horizon"
    assert agent_of(world)["velocity"] == pytest.approx([0, 0, 0], abs=1e-9)
    assert agent_of(world)["position"][0] > 22.0
    assert world.motion.speed == pytest.approx(0.0, abs=0.05)


def test_lost_energy_and_crush_are_reported(make_world, moving):
    (event,) = drive_until_contact(rear_end(make_world, moving, restitution=0.0))
    assert event.data["energy"] == pytest.approx(0.5 * MASS / 2 * 10**2, rel=0.1)
    assert 0.3 < event.data["crush"] < 0.6


def test_an_offset_hit_turns_the_car_and_the_ego(make_world, moving):
    world = make_world(car=moving(20, 1.2, z=0.8), spec=GO_ON)
    drive_until_contact(world)
    for _ in range(15):
        world.step(COAST)
    w, _, _, z = agent_of(world)["quaternion"]
    assert abs(2 * math.atan2(z, w)) > 0.05
    assert abs(world.motion.yaw) > 0.015


def test_a_struck_car_hits_the_next(make_world, moving):
    world = make_world(car=moving(20, 0, z=0.8), next=moving(24.5, 0, z=0.8), spec=GO_ON)
    pairs = []
    for _ in range(40):
        pairs += [(e.object_id, e.other_id) for e in world.step(COAST) if e.type == "collision"]
    assert pairs[0] == ("car", None)
    assert ("next", "car") in pairs
    assert agent_of(world, "next")["velocity"][0] > 0 or agent_of(world, "next")["position"][0] > 25
    assert {s.name: s for s in world.scores()}["delta_v"].terms["secondary_collisions"] >= 1


def test_edited_masses_affect_the_impact(make_world, moving):
    light, heavy = (make_world(car=moving(20, 0, z=0.8), spec=GO_ON) for _ in range(2))
    heavy.apply([SetPhysics(object_id="car", mass=20_000.0)])
    (a,), (b,) = drive_until_contact(light), drive_until_contact(heavy)
    assert b.data["delta_v"] > 1.3 * a.data["delta_v"]


def test_cars_that_overlap_in_the_recording_are_not_flung_apart(make_world, moving):
    world = make_world(car=moving(20, 0, z=0.8), beside=moving(20.5, 1.5, z=0.8), spec=GO_ON)
    drive_until_contact(world)
    for _ in range(10):
        world.step(COAST)
    for name in ("car", "beside"):
        assert math.hypot(*agent_of(world, name)["velocity"][:2]) < 10.0


def test_crashes_are_reproducible(make_world, moving):
    def crash() -> list:
        world = make_world(car=moving(20, 0.7, z=0.8), next=moving(26, 0, z=0.8), spec=GO_ON)
        for _ in range(40):
            world.step(COAST)
        return [world.motion, agent_of(world), agent_of(world, "next")]

    assert crash() == crash()


# --- background -------------------------------------------------------------------------------


def wall_scene(make_scene, x: float):
    """The street with a wall across it."""
    scene = make_scene()
    y, z = torch.meshgrid(torch.arange(-4.0, 4.0, 0.1), torch.arange(0.2, 2.0, 0.1), indexing="ij")
    means = torch.stack([torch.full_like(y, x), y, z], dim=-1).reshape(-1, 3)
    count = len(means)
    cloud = GaussianCloud(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.05),
        opacities=torch.full((count,), 0.95),
        sh=torch.zeros(count, 1, 3),
    )
    return type(scene)(
        "walled", cloud, scene.objects, None, scene.rig, moving_stub(scene), scene.frame_times_us
    )


def moving_stub(scene):
    """A recorded drive that ends before the wall."""
    from real2sim_server.scene import Trajectory

    ego = scene.ego
    return Trajectory(ego.times_us, ego.positions * [0.1, 1, 1], ego.quaternions)


@pytest.mark.parametrize("on_collision", ["terminate", "continue"])
def test_a_background_wall_is_hit(make_scene, on_collision):
    from real2sim_proto.episode import ResetSpec
    from real2sim_server.edit import ScenarioState
    from real2sim_server.world import World

    scene = wall_scene(make_scene, 25.0)
    spec = ResetSpec(
        action="control",
        ego={"actuators": {"steering_lag": 0.0, "drive_lag": 0.0}},
        on_collision=on_collision,
        contact={"background": True, "restitution": 0.2},
    )
    world = World(scene, ScenarioState.of(scene), spec)
    events = []
    while not world.over and not events:
        events = [
            e for e in world.step(Control(acceleration=4.0, steering=0.0)) if e.type == "collision"
        ]
    (event,) = events
    assert event.object_id is None
    assert world.motion.x == pytest.approx(25.0 - 3.65, abs=1.0)
    assert world.accumulator.at_fault == {"object": 1}
    if on_collision == "continue":
        assert event.data["delta_v"] == pytest.approx(1.2 * event.data["approach_speed"], rel=0.1)


def test_without_background_contact_a_wall_is_driven_through(make_scene):
    from real2sim_proto.episode import ResetSpec
    from real2sim_server.edit import ScenarioState
    from real2sim_server.world import World

    scene = wall_scene(make_scene, 15.0)
    world = World(scene, ScenarioState.of(scene), ResetSpec(action="control"))
    while not world.over:
        world.step(Control(acceleration=2.0, steering=0.0))
    assert world.reason == "horizon"
