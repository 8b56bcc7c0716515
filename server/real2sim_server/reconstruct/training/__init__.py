"""Training: optimises the scene of stage 0 until it renders like the log."""

from .data import held_out_frames, training_log
from .densify import DensifyOptions
from .losses import LossWeights
from .model import SceneModel
from .records import OnTraining, TrainingProgress
from .run import HeldOutScore, TrainResult, score_held_out, smoothed_boxes, train, with_box_noise
from .schedule import PRESETS, LearningRates, TrainOptions, preset
from .trainer import Trainer

__all__ = [
    "PRESETS",
    "DensifyOptions",
    "HeldOutScore",
    "LearningRates",
    "LossWeights",
    "OnTraining",
    "SceneModel",
    "TrainOptions",
    "TrainResult",
    "Trainer",
    "TrainingProgress",
    "held_out_frames",
    "preset",
    "score_held_out",
    "smoothed_boxes",
    "train",
    "training_log",
    "with_box_noise",
]
