"""Ways to solve, one module each, behind one Protocol."""

from .base import Backend, Measure, Model, ParticleArrays, Simulation
from .select import BACKENDS, select_backend

__all__ = [
    "BACKENDS",
    "Backend",
    "Measure",
    "Model",
    "ParticleArrays",
    "Simulation",
    "select_backend",
]
