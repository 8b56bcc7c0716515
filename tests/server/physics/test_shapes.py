"""Cylinders, capsules and triangle meshes as colliders: where they are, what they stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import quaternion_to_matrix
from real2sim_server.physics import (
    Body,
    Box,
    Capsule,
    ColliderError,
    Cylinder,
    FixedCorotated,
    TriangleMesh,
    TriangleSurface,
    ball_particles,
    box_particles,
)
from real2sim_server.physics.backends.reference_laws import collider_distance as plain_distance
from real2sim_server.physics.contact import collider_distance
from real2sim_server.physics.model import pack_colliders

from .scenes import at, cube, solve
from .shapes import BOX_FACES, box_corners, box_surface, half_pipe

RNG = np.random.default_rng(22)
SPEED = 11.0


def any_pose(rng=RNG) -> np.ndarray:
    pose = at(*rng.uniform(-0.5, 0.5, 3))
    q = rng.normal(size=4)
    pose[:3, :3] = quaternion_to_matrix(q / np.linalg.norm(q))
    return pose


def l_shaped() -> TriangleSurface:
    """A concave, 0.2 m thick wall that turns a corner."""
    foot = np.array([[0, 0], [1, 0], [1, 0.2], [0.2, 0.2], [0.2, 1], [0, 1]])
    low, high = (np.insert(foot, 2, z, axis=1) for z in (-0.5, 0.5))
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    triangles = [(a, c, b) for a, b, c in caps] + [(a + 6, b + 6, c + 6) for a, b, c in caps]
    for k in range(6):
        j = (k + 1) % 6
        triangles += [(k, j, j + 6), (k, j + 6, k + 6)]
    return TriangleSurface(np.concatenate([low, high]), triangles)


SOLIDS = {
    "cylinder": lambda T: Cylinder(name="c", T_world_cylinder=T, radius=0.3, height=1.2),
    "disc": lambda T: Cylinder(name="c", T_world_cylinder=T, radius=0.6, height=0.1),
    "capsule": lambda T: Capsule(name="c", T_world_capsule=T, radius=0.25, length=0.8),
    "ball": lambda T: Capsule(name="c", T_world_capsule=T, radius=0.5, length=0),
    "corner": lambda T: TriangleMesh(name="c", T_world_mesh=T, surface=l_shaped()),
    "sheet": lambda T: TriangleMesh(name="c", T_world_mesh=T, surface=half_pipe(0.6, 1.0)),
}


def distances(solid, points):
    rows, data = pack_colliders([solid], 0.1)
    found = [collider_distance(rows[0], data, *p) for p in points]
    return np.array([d for d, _ in found]), np.array([n for _, n in found])


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_and_normals_match_the_reference_and_each_other(name):
    solid = SOLIDS[name](any_pose())
    points = solid.pose[:3, 3] + RNG.uniform(-0.9, 0.9, (40, 3))
    d, n = distances(solid, points)
    plain, normals = plain_distance(solid, torch.from_numpy(points))
    np.testing.assert_allclose(d, plain.numpy(), atol=1e-12)
    np.testing.assert_allclose(n, normals.numpy(), atol=1e-9)
    assert d.min() < 0.1 < d.max()
    # The normal is the gradient of the distance and points to the surface.
    step = 1e-6
    slope = [
        (distances(solid, points + step * e)[0] - distances(solid, points - step * e)[0]) / step / 2
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(np.stack(slope, axis=1), n, atol=1e-5)
    np.testing.assert_allclose(distances(solid, points - d[:, None] * n)[0], 0, atol=1e-9)


def test_a_box_mesh_behaves_like_the_box():
    pose, size = any_pose(), (0.4, 1.0, 0.7)
    points = pose[:3, 3] + RNG.uniform(-0.6, 0.6, (60, 3))
    mesh = TriangleMesh(name="mesh", T_world_mesh=pose, surface=box_surface(size))
    box = Box(name="box", T_world_box=pose, size=size)
    expected, _ = distances(box, points)
    assert (expected < 0).sum() > 3
    np.testing.assert_allclose(distances(mesh, points)[0], expected, atol=1e-12)


def test_inside_out_meshes_are_flipped_and_duplicate_vertices_merged():
    corners = box_corners((1, 1, 1))
    soup = corners[np.array(BOX_FACES)].reshape(-1, 3)
    turned = TriangleSurface(soup, np.arange(36).reshape(-1, 3)[:, ::-1])
    inside, _ = distances(
        TriangleMesh(name="mesh", T_world_mesh=np.eye(4), surface=turned), [[0.1, 0, 0]]
    )
    assert inside[0] == pytest.approx(-0.4)


FACES = np.array(BOX_FACES)


@pytest.mark.parametrize(
    ("vertices", "triangles", "thickness", "message"),
    [
        (box_corners((1, 1, 1)), FACES[1:], None, "is open: 3 edges .* thickness of a sheet"),
        (box_corners((1, 1, 1)), [[0, 2, 1], *FACES[1:]], None, "edges do not belong"),
        (box_corners((1, 1, 1)), [FACES[0][::-1], *FACES[1:]], None, "do not all face outwards"),
        (box_corners((1, 1, 0)), FACES, None, "has no area|do not belong"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], 0.1, "triangle 0 .* has no area"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]], 0.1, "there are 0 to 2"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], 0.0, "thickness .* must be positive"),
        ([[0, 0, np.nan]], [[0, 0, 0]], 0.1, "finite"),
        ([[0, 0, 0]], np.zeros((0, 3), int), 0.1, "1 to 20000 triangles"),
    ],
)
def test_invalid_meshes_are_refused_with_the_reason(vertices, triangles, thickness, message):
    with pytest.raises(ColliderError, match=message):
        TriangleSurface(vertices, triangles, thickness)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cylinder(name="p", T_world_cylinder=np.eye(4), radius=0, height=1), "radius of"),
        (lambda: Cylinder(name="p", T_world_cylinder=np.eye(4), radius=1, height=-1), "height of"),
        (lambda: Capsule(name="p", T_world_capsule=np.eye(4), radius=np.nan, length=1), "radius"),
        (lambda: Capsule(name="p", T_world_capsule=2 * np.eye(4), radius=1, length=1), "rigid"),
    ],
)
def test_shapes_of_zero_size_are_refused(make, message):
    with pytest.raises(ColliderError, match=message):
        make()


POSTS = {
    "cylinder": lambda name, T, w: Cylinder(name=name, T_world_cylinder=T, radius=w / 2, height=3),
    "capsule": lambda name, T, w: Capsule(name=name, T_world_capsule=T, radius=w / 2, length=3),
    "mesh": lambda name, T, w: TriangleMesh(
        name=name, T_world_mesh=T, surface=box_surface((w, w, 3.0))
    ),
}


def speeds_left(posts, yaw):
    """Speed of the front at each post after 0.1 s, for cars at SPEED."""
    block = box_particles((2.0, 1.0, 0.4), spacing=0.1, density=150)
    bodies, colliders = [], []
    for k, (kind, width, side) in enumerate(posts):
        pose = at(0, 8.0 * k, 0.6)
        c, s = np.cos(yaw), np.sin(yaw)
        pose[:2, :2] = [[c, -s], [s, c]]
        bodies.append(
            Body(
                name=f"car {k}",
                particles=block.moved(pose),
                material=FixedCorotated(young=2e6),
                velocity=pose[:3, 0] * SPEED,
                friction=0.3,
            )
        )
        front = (pose @ [1 + width / 2 + 0.02, side, 0, 1])[:3]
        colliders.append(POSTS[kind](f"post {k}", at(*front), width))
    solver = solve(bodies, colliders, dx=0.2, gravity=(0, 0, 0))
    solver.step(0.1)
    assert {c.body[4:]: c.other[5:] for c in solver.contacts} == {
        str(k): str(k) for k in range(len(posts))
    }
    inertia = solver.bodies[0].particles.mass * (2.0**2 + 1.0**2) / 12
    left = []
    for post, state in zip(solver.colliders, solver.states(), strict=True):
        aside = post.pose[1, 3] - state.centre[1]
        left.append(state.velocity[0] - state.angular_momentum[2] / inertia * aside)
    return np.array(left)


def test_round_and_mesh_posts_stop_cars():
    posts = [
        ("cylinder", 0.05, 0.12),
        ("capsule", 0.05, -0.29),
        ("cylinder", 0.15, 0.04),
        ("mesh", 0.1, -0.2),
    ]
    assert speeds_left(posts, 0.3).max() < 0.15 * SPEED


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.3])
@pytest.mark.parametrize(
    ("kind", "width"),
    [
        *[("cylinder", w) for w in (0.05, 0.1, 0.15, 0.2, 0.3, 0.5)],
        *[("capsule", w) for w in (0.05, 0.1)],
        *[("mesh", w) for w in (0.1, 0.15, 0.3)],
    ],
)
def test_posts_of_any_shape_stop_cars_at_any_position_along_the_front(kind, width, yaw):
    posts = [(kind, width, side) for side in np.linspace(-0.37, 0.37, 10)]
    assert speeds_left(posts, yaw).max() < 0.15 * SPEED


def test_a_sheet_a_fifth_of_a_cell_thick_holds_at_any_grid_phase():
    dx, thickness = 0.1, 0.02
    block = box_particles((0.3, 0.3, 0.2), spacing=dx / 2, density=200)
    square = [[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]
    sheet = TriangleSurface(square, [[0, 1, 2], [0, 2, 3]], thickness)
    bodies, plates = [], []
    for k in range(6):
        x, y = (k + 0.5) / 6 * dx, 3.0 * k
        bodies.append(
            Body(
                name=f"block {k}",
                particles=block.moved(at(x, y, 0)),
                material=FixedCorotated(young=2e6),
                velocity=(5, 0, 0),
            )
        )
        centre = at(x + 0.18 + thickness / 2, y, 0)
        plates.append(TriangleMesh(name=f"plate {k}", T_world_mesh=centre, surface=sheet))
    solver = solve(bodies, plates, dx=dx, gravity=(0, 0, 0))
    solver.step(0.016)
    for state, plate in zip(solver.states(), plates, strict=True):
        assert state.positions[:, 0].max() < plate.pose[0, 3]
        assert state.velocity[0] < 0


@pytest.mark.parametrize("kind", POSTS)
def test_a_post_moving_at_100_m_s_carries_what_it_hits(kind):
    block = box_particles((0.2, 0.2, 0.2), spacing=0.05, density=200)
    post = POSTS[kind]("post", at(0.25, 0.01, 0), 0.15)
    post = replace(post, velocity=(-100, 0, 0))
    solver = solve(
        [Body(name="soft", particles=block, material=FixedCorotated(young=2e5))],
        [post],
        gravity=(0, 0, 0),
    )
    solver.step(0.004)
    [state] = solver.states()
    assert state.velocity[0] < -70
    assert (distances(solver.colliders[0], state.positions)[0] > -0.01).all()


@pytest.mark.parametrize("kind", POSTS)
def test_a_body_starting_around_a_thin_post_stays_together(kind):
    body = cube(material=FixedCorotated(young=2e6), velocity=(1, 0, 0))
    solver = solve([body], [POSTS[kind]("post", at(0.02, 0.01, 0), 0.06)], gravity=(0, 0, 0))
    solver.step(0.01)
    [state] = solver.states()
    assert state.kinetic + state.elastic < 0.5 * state.mass
    assert np.ptp(state.positions, axis=0).max() < 0.35


@pytest.mark.parametrize("kind", POSTS)
def test_the_cpu_matches_the_reference_around_a_post(kind):
    def run(backend):
        body = cube(edge=0.2, velocity=(6, 0.5, 0), angular_velocity=(0, 0, 2), friction=0.3)
        post = POSTS[kind]("post", at(0.16, 0.03, 0.01), 0.06)
        solver = solve(
            [body], [post], backend=backend, precision="double", dt_max=2.5e-4, gravity=(0, 0, 0)
        )
        solver.step(0.006)
        return solver

    expected, found = run("reference"), run("cpu")
    for name in ("positions", "velocities", "F_elastic"):
        a, b = (getattr(s.particles(), name) for s in (expected, found))
        assert np.abs(a - b).max() < 1e-8 * (1 + np.abs(a).max()), name
    [a], [b] = expected.contacts, found.contacts
    np.testing.assert_allclose(b.impulse, a.impulse, atol=1e-6)
    assert np.linalg.norm(a.impulse) > 1


def test_a_ball_in_a_half_pipe_swings_like_a_pendulum():
    radius, ball, angle = 2.0, 0.2, 0.4
    pipe = TriangleMesh(
        name="pipe", T_world_mesh=np.eye(4), surface=half_pipe(radius, 1.5, sides=32), friction=0.0
    )
    arm = radius - ball
    body = Body(
        name="ball",
        particles=ball_particles(ball, spacing=0.05, density=200).moved(
            at(arm * np.sin(angle), 0, -arm * np.cos(angle))
        ),
        material=FixedCorotated(young=2e5, poisson=0.3),
    )
    solver = solve([body], [pipe])
    # Without friction it slides: T = 2 pi sqrt(arm / g) (1 + angle^2 / 16).
    half_period = np.pi * np.sqrt(arm / 9.81) * (1 + angle**2 / 16)
    solver.step(half_period / 2)
    assert abs(solver.states()[0].centre[0]) < 0.08 * arm
    solver.step(half_period / 2)
    x, y, z = solver.states()[0].centre
    assert np.arctan2(x, -z) == pytest.approx(-angle, rel=0.12)
    assert abs(y) < 0.01
    # It sinks in as on any thin collider: up to half a cell.
    assert np.hypot(x, z) == pytest.approx(arm, abs=0.05)
