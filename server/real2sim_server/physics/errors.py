"""Errors of the physics package.

PhysicsError
├── MaterialError    a material parameter outside its range, or an unknown constitutive law
├── ParticleError    particles that cannot be simulated: empty, massless, not finite, too many
├── ColliderError    a collider that makes no sense
├── SolverError      a setting of the solver that is not allowed, or a backend not usable here
└── UnstableError    the simulation diverged and smaller steps did not help
"""

from __future__ import annotations


class PhysicsError(Exception):
    """Something about a simulation is not as it must be. The message says what, and what to do."""


class MaterialError(PhysicsError, ValueError):
    """A material parameter is outside its range, or its constitutive law is unknown."""


class ParticleError(PhysicsError, ValueError):
    """Particles that cannot be simulated."""


class ColliderError(PhysicsError, ValueError):
    """A collider that makes no sense."""


class SolverError(PhysicsError, ValueError):
    """A setting of the solver that is not allowed, or a backend that is not usable here."""


class UnstableError(PhysicsError, RuntimeError):
    """The simulation diverged and smaller steps did not help; names body, step and cause."""
