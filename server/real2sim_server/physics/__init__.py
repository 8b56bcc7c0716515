"""Gaussians with mass: particles, materials, colliders, contact and the solver."""

from .body import Body
from .calibration import Calibration, calibrate
from .colliders import Box, Collider, HeightField, Plane
from .errors import (
    ColliderError,
    MaterialError,
    ParticleError,
    PhysicsError,
    SolverError,
    UnstableError,
)
from .materials import FixedCorotated, Foam, Material, Metal, NearRigid, NeoHookean, Sand, Snow
from .particles import Particles, ball_particles, box_particles
from .restitution import RestitutionFit, fit_restitution
from .solver import BodyState, ContactTotals, Energies, Solver, SolverOptions, StepReport

__all__ = [
    "Body",
    "BodyState",
    "Box",
    "Calibration",
    "Collider",
    "ColliderError",
    "ContactTotals",
    "Energies",
    "FixedCorotated",
    "Foam",
    "HeightField",
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
    "calibrate",
    "fit_restitution",
]
