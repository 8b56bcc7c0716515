"""Gaussians with mass: particles, materials, colliders, contact and the solver."""

from .body import Body
from .colliders import Box, Collider, HeightField, Plane
from .errors import (
    ColliderError,
    MaterialError,
    ParticleError,
    PhysicsError,
    SolverError,
    UnstableError,
)
from .materials import Foam, Jelly, Material, Metal, NearRigid, NeoHookean, Sand, Snow
from .particles import Particles, ball_particles, box_particles
from .solver import BodyState, Contact, Energies, Solver, SolverOptions, StepReport

__all__ = [
    "Body",
    "BodyState",
    "Box",
    "Collider",
    "ColliderError",
    "Contact",
    "Energies",
    "Foam",
    "HeightField",
    "Jelly",
    "Material",
    "MaterialError",
    "Metal",
    "NearRigid",
    "NeoHookean",
    "ParticleError",
    "Particles",
    "PhysicsError",
    "Plane",
    "Sand",
    "Snow",
    "Solver",
    "SolverError",
    "SolverOptions",
    "StepReport",
    "UnstableError",
    "ball_particles",
    "box_particles",
]
