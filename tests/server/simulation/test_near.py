"""Approaches are detected on flat sides too, and when the other body is the one moving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.physics import (
    Box,
    Capsule,
    Cylinder,
    FixedCorotated,
    PhysicsError,
    TriangleMesh,
    TriangleSurface,
    box_particles,
)
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.simulator import HybridSimulator
from real2sim_server.simulation.spawn import require_separation

SIZE = (1.2, 1.0, 0.4)


def block(position=(0.0, 0.0, 0.0), speed=0.0) -> DeformableBody:
    particles = box_particles(SIZE, spacing=0.1, density=200.0)
    return DeformableBody(
        "block",
        particles,
        [FixedCorotated(young=2e6)],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.4,
        cell=0.2,
        T_world_object=at(*position),
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )


def simulator(body: DeformableBody, *colliders: Box) -> HybridSimulator:
    return HybridSimulator(
        [body], colliders, road=(), gravity=(0, 0, 0), backend="cpu", brake_after_hit=1.0
    )


def post(x: float, y=0.0, width=0.05, **options) -> Box:
    return Box(name="post", T_world_box=at(x, y, 0), size=(width, width, 2.0), **options)


FENCE = TriangleSurface(
    [[0, -2, -1], [0, 2, -1], [0, 2, 1], [0, -2, 1]], [[0, 1, 2], [0, 2, 3]], 0.02
)
SHAPES = {
    "cylinder": lambda T: Cylinder(name="post", T_world_cylinder=T, radius=0.04, height=2),
    "capsule": lambda T: Capsule(name="post", T_world_capsule=T, radius=0.04, length=2),
    "mesh": lambda T: TriangleMesh(name="post", T_world_mesh=T, surface=FENCE),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.slow
def test_round_posts_and_fences_collide_carry_and_are_refused_inside_objects(shape):
    body = block(speed=10.0)
    simulated = simulator(body, SHAPES[shape](at(1.0, 0.22, 0)))
    for _ in range(20):
        simulated.advance(0.005)
    records = simulated.contact_log.records({"block": body.motion.mass}, np.zeros(3))
    assert [r.other for r in records] == ["post"]
    assert body.motion.velocity[0] < 3.0

    still = block()
    with pytest.raises(PhysicsError, match="inside collider 'post'"):
        require_separation([still], [(still.T_world_object, SIZE)], [SHAPES[shape](at(0, 0.03, 0))])
    require_separation([still], [(still.T_world_object, SIZE)], [SHAPES[shape](at(0.68, 0.03, 0))])


def test_an_object_dropped_on_a_sheet_comes_to_rest_on_it():
    flat = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
    table = TriangleMesh(
        name="table",
        T_world_mesh=at(0, 0, 0),
        surface=TriangleSurface(flat, [[0, 1, 2], [0, 2, 3]], 0.05),
    )
    body = block((0, 0, 0.35), speed=0.01)
    simulated = HybridSimulator(
        [body], [table], road=(), gravity=(0, 0, -9.81), backend="cpu", brake_after_hit=1.0
    )
    for _ in range(160):
        simulated.advance(0.005)
    assert body.motion.centre[2] == pytest.approx(SIZE[2] / 2 + 0.025, abs=0.06)
    assert np.linalg.norm(body.motion.velocity) < 0.05


@pytest.mark.parametrize("side", [-0.31, 0.04, 0.22])
def test_a_thin_post_in_front_of_a_flat_face_is_hit(side):
    body = block(speed=10.0)
    simulated = simulator(body, post(1.0, side))
    for _ in range(20):
        simulated.advance(0.005)
    records = simulated.contact_log.records({"block": body.motion.mass}, np.zeros(3))
    assert [r.other for r in records] == ["post"]
    assert body.motion.velocity[0] < 3.0


def test_a_moving_collider_wakes_what_stands_in_its_way():
    body = block()
    simulated = simulator(body, post(1.5, velocity=(-20, 0, 0)))
    assert body.mode == BodyMode.SLEEPING
    for _ in range(16):
        simulated.advance(0.005)
    assert body.motion.velocity[0] < -3.0


def test_bodies_moving_away_are_not_near():
    body = block()
    simulated = simulator(body, post(1.0, velocity=(5, 0, 0)))
    for _ in range(4):
        simulated.advance(0.005)
    assert body.mode == BodyMode.SLEEPING


@pytest.mark.parametrize("width", [0.02, 0.3])
def test_a_post_inside_an_object_is_refused(width):
    body = block()
    with pytest.raises(PhysicsError, match="inside collider 'post'"):
        require_separation([body], [(body.T_world_object, SIZE)], [post(0.0, 0.03, width)])


def test_a_post_beside_an_object_is_accepted():
    body = block()
    require_separation([body], [(body.T_world_object, SIZE)], [post(0.62, 0.03)])


def test_approaching_bodies_stay_rigid_until_surfaces_meet():
    body = block(speed=2.0)
    simulated = simulator(body, post(1.0, 0.04))
    ahead = 1.0 - 0.025 - SIZE[0] / 2
    for _ in range(round(0.75 * ahead / 2.0 / 0.005)):
        simulated.advance(0.005)
    assert body.mode == BodyMode.RIGID
    for _ in range(round(0.25 * ahead / 2.0 / 0.005)):
        simulated.advance(0.005)
    assert body.mode == BodyMode.DEFORMING


def test_a_spinning_beam_strikes_with_its_end():
    """The end of a beam spinning about its middle strikes a block; neither is translating."""
    beam = block()
    beam.motion = replace(beam.motion, angular_velocity=np.array([0.0, 0.0, 4.0]))
    other = block(position=(0.55, 1.15, 0.0))
    other.name = "other"
    simulated = HybridSimulator(
        [beam, other], (), road=(), gravity=(0, 0, 0), backend="cpu", brake_after_hit=1.0
    )
    for _ in range(60):
        simulated.advance(0.005)
    assert other.motion.velocity[1] > 0.1
    assert beam.motion.angular_velocity[2] < 3.9
