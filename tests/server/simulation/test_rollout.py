"""Rollouts: bodies fall, collide and come to rest; results keep what happened."""

from __future__ import annotations

import re

import numpy as np
import pytest

from real2sim_server.physics import FixedCorotated, PhysicsError, Plane, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.result import SimulationResult
from real2sim_server.simulation.rollout import SimulateOptions, simulate_bodies
from real2sim_server.simulation.structure import ObjectPhysics

SOFT = FixedCorotated(young=2e5, poisson=0.3, viscosity=150.0)


def box(
    name="box", position=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 0.0), material=SOFT, density=200.0
) -> DeformableBody:
    particles = box_particles((0.6, 0.6, 0.6), spacing=0.1, density=density)
    return DeformableBody(
        name,
        particles,
        [material],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.5,
        cell=0.2,
        T_world_object=at(*position),
        velocity=np.array(velocity),
        angular_velocity=np.zeros(3),
    )


def options(*bodies, **changes) -> SimulateOptions:
    objects = {a.name: ObjectPhysics() for a in bodies}
    return SimulateOptions(**{"objects": objects, "duration": 0.5, **changes})


@pytest.fixture(scope="module")
def fall() -> SimulationResult:
    body = box(position=(0, 0, 1.5))
    ground = Plane(name="ground", friction=0.7)
    return simulate_bodies([body], options(body, colliders=[ground], duration=2.5))


def test_a_body_falls_freely_then_deforms_then_rests(fall):
    modes = fall.objects["box"].modes
    assert modes[1] == BodyMode.RIGID
    assert BodyMode.DEFORMING in modes
    assert modes[-1] == BodyMode.SLEEPING
    assert fall.objects["box"].positions[-1, 2] == pytest.approx(0.3, abs=0.06)


def test_first_contact_matches_free_fall(fall):
    [contact] = fall.contacts
    assert contact.other == "ground"
    assert contact.first_s == pytest.approx(np.sqrt(2 * 1.2 / 9.81), abs=0.06)


def test_the_ground_impulse_equals_the_momentum_of_the_fall(fall):
    own = fall.objects["box"]
    wanted = own.mass * 9.81 * fall.times_s[-1]
    # Nothing is logged while it sleeps: the ground carries the weight without an impulse.
    asleep = fall.times_s[np.argmax(own.modes == BodyMode.SLEEPING)]
    given = fall.impulses[-1, 0, 2] + own.mass * 9.81 * (fall.times_s[-1] - asleep)
    assert given == pytest.approx(wanted, rel=0.03)


def test_energy_never_exceeds_that_of_the_first_frame(fall):
    total = fall.energies[:, :3].sum(axis=1)
    assert total.max() <= total[0] * (1 + 1e-6)


def test_a_result_round_trips_through_disk(fall, tmp_path):
    fall.save(tmp_path / "run")
    again = SimulationResult.load(tmp_path / "run")
    assert again.contacts == fall.contacts
    assert again.figures == dict(fall.figures)
    a, b = again.objects["box"], fall.objects["box"]
    for name in ("rest", "positions", "quaternions", "modes", "shape_index", "shapes"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    with pytest.raises(PhysicsError, match="no readable simulation"):
        SimulationResult.load(tmp_path / "nothing")


@pytest.mark.slow
def test_a_moving_body_hits_a_standing_one_and_they_separate():
    striker = box("striker", (0, 0, 0), (2.0, 0, 0))
    struck = box("struck", (0.9, 0, 0))
    result = simulate_bodies(
        [striker, struck], options(striker, struck, gravity=(0, 0, 0), duration=0.8)
    )
    after = {k: o.velocities[-1, 0] for k, o in result.objects.items()}
    assert after["striker"] + after["struck"] == pytest.approx(2.0, abs=1e-3)
    assert after["struck"] > 1.0 > after["striker"]
    assert result.objects["struck"].modes[0] == BodyMode.SLEEPING
    assert result.objects["struck"].modes[-1] == BodyMode.RIGID
    delta = {c.object_id: c.delta_v for c in result.contacts}
    assert delta["struck"] == pytest.approx(after["struck"], abs=1e-3)


def test_a_cancelled_rollout_keeps_its_finished_frames():
    body = box(position=(0, 0, 9))
    calls = []
    result = simulate_bodies(
        [body],
        options(body, frame_rate=20.0),
        on_progress=lambda done, total: calls.append((done, total)),
        cancelled=lambda: len(calls) >= 3,
    )
    assert result.stopped == "cancelled"
    assert result.frames == 4
    assert calls == [(1, 10), (2, 10), (3, 10)]


def test_a_rollout_is_reproducible():
    def run():
        body = box(position=(0, 0, 0.5), velocity=(1.0, 0, -2.0))
        ground = Plane(name="ground", friction=0.7)
        return simulate_bodies([body], options(body, colliders=[ground], duration=0.2)).objects[
            "box"
        ]

    a, b = run(), run()
    assert np.array_equal(a.positions, b.positions)
    assert np.array_equal(a.shapes, b.shapes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": {}}, "no objects"),
        ({"duration": 0.0}, "duration must be positive"),
        ({"preset": "jam"}, "unknown preset 'jam'"),
        ({"brake_after_hit": 2.0}, "brake_after_hit"),
    ],
)
def test_invalid_arguments_are_refused(changes, message):
    with pytest.raises(PhysicsError, match=message):
        SimulateOptions(**{"objects": {"box": ObjectPhysics()}, **changes})


@pytest.mark.parametrize(
    ("young", "density", "seconds"), [(1e12, 200.0, 1.0), (2e5, 1e-9, 1.0), (1e10, 200.0, 1e9)]
)
def test_a_rollout_of_too_many_substeps_is_refused_at_once(young, density, seconds):
    body = box(material=FixedCorotated(young=young, poisson=0.3), density=density)
    said = rf"Young's modulus of {young:.3g} Pa.*substeps of .* at most 200,000".replace("+", r"\+")
    with pytest.raises(PhysicsError, match=said):
        # Frames at two times, because a list of all of them would be long itself.
        simulate_bodies([body], options(body, times_s=[seconds / 2, seconds]))


def test_the_softest_material_that_the_refusal_names_is_accepted():
    body = box(material=FixedCorotated(young=1e12, poisson=0.3))
    with pytest.raises(PhysicsError) as caught:
        simulate_bodies([body], options(body, times_s=[1.0]))
    [most] = re.findall(r"modulus of at most (\S+) Pa", str(caught.value))
    kept = box(material=FixedCorotated(young=0.95 * float(most), poisson=0.3))
    done = simulate_bodies([kept], options(kept, times_s=[1.0]), cancelled=lambda: True)
    assert done.stopped == "cancelled"


def test_a_rollout_of_too_many_frames_is_refused_at_once():
    with pytest.raises(PhysicsError, match=r"30,000,000,000 frames; at most 100,000"):
        options(box(), duration=1e9)
