"""Vehicle cameras and their images."""

from __future__ import annotations

import math

import numpy as np

from real2sim.images import Frame

from . import road

K = np.array([[300.0, 0, 24], [0, 310.0, 16], [0, 0, 1]])
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Camera axes (x right, y down, z forward) in a vehicle that looks the same way."""
CAMERAS = {"front": 0.0, "left": 50.0, "CAM_BACK": 180.0}
"""Directions by name, positive to the left [degrees]."""


def turned(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def camera_on_vehicle(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = turned(degrees) @ FORWARD
    pose[:3, 3] = (1.5, 0.2, 1.4)
    return pose


def seen(*, position=(100.0, 50.0, 2.0), yaw=30.0, **options):
    """An observation with one image per camera. The k-th of CAMERAS has grey level ``10 k``."""
    T_world_ego = np.eye(4)
    T_world_ego[:3, :3], T_world_ego[:3, 3] = turned(yaw), position
    frames = {}
    for k, (name, degrees) in enumerate(CAMERAS.items()):
        image = np.full((32, 48, 3), 10 * k, np.uint8)
        frame = Frame(
            data=image.tobytes(),
            codec="raw",
            modality="rgb",
            dtype="uint8",
            shape=image.shape,
            sensor=name,
            t_us=1_000_000,
            T_world_sensor=T_world_ego @ camera_on_vehicle(degrees),
            K=K,
        )
        frames[name] = {"rgb": frame}
    options = {"speed": 6.0} | options
    return road.observation(
        road.STRAIGHT, position=position, yaw=math.radians(yaw), frames=frames, **options
    )
