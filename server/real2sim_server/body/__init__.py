"""People and bicycles as moving surfaces: a body model, linear blend skinning, gait and cycling.

The body frame has its origin on the ground under the pelvis: x forward, y left, z up, metres. Joint
rotations follow SMPL-like models: zero is the rest pose, and each rotation moves all parts below
its joint, about the axes of the body frame.
"""

from .model import (
    JOINTS,
    Body,
    BodyModel,
    Pose,
    body_model,
    joint_transforms,
    keypoints,
    rest_pose,
    skin,
)

__all__ = [
    "JOINTS",
    "Body",
    "BodyModel",
    "Pose",
    "body_model",
    "joint_transforms",
    "keypoints",
    "rest_pose",
    "skin",
]
