"""Synthetic drives: a procedural street, ray-cast on the CPU, with ground truth.

This package shares no code with the Gaussian renderer, so that it can serve as a reference for it.
"""

from .log import SyntheticLog, generate_log, synthesize
from .street import CameraSpec, SyntheticConfig

__all__ = ["CameraSpec", "SyntheticConfig", "SyntheticLog", "generate_log", "synthesize"]
