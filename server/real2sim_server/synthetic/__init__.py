"""Synthetic drives: a procedural street, ray-cast on the CPU, with ground truth.

It shares no code with the renderer of Gaussians, so that it can be its judge.
"""

from .log import SyntheticLog, generate_log, synthesize
from .street import CameraSpec, SyntheticConfig

__all__ = ["CameraSpec", "SyntheticConfig", "SyntheticLog", "generate_log", "synthesize"]
