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
from .fill import Filling, fill_object
from .masses import CLASS_MASSES, default_mass
from .materials import Foam, Jelly, Material, Metal, NearRigid, NeoHookean, Sand, Snow
from .particles import Particles, ball_particles, box_particles
from .playback import Playback
from .presets import PRESETS, ObjectPhysics
from .restitution import RestitutionFit, fit_restitution
from .result import ContactRecord, ObjectResult, SimulationResult
from .simulation import SimulateOptions, simulate
from .solver import BodyState, Contact, Energies, Solver, SolverOptions, StepReport

__all__ = [
    "CLASS_MASSES",
    "PRESETS",
    "Body",
    "BodyState",
    "Box",
    "Calibration",
    "Collider",
    "ColliderError",
    "Contact",
    "ContactRecord",
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
    "ObjectPhysics",
    "ObjectResult",
    "ParticleError",
    "Particles",
    "PhysicsError",
    "Plane",
    "Playback",
    "RestitutionFit",
    "Sand",
    "SimulateOptions",
    "SimulationResult",
    "Snow",
    "Solver",
    "SolverError",
    "SolverOptions",
    "StepReport",
    "UnstableError",
    "ball_particles",
    "box_particles",
    "calibrate",
    "default_mass",
    "fill_object",
    "fit_restitution",
    "simulate",
]
