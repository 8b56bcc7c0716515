"""Simulation of a scene's objects as rigid, deforming and resting bodies."""

from .particles import Filling, fill_object
from .result import ContactRecord, ObjectResult, Playback, SimulationResult
from .rollout import SimulateOptions, simulate
from .structure import CLASS_MASSES, PRESETS, ObjectPhysics, default_mass

__all__ = [
    "CLASS_MASSES",
    "PRESETS",
    "ContactRecord",
    "Filling",
    "ObjectPhysics",
    "ObjectResult",
    "Playback",
    "SimulateOptions",
    "SimulationResult",
    "default_mass",
    "fill_object",
    "simulate",
]
