"""Gaussians with mass: particles, materials, colliders, contact and the solver."""

from .body import Body
from .calibration import Calibration, calibrate
from .colliders import Box, Capsule, Collider, Cylinder, HeightField, Plane, Solid
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
from .triangle_mesh import TriangleMesh, TriangleSurface

__all__ = [
    "Body",
    "BodyState",
    "Box",
    "Calibration",
    "Capsule",
    "Collider",
    "ColliderError",
    "ContactTotals",
    "Cylinder",
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
    "Solid",
    "Solver",
    "SolverError",
    "SolverOptions",
    "StepReport",
    "TriangleMesh",
    "TriangleSurface",
    "UnstableError",
    "ball_particles",
    "box_particles",
    "calibrate",
    "fit_restitution",
]
