"""From a scenario's objects to bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..scene import Scene
from ..scene.rotation import Float, is_rigid
from .colliders import Collider
from .coupling import Tyres, stretched
from .coupling.actor import Actor
from .errors import PhysicsError
from .fill import fill_object
from .playback import PlacedObject, PlacedObjects
from .presets import VEHICLES, ObjectPhysics, Preset
from .restitution import fit_restitution
from .solver import SolverOptions

STANDS_WITHIN = 0.4
"""A vehicle starts on its tyres when they are no further from the road than this [m]."""
RESTITUTION_SPEED = 2.0
"""Approach at which a wanted restitution is fitted when the object itself stands [m/s]."""


def cast(
    scene: Scene,
    state: PlacedObjects,
    wanted: Mapping[str, ObjectPhysics],
    *,
    preset: Preset,
    start_us: int,
    colliders: Sequence[Collider],
    gravity: Float,
) -> list[Actor]:
    """A body for each wanted object, as it is at the start.

    Raises:
        PhysicsError: for an object that is not there at ``start_us``, and as ``fill_object``.
    """
    there = {o.object_id: o for o in state.visible}
    actors = []
    for object_id, physics in wanted.items():
        if object_id not in there:
            raise PhysicsError(f"no object {object_id!r} to simulate; there are {sorted(there)}")
        subject = there[object_id]
        if physics.T_world_object is None and not subject.trajectory.covers(start_us):
            raise PhysicsError(
                f"object {object_id!r} is not there at {start_us} us; it is from "
                f"{subject.trajectory.start_us} to {subject.trajectory.end_us} us"
            )
        actors.append(
            _actor(scene, subject, physics, preset, start_us, colliders=colliders, gravity=gravity)
        )
    return actors


def _actor(
    scene: Scene,
    subject: PlacedObject,
    physics: ObjectPhysics,
    preset: Preset,
    start_us: int,
    *,
    colliders: Sequence[Collider],
    gravity: Float,
) -> Actor:
    size = subject.scaled_size
    wheels = preset.wheels and subject.category in VEHICLES
    cloud = stretched(scene.object(subject.source_id).cloud_at(start_us), subject.scale)
    filling = fill_object(
        cloud, size, spacing=preset.spacing, mass=physics.mass, category=subject.category
    )
    above = -size[2] / 2 + preset.clearance if wheels else -np.inf
    particles = filling.lattice(above=above)
    materials, regions_of = preset.build(subject.category, size[0])
    regions = regions_of(particles.positions[:, 0])
    if physics.material is not None:
        materials, regions = (physics.material,), np.zeros(len(particles), dtype=np.int64)
    if preset.by_density and physics.mass is None:
        particles = particles.with_mass(materials[0].density * float(particles.volumes.sum()))
    pose = _pose(subject, physics, start_us)
    velocity = _vector(physics.velocity, subject, start_us)
    spin = np.zeros(3) if physics.angular_velocity is None else np.array(physics.angular_velocity)
    tyres = None
    if wheels:
        weight = particles.mass * float(np.linalg.norm(gravity))
        standing = float(np.linalg.norm(velocity)) < 0.1
        brake = physics.brake if physics.brake is not None else float(standing)
        centre = particles.centre_of_mass
        tyres = Tyres.of(size, centre, max(weight, 1e-6), brake=brake)
        tyres = tyres.standing(pose, colliders, STANDS_WITHIN)
    actor = Actor(
        subject.object_id,
        particles,
        materials,
        regions,
        friction=preset.friction if physics.friction is None else physics.friction,
        cell=2 * preset.spacing,
        T_world_object=pose,
        velocity=velocity,
        angular_velocity=spin,
        tyres=tyres,
    )
    if physics.restitution is not None:
        _fit(actor, physics.restitution)
    return actor


def _pose(subject: PlacedObject, physics: ObjectPhysics, start_us: int) -> Float:
    if physics.T_world_object is None:
        return subject.trajectory.transform(start_us)
    pose = np.array(physics.T_world_object, dtype=np.float64)
    if not is_rigid(pose):
        raise PhysicsError(f"T_world_object of {subject.object_id!r} must be rigid: {pose!r}")
    return pose


def _vector(given: object, subject: PlacedObject, start_us: int) -> Float:
    if given is None:
        return subject.trajectory.velocity(start_us)
    velocity = np.array(given, dtype=np.float64)
    if velocity.shape != (3,) or not np.isfinite(velocity).all():
        raise PhysicsError(
            f"velocity of {subject.object_id!r} must be 3 finite numbers [m/s], not {given!r}"
        )
    return velocity


def _fit(actor: Actor, restitution: float) -> None:
    """Add the viscosity that lets the body bounce as wanted, along its own way."""
    speed = float(np.linalg.norm(actor.motion.velocity))
    along = actor.motion.velocity / speed if speed > 0.1 else actor.motion.rotation[:, 0]
    fitted = fit_restitution(
        replace(actor.body(), particle_velocities=None, particle_gradients=None),
        restitution,
        speed=speed if speed > 0.1 else RESTITUTION_SPEED,
        normal=-along,
        options=SolverOptions(dx=actor.cell, gravity=(0.0, 0.0, 0.0)),
    )
    actor.materials = fitted.body.materials
