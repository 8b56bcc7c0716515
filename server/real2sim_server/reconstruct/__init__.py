"""From driving logs to scenes of Gaussians."""

from .evaluation import CoverageReport, CoverageScore, evaluate_views
from .initialise.stage0 import initialise_scene
from .options import InitialiseOptions, ReconstructError
from .run import ReconstructReport, TrainingFigures, reconstruct

__all__ = [
    "CoverageReport",
    "CoverageScore",
    "InitialiseOptions",
    "ReconstructError",
    "ReconstructReport",
    "TrainingFigures",
    "evaluate_views",
    "initialise_scene",
    "reconstruct",
]
