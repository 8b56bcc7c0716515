"""Physics of Gaussians: particles, materials, colliders, contact and the MPM solver."""

from .body import Body, Particles, ball_particles, box_particles
from .calibration import Calibration, calibrate
from .colliders import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    HeightField,
    Plane,
    Solid,
    TriangleMesh,
    TriangleSurface,
)
from .errors import (
    ColliderError,
    MaterialError,
    ParticleError,
    PhysicsError,
    SolverError,
    UnstableError,
)
from .fitting import RestitutionFit, fit_restitution
from .materials import FixedCorotated, Foam, Material, Metal, NearRigid, NeoHookean, Sand, Snow
from .solver import BodyState, ContactTotals, Energies, Solver, SolverOptions, StepReport

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
