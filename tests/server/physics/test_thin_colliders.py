"""Posts and plates thinner than a grid cell stop what hits them, wherever they stand."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import Body, Box, FixedCorotated, box_particles

from .scenes import at, solve

SPEED = 11.0
LENGTH, WIDTH = 2.0, 1.0
SPACING = 0.1
MEDIUM = FixedCorotated(young=2e6, poisson=0.3)
LATERAL = np.linspace(-0.37, 0.37, 10)


def turned(yaw: float, *position: float) -> np.ndarray:
    pose = at(*position)
    c, s = np.cos(yaw), np.sin(yaw)
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def cars_before_posts(width: float, yaw: float, *, apart=8.0):
    """Ten cars, each with a post at a different position along its front; no gravity."""
    bodies, posts = [], []
    block = box_particles((LENGTH, WIDTH, 0.4), spacing=SPACING, density=150)
    for k, side in enumerate(LATERAL):
        pose = turned(yaw, 0, k * apart, 0.6)
        bodies.append(
            Body(
                name=f"car {k}",
                particles=block.moved(pose),
                material=MEDIUM,
                velocity=pose[:3, :3] @ [SPEED, 0, 0],
                friction=0.3,
            )
        )
        front = (pose @ [LENGTH / 2 + width + 0.02, side, 0, 1])[:3]
        posts.append(Box(name=f"post {k}", T_world_box=at(*front), size=(width, width, 3.0)))
    return solve(bodies, posts, dx=2 * SPACING, gravity=(0, 0, 0))


@pytest.mark.parametrize("yaw", [0.0, 0.3])
@pytest.mark.parametrize("width", [0.05, 0.1, 0.15, 0.2, 0.3])
def test_a_post_stops_a_car_at_any_position_along_the_front(width, yaw):
    solver = cars_before_posts(width, yaw)
    mass = solver.bodies[0].particles.mass
    solver.step(0.1)
    assert [c.body[-1] for c in solver.contacts] == [c.other[-1] for c in solver.contacts]
    assert len(solver.contacts) == len(LATERAL)
    inertia = mass * (LENGTH**2 + WIDTH**2) / 12
    start = turned(yaw, 0, 0, 0)[:3, 0] * SPEED
    for post, contact, state in zip(
        solver.colliders, solver.contacts, solver.states(), strict=True
    ):
        np.testing.assert_allclose(
            contact.impulse / mass, state.velocity - start, atol=0.05 * SPEED
        )
        # At the post the body has come to rest or rebounds.
        aside = np.asarray(post.T_world_box)[1, 3] - state.centre[1]
        closing = state.velocity[0] - state.angular_momentum[2] / inertia * aside
        assert closing < 0.1 * SPEED


def test_a_plate_a_quarter_of_a_cell_thick_holds_at_any_grid_phase():
    dx, thickness = 0.1, 0.025
    block = box_particles((0.4, 0.4, 0.2), spacing=dx / 2, density=200)
    bodies, plates = [], []
    for k in range(20):
        x, y = (k + 0.5) / 20 * dx, 2.0 * k
        face = x + 0.21
        bodies.append(
            Body(
                name=f"block {k}",
                particles=block.moved(at(x, y, 0)),
                material=MEDIUM,
                velocity=(5, 0, 0),
            )
        )
        centre = at(face + thickness / 2, y, 0)
        plates.append(Box(name=f"plate {k}", T_world_box=centre, size=(thickness, 1.5, 1)))
    solver = solve(bodies, plates, dx=dx, gravity=(0, 0, 0))
    for _ in range(3):
        solver.step(0.008)
        for state, plate in zip(solver.states(), plates, strict=True):
            assert state.positions[:, 0].max() < plate.T_world_box[0, 3]
    # The elastic block bounces back, as it does from a thick wall.
    assert max(s.velocity[0] for s in solver.states()) < -2.0


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_plate_moving_at_100_m_s_carries_what_it_hits(yaw):
    block = box_particles((0.3, 0.3, 0.2), spacing=0.05, density=200)
    pose = turned(yaw, 0.4, 0.05, 0)
    plate = Box(
        name="plate",
        T_world_box=pose,
        size=(0.02, 2, 1),
        velocity=-100 * pose[:3, 0],
        friction=0.0,
    )
    body = Body(name="soft", particles=block, material=FixedCorotated(young=2e5))
    solver = solve([body], [plate], gravity=(0, 0, 0))
    solver.step(0.01)
    assert solver.states()[0].velocity @ -pose[:3, 0] > 90
    moved = np.linalg.inv(solver.colliders[0].T_world_box)
    before = solver.particles().positions @ moved[0, :3] + moved[0, 3]
    assert before.max() < 0


def test_a_body_starting_around_a_post_stays_together():
    block = box_particles((0.6, 0.3, 0.2), spacing=0.05, density=200)
    post = Box(name="post", T_world_box=at(0.02, 0.01, 0), size=(0.05, 0.05, 1))
    body = Body(name="block", particles=block, material=MEDIUM, velocity=(1, 0, 0))
    solver = solve([body], [post], gravity=(0, 0, 0))
    solver.step(0.02)
    state = solver.states()[0]
    assert state.kinetic + state.elastic < 0.5 * state.mass
    assert np.ptp(state.positions, axis=0).max() < 0.7
