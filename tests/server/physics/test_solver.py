"""The solver's promises: refusals, survival, adaptive steps, energy balance."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import (
    Body,
    Box,
    ColliderError,
    FixedCorotated,
    HeightField,
    MaterialError,
    ParticleError,
    Particles,
    Plane,
    Solver,
    SolverError,
    SolverOptions,
    UnstableError,
    box_particles,
    model,
)
from real2sim_server.physics.contact import face_score, resolve_node_pair

from .scenes import SOFT, at, cube, ground, solve


def lumps(**changes):
    values = {
        "positions": np.zeros((2, 3)),
        "volumes": np.ones(2),
        "masses": np.ones(2),
        "source": np.full(2, -1),
        **changes,
    }
    return Particles(**values)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: lumps(masses=[1.0, 0.0]), ParticleError, "1 of 2 particles: masses"),
        (lambda: lumps(volumes=[1.0, -1.0]), ParticleError, "volumes"),
        (lambda: lumps(positions=[[0, 0, 0], [np.nan, 0, 0]]), ParticleError, "first: 1"),
        (lambda: lumps(masses=np.ones(3)), ParticleError, r"must be \(2,\)"),
        (lambda: lumps().with_mass(0), ParticleError, "must be positive"),
        (lambda: box_particles([1, 1, 0], spacing=0.1, density=1), ParticleError, "box"),
        (lambda: cube(friction=-1), MaterialError, "friction"),
        (lambda: cube(velocity=(1, 2)), ParticleError, "velocity"),
        (lambda: cube(velocity=(np.inf, 0, 0)), ParticleError, "finite"),
        (lambda: cube(regions=np.ones(216, int)), MaterialError, "regions"),
        (lambda: cube(deformation=-np.ones((216, 3, 3))), ParticleError, "det > 0"),
        (lambda: solve([]), SolverError, "1 to 4096"),
        (lambda: solve([cube(), cube()]), SolverError, "unique"),
        (lambda: solve([cube()], [ground(), ground()]), SolverError, "unique"),
        (lambda: solve([cube()], dx=-1), SolverError, "dx"),
        (lambda: solve([cube()], dx=0.02), ParticleError, "do not see each other"),
        (lambda: solve([cube()], gravity=(0, 0)), SolverError, "gravity"),
        (lambda: solve([cube()], precision="half"), SolverError, "precision"),
        (lambda: solve([cube(position=(1e9, 0, 0))]), ParticleError, "nearer to the origin"),
        (lambda: SolverOptions(cfl=1.5), SolverError, "cfl"),
        (lambda: Plane(name="p", normal=(0, 0, 0)), ColliderError, "normal"),
        (lambda: Plane(name="p", friction=-0.1), ColliderError, "friction"),
        (lambda: Box(name="b", T_world_box=np.eye(3), size=(1, 1, 1)), ColliderError, "rigid"),
        (lambda: Box(name="b", T_world_box=np.eye(4), size=(1, 0, 1)), ColliderError, "size"),
        (lambda: HeightField(name="h", heights=np.zeros((1, 5))), ColliderError, "heights"),
        (lambda: solve([cube()]).step(0), SolverError, "duration"),
        (lambda: solve([cube()]).step(float("nan")), SolverError, "duration"),
        (lambda: solve([cube()]).state("car"), SolverError, "there are"),
    ],
)
def test_invalid_arguments_are_refused_with_the_reason(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_too_many_particles_for_memory_are_refused_before_allocation(monkeypatch):
    monkeypatch.setattr(model, "available_memory", lambda: 4 * 2**30)
    with pytest.raises(ParticleError, match=r"10,000,000 particles need about .* GiB"):
        model.check_memory(10_000_000, "single")
    model.check_memory(1_000_000, "single")


def test_a_velocity_of_a_million_m_s_is_refused_or_survived():
    fast = solve([cube(position=(0, 0, 1), velocity=(0, 0, -1e6))], [ground()])
    with pytest.raises(SolverError, match="fastest particle moves at 1e"):
        fast.step(1.0)
    fast.step(1e-6)
    assert fast.measure.finite
    assert fast.energies().kinetic <= 0.5 * fast.measure.mass[0] * 1e12 * 1.001


def test_initially_overlapping_bodies_stay_calm():
    bodies = [cube("a", (0, 0, 0.2)), cube("b", (0.1, 0.05, 0.25))]
    run = solve(bodies, gravity=(0, 0, 0))
    run.step(0.1)
    assert run.measure.finite
    assert run.energies().total < 1e-3


def test_a_face_inside_a_crushed_body_is_stopped():
    """A crushed body surrounds the nodes next to its surface, so its moments are no help."""
    dx = 0.2
    cell = dx**3
    face = np.array([-0.2 * cell, 0.0, 0.0, 0.5 * cell])
    crushed = np.array([0.0, 0.06 * cell, 0.0, 3.0 * cell])
    a, b = np.array([1.0, 0.0, 0.0, 2.0]), np.array([0.0, 0.0, 0.0, 2.0])
    resolve_node_pair(a, b, face, crushed, 0.0, dx, np.zeros(3), np.zeros(8), np.zeros(8))
    assert a[0] == b[0] == pytest.approx(0.5)
    assert face_score(0.06, 3.0) < face_score(0.2, 0.5)


def test_a_body_sliding_over_a_face_is_not_stopped_by_its_own_end():
    """Near its end a body surrounds a node but ends on one side: that is not a normal."""
    dx = 0.2
    cell = dx**3
    face = np.array([0.0, 0.0, -0.03 * cell, 0.03 * cell])
    sliding = np.array([0.1 * cell, 0.0, 0.0, 0.9 * cell])
    a, b = np.array([0.0, 0.0, 0.5, 2.0]), np.array([-3.0, 0.0, -0.5, 2.0])
    resolve_node_pair(a, b, face, sliding, 0.0, dx, np.zeros(3), np.zeros(8), np.zeros(8))
    assert (a[0], b[0]) == (0.0, -3.0)


def test_surfaces_passing_each_other_do_not_touch():
    dx = 0.2
    cell = dx**3
    face = np.array([-0.2 * cell, 0.0, 0.0, 0.5 * cell])
    beside = np.array([0.0, 0.2 * cell, 0.0, 0.5 * cell])
    a, b = np.array([1.0, 0.0, 0.0, 2.0]), np.array([0.0, 0.0, 0.0, 2.0])
    resolve_node_pair(a, b, face, beside, 0.0, dx, np.zeros(3), np.zeros(8), np.zeros(8))
    assert a[0] == 1.0
    assert b[0] == 0.0


def test_energies_add_up_and_none_is_gained():
    run = solve([cube(position=(0, 0, 0.2), velocity=(3, 0, -2), friction=0.4)], [ground()])
    start = run.energies()
    for _ in range(10):
        run.step(0.02)
        now = run.energies()
        dissipated = now.friction_heat + now.dissipated - now.collider_work
        assert now.total + dissipated == pytest.approx(start.total, rel=1e-6)
        assert now.total <= start.total * (1 + 1e-3)
    assert now.friction_heat > 1
    assert now.dissipated > 0


def test_work_of_a_moving_box_is_accounted_for():
    ram = Box(name="ram", T_world_box=at(-0.4, 0, 0), size=(0.4, 1, 1), velocity=(2, 0, 0))
    run = solve([cube()], [ram], gravity=(0, 0, 0))
    run.step(0.1)
    energies = run.energies()
    assert energies.collider_work > 1
    assert energies.total < energies.collider_work
    assert run.state("cube").velocity[0] > 1.9
    assert np.asarray(run.colliders[0].T_world_box)[0, 3] == pytest.approx(-0.2)


def test_diverging_steps_are_reverted():
    run = solve([cube(velocity=(0, 0, 0), angular_velocity=(0, 0, 30))], cfl=0.9, gravity=(0, 0, 0))
    start = run.energies().total
    # Steps twice as long as requested are unstable.
    run.time_step = lambda: 3.0 * run._dt_scale * 0.9 * run.dx / SOFT.wave_speed  # type: ignore[method-assign]
    report = run.step(0.3)
    assert report.rollbacks > 0
    assert all("energy rose" in r or "finite" in r or "left" in r for r in report.reasons)
    assert run.energies().total <= start * 1.05


def poison(run, times):
    """Make the first substeps of a run end in NaN, the given number of times."""
    advance = run.simulation.advance
    left = [times]

    def poisoned(steps, dt, colliders):
        advance(steps, dt, colliders)
        if left[0]:
            left[0] -= 1
            run.simulation._state.v[3, 1] = np.nan

    run.simulation.advance = poisoned


def test_nan_is_reverted_and_the_step_halved():
    run, undisturbed = (solve([cube(velocity=(1, 0, 0))], [ground()]) for _ in range(2))
    dt = run.time_step()
    poison(run, 1)
    report = run.step(4 * dt)
    assert report.rollbacks == 1
    assert report.reasons == ["positions, velocities or stresses are not finite"]
    assert report.dt == pytest.approx(dt / 2, rel=0.01)
    undisturbed.step(4 * dt)
    positions = run.particles().positions
    assert np.isfinite(positions).all()
    np.testing.assert_allclose(positions, undisturbed.particles().positions, atol=1e-5)


def test_the_last_good_state_is_kept_if_smaller_steps_do_not_help():
    run = solve([cube(velocity=(1, 0, 0))], [ground()])
    run.step(0.01)
    before, time = run.particles(), run.time
    poison(run, 1000)
    with pytest.raises(UnstableError, match="not finite"):
        run.step(0.01)
    assert run.time == time
    assert np.isfinite(run.measure.kinetic).all()
    assert run.particles().positions.tobytes() == before.positions.tobytes()


def test_a_body_flying_out_of_range_is_named_and_stays_in_place():
    run = solve([cube(position=(26_200, 0, 0), velocity=(1e5, 0, 0))], gravity=(0, 0, 0))
    with pytest.raises(ParticleError, match="stay within 26214 m"):
        run.step(0.01)
    assert run.measure.centre[0, 0] < 26_214
    assert np.abs(run.particles().positions[:, 0].mean() - run.measure.centre[0, 0]) < 1e-3


def test_impulses_equal_the_change_of_momentum():
    bodies = [
        cube("left", (-0.2, 0, 0), velocity=(2, 0, 0)),
        cube("right", (0.2, 0.05, 0), velocity=(-1, 0, 0)),
    ]
    run = solve(bodies, gravity=(0, 0, 0), precision="double")
    before = run.measure.momentum
    run.step(0.08)
    change = run.measure.momentum - before
    by_name = {c.body: c.impulse for c in run.contacts}
    np.testing.assert_allclose(by_name["left"], change[0], atol=1e-9)
    np.testing.assert_allclose(by_name["right"], change[1], atol=1e-9)
    assert np.linalg.norm(change[0]) > 1


def test_a_body_continues_where_another_solver_left_it():
    first = solve(
        [cube(position=(0, 0, 0.17), velocity=(1, 0, -2))], [ground()], precision="double"
    )
    first.step(0.02)
    kept = first.state("cube")
    body = first.bodies[0]
    moved = Particles(
        kept.positions, body.particles.volumes, body.particles.masses, body.particles.source
    )
    second = solve(
        [
            Body(
                name="cube",
                particles=moved,
                material=SOFT,
                particle_velocities=kept.velocities,
                particle_gradients=kept.gradients,
                deformation=kept.F_elastic,
                total_deformation=kept.F_total,
                history=kept.history,
            )
        ],
        [ground()],
        precision="double",
    )
    first.step(0.02)
    second.step(0.02)
    np.testing.assert_allclose(second.particles().positions, first.particles().positions, atol=1e-9)


def test_regions_of_one_body_may_differ_in_stiffness():
    particles = box_particles([0.6, 0.2, 0.2], spacing=0.05, density=200)
    front = (particles.positions[:, 0] > 0).astype(int)
    body = Body(
        name="car",
        particles=particles,
        material=[FixedCorotated(young=2e6), FixedCorotated(young=2e4)],
        regions=front,
        velocity=(3, 0, 0),
    )
    run = Solver(
        [body],
        [Plane(name="wall", point=(0.32, 0, 0), normal=(-1, 0, 0))],
        SolverOptions(dx=0.1, gravity=(0, 0, 0)),
    )
    run.step(0.05)
    strain = np.abs(run.particles().F_elastic - np.eye(3)).max(axis=(1, 2))
    assert strain[front == 1].mean() > 5 * strain[front == 0].mean()


def test_integer_friction_needs_no_kernels_of_its_own():
    slippery = model._assemble([cube(friction=0)], 0.1, (0, 0, -9.81), np.float64)
    assert slippery.friction.dtype == np.float64
