"""Reinforcement learning without a socket: many worlds in the process of the learner.

Importing this registers ``real2sim/DriveBatch-v0`` with Gymnasium; it needs the extra ``gym``.
"""

import gymnasium

from .vector_env import VectorDriveEnv

ENVIRONMENT = "real2sim/DriveBatch-v0"

if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(
        id=ENVIRONMENT, vector_entry_point="real2sim_server.learning.vector_env:VectorDriveEnv"
    )

__all__ = ["ENVIRONMENT", "VectorDriveEnv"]
