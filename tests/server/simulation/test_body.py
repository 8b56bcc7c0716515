"""A body changes from rigid to deforming and back without a jolt, and keeps its own time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim_server.physics import FixedCorotated, Solver, SolverOptions, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import SETTLE_TIME, SLEEP_TIME, BodyMode, DeformableBody
from real2sim_server.simulation.rigid import rotation_of


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
    particles = lattice()
    regions = np.zeros(len(particles), dtype=np.int64)
    return DeformableBody(
        "box", particles, [FixedCorotated(young=2e6)], regions, **{**settings, **options}
    )


def activated(body: DeformableBody) -> Solver:
    body.activate()
    options = SolverOptions(dx=body.cell, gravity=(0, 0, 0), precision="double")
    return Solver([body.solver_body()], (), options)


def test_activation_keeps_momentum_angular_momentum_and_pose():
    body = thrown()
    before, pose = body.motion, body.T_world_object
    solver = activated(body)
    body.update_from_solver(solver.state("box"))
    np.testing.assert_allclose(body.motion.momentum, before.momentum, rtol=1e-9)
    np.testing.assert_allclose(body.motion.angular_momentum, before.angular_momentum, rtol=1e-9)
    np.testing.assert_allclose(body.motion.angular_velocity, before.angular_velocity, rtol=1e-9)
    np.testing.assert_allclose(body.T_world_object, pose, atol=1e-9)


def test_rigidifying_keeps_momentum_angular_momentum_pose_and_every_particle():
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


def test_a_body_put_to_sleep_stands_still_and_is_rigid():
    body = thrown()
    solver = activated(body)
    body.update_from_solver(solver.state("box"))
    body.put_to_sleep()
    assert body.mode == BodyMode.SLEEPING
    assert body.state is None
    assert body.kinetic_energy == 0


def solved(**options) -> DeformableBody:
    """A body that a solver has just taken over."""
    body = thrown(**options)
    body.update_from_solver(activated(body).state("box"))
    return body


def test_a_body_that_moves_as_a_whole_may_become_rigid_but_not_sleep():
    body = solved()
    body.update_timers(SETTLE_TIME)
    assert not body.may_rigidify
    body.update_timers(SETTLE_TIME)
    assert body.may_rigidify
    assert not body.may_sleep


def test_a_body_that_hardly_moves_may_sleep_after_the_sleep_time():
    body = solved(velocity=np.zeros(3), angular_velocity=np.zeros(3))
    body.update_timers(SLEEP_TIME)
    assert not body.may_sleep
    body.update_timers(SETTLE_TIME)
    assert body.may_sleep


def test_a_body_that_vibrates_is_not_settled():
    body = solved(velocity=np.zeros(3), angular_velocity=np.zeros(3))
    rng = np.random.default_rng(0)
    body.state = replace(body.state, velocities=rng.normal(size=body.state.velocities.shape))
    body.update_timers(1.0)
    assert body.residual_speed() > 0.5
    assert not body.may_rigidify


def test_a_body_keeps_the_shape_it_is_given_and_its_centre_of_mass():
    dented = solved()
    dented.rigidify()
    pose = dented.T_world_object
    again = thrown(T_world_object=pose, shape=dented.shape)
    np.testing.assert_allclose(again.T_world_object, pose, atol=1e-12)
    np.testing.assert_allclose(again.motion.centre, dented.motion.centre, atol=1e-12)
    assert again.local_positions() is dented.shape.positions
