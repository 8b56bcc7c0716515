"""Simulation of a scene's objects as rigid, deforming and resting bodies."""

from .fill import Filling, fill_object
from .playback import Playback
from .presets import PRESETS, ObjectPhysics
from .result import ContactRecord, ObjectResult, SimulationResult
from .rollout import SimulateOptions, simulate
from .structure import CLASS_MASSES, default_mass

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
