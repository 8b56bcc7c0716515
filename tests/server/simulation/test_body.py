"""A body switches between rigid and deforming without a jolt, and keeps its own time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.physics import (
    Box,
    FixedCorotated,
    Solver,
    SolverOptions,
    box_particles,
)
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import SETTLE_TIME, SLEEP_TIME, BodyMode, DeformableBody
from real2sim_server.simulation.rigid import rotation_of

GRID_LAG = 3.75
"""How many times slower than by its own inertia a pole of 0.2 m turns on cells of 0.2 m."""


def lattice(size=(1.0, 0.6, 0.4), spacing=0.1):
    return box_particles(size, spacing=spacing, density=200.0)


def thrown(**options) -> DeformableBody:
    pose = at(0.2, 0.1, 2.0)
    pose[:3, :3] = rotation_of(np.array([0.2, 0.5, -0.4]))
    settings = {
        "friction": 0.4,
        "cell": 0.2,
        "T_world_object": pose,
        "velocity": np.array([3.0, -1.0, 0.5]),
        "angular_velocity": np.array([0.7, 1.5, -2.0]),
    }
    particles = options.pop("particles", None) or lattice()
    regions = np.zeros(len(particles), dtype=np.int64)
    return DeformableBody(
        "box", particles, [FixedCorotated(young=2e6)], regions, **{**settings, **options}
    )


def activated(body: DeformableBody) -> Solver:
    body.activate()
    options = SolverOptions(dx=body.cell, gravity=(0, 0, 0), precision="double")
    return Solver([body.solver_body()], (), options)


def test_activation_preserves_momentum_angular_momentum_and_pose():
    body = thrown()
    before, pose = body.motion, body.T_world_object
    solver = activated(body)
    body.update_from_solver(solver.state("box"))
    np.testing.assert_allclose(body.motion.momentum, before.momentum, rtol=1e-9)
    np.testing.assert_allclose(body.motion.angular_momentum, before.angular_momentum, rtol=1e-9)
    np.testing.assert_allclose(body.motion.angular_velocity, before.angular_velocity, rtol=1e-9)
    np.testing.assert_allclose(body.T_world_object, pose, atol=1e-9)


def test_becoming_rigid_preserves_momentum_angular_momentum_pose_and_particles():
    body = thrown()
    solver = activated(body)
    solver.step(0.02)
    body.update_from_solver(solver.state("box"))
    motion, pose, points = body.motion, body.T_world_object, body.state.positions
    spin = body.state.angular_momentum
    body.rigidify()
    np.testing.assert_allclose(body.motion.momentum, motion.momentum, rtol=1e-12)
    np.testing.assert_allclose(body.motion.angular_momentum, spin, rtol=1e-9)
    np.testing.assert_allclose(body.T_world_object, pose, atol=1e-12)
    again = body.solver_body().particles.positions
    np.testing.assert_allclose(again, points, atol=1e-12)


def test_a_pole_turns_with_its_own_inertia_not_that_of_the_grid():
    """An off-centre hit by a post makes a slender pole spin about its length."""
    width, length = 0.2, 1.0
    particles = box_particles((width, width, length), spacing=0.1, density=200.0)
    body = thrown(
        particles=particles,
        T_world_object=at(0.013, 0.007, 0.0),
        velocity=np.array([3.0, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )
    about_length = body.motion.mass * width**2 / 6
    assert body.motion.inertia[2, 2] == pytest.approx(about_length)
    body.activate()
    post = Box(name="post", T_world_box=at(0.25, 0.3, 0.0), size=(0.2, 0.6, 2.0))
    options = SolverOptions(dx=body.cell, gravity=(0, 0, 0), precision="double")
    solver = Solver([body.solver_body()], [post], options)
    begin = np.cross(body.motion.centre, body.motion.momentum)
    solver.step(0.03)
    body.update_from_solver(solver.state("box"))
    (struck,) = solver.contacts
    m = body.motion
    given = begin + struck.moment - np.cross(m.centre, m.momentum)
    assert abs(given[2]) > 0.05
    np.testing.assert_allclose(m.angular_momentum, given, rtol=0, atol=1e-9)
    assert body.lag[2] == pytest.approx(m.angular_velocity[2] * (1 - 1 / GRID_LAG), rel=0.1)
    body.catch_up()
    again = Solver([body.solver_body()], (), options)
    body.update_from_solver(again.state("box"))
    np.testing.assert_allclose(body.motion.angular_velocity, m.angular_velocity, atol=1e-9)
    assert np.abs(body.lag).max() < 1e-9
    body.rigidify()
    np.testing.assert_allclose(body.motion.angular_velocity, m.angular_velocity, atol=1e-9)


def test_a_sleeping_body_is_still_and_rigid():
    body = thrown()
    solver = activated(body)
    body.update_from_solver(solver.state("box"))
    body.put_to_sleep()
    assert body.mode == BodyMode.SLEEPING
    assert body.state is None
    assert body.kinetic_energy == 0


def solved(**options) -> DeformableBody:
    """A body that the solver has just taken over."""
    body = thrown(**options)
    body.update_from_solver(activated(body).state("box"))
    return body


def test_a_body_moving_as_a_whole_may_become_rigid_but_not_sleep():
    body = solved()
    body.update_timers(SETTLE_TIME)
    assert not body.may_rigidify
    body.update_timers(SETTLE_TIME)
    assert body.may_rigidify
    assert not body.may_sleep


def test_a_nearly_still_body_may_sleep_after_the_sleep_time():
    body = solved(velocity=np.zeros(3), angular_velocity=np.zeros(3))
    body.update_timers(SLEEP_TIME)
    assert not body.may_sleep
    body.update_timers(SETTLE_TIME)
    assert body.may_sleep


def test_a_vibrating_body_is_not_settled():
    body = solved(velocity=np.zeros(3), angular_velocity=np.zeros(3))
    rng = np.random.default_rng(0)
    body.state = replace(body.state, velocities=rng.normal(size=body.state.velocities.shape))
    body.update_timers(1.0)
    assert body.residual_speed() > 0.5
    assert not body.may_rigidify


def test_a_body_keeps_its_given_shape_and_centre_of_mass():
    dented = solved()
    dented.rigidify()
    pose = dented.T_world_object
    again = thrown(T_world_object=pose, shape=dented.shape)
    np.testing.assert_allclose(again.T_world_object, pose, atol=1e-12)
    np.testing.assert_allclose(again.motion.centre, dented.motion.centre, atol=1e-12)
    assert again.local_positions() is dented.shape.positions
