"""From driving logs to scenes of Gaussians."""

from .evaluation import EvaluationReport, ViewScore, evaluate_views
from .initialise.stage0 import initialise_scene
from .options import InitialiseOptions, ReconstructError
from .run import ReconstructReport, TrainingFigures, reconstruct

__all__ = [
    "EvaluationReport",
    "InitialiseOptions",
    "ReconstructError",
    "ReconstructReport",
    "TrainingFigures",
    "ViewScore",
    "evaluate_views",
    "initialise_scene",
    "reconstruct",
]
