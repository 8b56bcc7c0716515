"""Ways to solve, one module each, behind one Protocol."""

from .base import Measure, Model, ParticleArrays, Simulation, SolverBackend
from .select import BACKENDS, select_backend

__all__ = [
    "BACKENDS",
    "Measure",
    "Model",
    "ParticleArrays",
    "Simulation",
    "SolverBackend",
    "select_backend",
]
