"""Reconstruction of Gaussian scenes from driving logs."""

from .evaluation import CoverageReport, CoverageScore, evaluate_views
from .initialise.stage0 import initialise_scene
from .options import InitialiseOptions, ReconstructError
from .run import ReconstructOptions, ReconstructReport, TrainingFigures, reconstruct

__all__ = [
    "CoverageReport",
    "CoverageScore",
    "InitialiseOptions",
    "ReconstructError",
    "ReconstructOptions",
    "ReconstructReport",
    "TrainingFigures",
    "evaluate_views",
    "initialise_scene",
    "reconstruct",
]
