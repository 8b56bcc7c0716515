"""Errors of the physics package.

PhysicsError
├── MaterialError    a material parameter outside its range, or an unknown constitutive law
├── ParticleError    particles that cannot be simulated: empty, massless, not finite, too many
├── ColliderError    an invalid collider
├── SolverError      an invalid solver option, or an unusable backend
└── UnstableError    the simulation diverged and smaller steps did not help
"""

from __future__ import annotations


class PhysicsError(Exception):
    """Base class of physics errors. The message names the problem and suggests a fix."""


class MaterialError(PhysicsError, ValueError):
    """A material parameter is outside its range, or its constitutive law is unknown."""


class ParticleError(PhysicsError, ValueError):
    """Particles that cannot be simulated."""


class ColliderError(PhysicsError, ValueError):
    """An invalid collider."""


class SolverError(PhysicsError, ValueError):
    """An invalid solver option, or an unusable backend."""


class UnstableError(PhysicsError, RuntimeError):
    """The simulation diverged and smaller steps did not help; names body, step and cause."""
