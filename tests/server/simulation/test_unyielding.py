"""Only bodies that can yield become particles; the rest stay rigid and receive the reaction."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import Box, FixedCorotated, Foam, Plane, box_particles
from real2sim_server.physics.materials import Structure
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.simulator import STEP, HybridSimulator, as_boxes, withstands
from real2sim_server.simulation.structure import vehicle_structure
from real2sim_server.simulation.tyres import Tyres

FOAM = Foam(young=4e5, poisson=0.3, yield_stress=3e4, plastic_viscosity=2e3, viscosity=400)
FRAME = Structure(young=1e6, poisson=0.0, critical_compression=0.03)
REST = (0.0, 0.0, 0.0)


def body(name, size, mass, pose, *, material, spacing=0.1, velocity=REST, spin=REST):
    particles = box_particles(size, spacing=spacing, density=100.0).with_mass(mass)
    return DeformableBody(
        name,
        particles,
        [material],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.4,
        cell=0.2,
        T_world_object=pose,
        velocity=np.array(velocity),
        angular_velocity=np.array(spin),
    )


def truck(speed=8.0, material=FRAME, spin=REST):
    return body(
        "truck",
        (2.0, 2.4, 2.0),
        2e4,
        at(0, 0, 0),
        material=material,
        spacing=0.2,
        velocity=(speed, 0.0, 0.0),
        spin=spin,
    )


def cone(mass=3.0, speed=0.0):
    pose = at(1.5, 0.5, -0.5)
    return body("cone", (0.4, 0.4, 0.6), mass, pose, material=FOAM, velocity=(speed, 0.0, 0.0))


def simulator(*bodies, colliders=(), gravity=(0.0, 0.0, 0.0), **options):
    options = {"backend": "cpu", "brake_after_hit": 1.0, **options}
    return HybridSimulator(bodies, colliders, road=["ground"], gravity=gravity, **options)


def run(world, seconds):
    """Continue; returns which bodies have deformed."""
    deformed = set()
    for _ in range(round(seconds / STEP)):
        world.advance(STEP)
        deformed |= {b.name for b in world.bodies if b.mode == BodyMode.DEFORMING}
    return deformed


def momenta(bodies):
    """Momentum, and angular momentum about the world origin."""
    linear = sum(b.motion.momentum for b in bodies)
    turning = sum(
        b.motion.angular_momentum + np.cross(b.motion.centre, b.motion.momentum) for b in bodies
    )
    return np.concatenate([linear, turning])


def test_a_truck_stays_rigid_and_throws_a_cone_forward():
    bodies = truck(), cone()
    before = momenta(bodies)
    world = simulator(*bodies)
    assert run(world, 0.25) == {"cone"}
    assert bodies[1].motion.velocity[0] > 0.98 * bodies[0].motion.velocity[0]
    assert bodies[0].motion.angular_velocity[2] != 0.0
    given = bodies[1].motion.momentum[0]
    assert momenta(bodies) == pytest.approx(before, rel=0, abs=1e-3 * given)
    totals = world.contact_log.totals()
    assert totals["truck", "cone"] == pytest.approx(-totals["cone", "truck"])


def test_a_standing_body_is_pushed_by_what_it_stops():
    bodies = truck(speed=0.0), cone(speed=-6.0)
    world = simulator(*bodies)
    assert bodies[0].mode == BodyMode.SLEEPING
    assert run(world, 0.15) == {"cone"}
    assert bodies[1].motion.velocity[0] > -0.1
    assert bodies[0].motion.momentum[0] == pytest.approx(
        -18.0 - bodies[1].motion.momentum[0], abs=0.01
    )


@pytest.mark.parametrize(
    ("heavy", "light", "holds"),
    [
        (truck, cone, True),
        (lambda: truck(40.0), cone, False),
        (truck, lambda: cone(mass=3e3), False),
        (lambda: truck(material=FixedCorotated(young=2e6)), cone, False),
        (cone, truck, False),
    ],
    ids=["a cone", "a fast cone", "nearly as heavy", "what is only elastic", "a truck"],
)
def test_the_load_a_body_withstands(heavy, light, holds):
    assert withstands(heavy(), light(), np.zeros(3)) == holds


def test_boxes_cover_touchable_parts_and_move_along():
    moved = truck(spin=(0.0, 0.0, 1.0))
    (box,) = as_boxes(moved, cone())
    pose, size = np.asarray(box.T_world_box), np.asarray(box.size)
    assert pose[0, 3] + size[0] / 2 == pytest.approx(1.0)
    assert pose[1, 3] + size[1] / 2 == pytest.approx(1.2)
    assert box.velocity == pytest.approx([8.0 - pose[1, 3], pose[0, 3], 0.0])


def test_colliders_move_once_per_step_alongside_wheels():
    """When the tyres end the solver, it has already moved them."""
    car = vehicle("car", (2.0, 1.0, 1.0), 500.0, at(0, 0, 0.5))
    far = Box(name="far", T_world_box=at(0, 50, 1), size=(1, 1, 1), velocity=(2.0, 0.0, 0.0))
    world = simulator(car, colliders=[Plane(name="ground"), far], gravity=(0.0, 0.0, -9.81))
    car.activate()
    for _ in range(2):
        world.advance(STEP)
    assert world.colliders[1].T_world_box[0, 3] == pytest.approx(2 * STEP * 2.0)


def vehicle(category, size, mass, pose, *, name=None, velocity=REST, brake=0.0, spacing=0.1):
    """A preset vehicle on its wheels: a box of particles starting 12 cm above the road."""
    length, width, height = size
    particles = box_particles((length, width, height - 0.12), spacing=spacing, density=100.0)
    particles = particles.moved(at(0, 0, 0.06)).with_mass(mass)
    materials, regions, particles = vehicle_structure(category, particles, spacing=spacing)
    particles = particles.with_centre_height(0.4 * height - height / 2)
    return DeformableBody(
        name or category,
        particles,
        materials,
        regions,
        friction=0.4,
        cell=2 * spacing,
        T_world_object=pose,
        velocity=np.array(velocity),
        angular_velocity=np.zeros(3),
        tyres=Tyres.of(size, particles.centre_of_mass, mass * 9.81, brake=brake),
    )


TRUCK = (8.0, 2.5, 3.0)
GROUND, GRAVITY = (Plane(name="ground"),), (0.0, 0.0, -9.81)


def truck_and_cone():
    ahead = body("cone", (0.4, 0.4, 0.7), 3.0, at(5.0, 0.2, 0.35), material=FOAM)
    return vehicle("truck", TRUCK, 2e4, at(0, 0, 1.5), velocity=(8.0, 0.0, 0.0)), ahead


def low_car(height: float, fall: float = 0.0):
    """A car on its wheels with its floor ``height`` [m] above the road, as after a crash."""
    car = vehicle("car", (3.0, 1.6, 1.2), 1000.0, at(0, 0, 0.6), velocity=(8.0, 0.0, -fall))
    lowered = car.rest.moved(at(0, 0, height - 0.12))
    return DeformableBody(
        "car",
        lowered,
        car.materials,
        car.regions,
        friction=0.4,
        cell=0.2,
        T_world_object=at(0, 0, 0.6),
        velocity=car.motion.velocity,
        angular_velocity=np.zeros(3),
        tyres=car.tyres,
    )


@pytest.mark.parametrize("height", [0.02, -0.02])
def test_a_low_or_dragging_floor_does_not_deform(height):
    car = low_car(height)
    world = simulator(car, colliders=GROUND, gravity=GRAVITY)
    assert run(world, 0.2) == set()
    assert car.motion.velocity[0] > 5.0
    floor = car.hull_points()[:, 2].min() - car.spacing / 2
    assert abs(floor - height) < 0.03


def test_a_floor_that_strikes_the_road_deforms():
    assert run(simulator(low_car(0.02, fall=2.0), colliders=GROUND, gravity=GRAVITY), 0.01)


@pytest.mark.slow
def test_hitting_a_cone_needs_no_truck_particles():
    world = simulator(*truck_and_cone(), colliders=GROUND, gravity=GRAVITY)
    assert run(world, 1.0) == {"cone"}
