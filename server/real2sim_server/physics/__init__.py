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
from .fill import Filling, fill_object
from .masses import CLASS_MASSES, default_mass
from .materials import Foam, Jelly, Material, Metal, NearRigid, NeoHookean, Sand, Snow
from .particles import Particles, ball_particles, box_particles
from .restitution import RestitutionFit, fit_restitution
from .solver import BodyState, Contact, Energies, Solver, SolverOptions, StepReport

__all__ = [
    "CLASS_MASSES",
    "Body",
    "BodyState",
    "Box",
    "Collider",
    "ColliderError",
    "Contact",
    "Energies",
    "Filling",
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
    "RestitutionFit",
    "Sand",
    "Snow",
    "Solver",
    "SolverError",
    "SolverOptions",
    "StepReport",
    "UnstableError",
    "ball_particles",
    "box_particles",
    "default_mass",
    "fill_object",
    "fit_restitution",
]
