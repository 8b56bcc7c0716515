"""Images with poses: what a camera saw along a drive, and what it would have seen beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from real2sim.planners.learned import PolicyShape

from ..edit import ScenarioState
from ..edit.compose import instances_at
from ..geometry.transform import transform_from
from ..logs import DrivingLog
from ..render import render_cameras, select_backend
from ..scene import Scene

STEP_US = 100_000
"""Between instants of a scene at which images are drawn."""
LATERAL_SIGMA, YAW_SIGMA = 1.0, 0.12
"""Standard deviations of poses beside the path, cut at two of them [m], [rad]."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One image and where it was taken.

    Attributes:
        rgb: uint8 [H, W, 3].
        t_us: instant.
        T_world_vehicle: [4, 4] float64, of the vehicle that carries the camera.
        frame: number of the instant.
        count: of all images of the drive.
    """

    rgb: NDArray[np.uint8]
    t_us: int
    T_world_vehicle: NDArray[np.float64]
    frame: int
    count: int


def log_images(log: DrivingLog, shape: PolicyShape) -> Iterator[PosedImage]:
    """The images of a log."""
    for frame in range(log.frame_count):
        t_us = log.image_time_us(shape.camera, frame)
        pose = transform_from(*log.ego.pose(t_us))
        yield PosedImage(log.image(shape.camera, frame), t_us, pose, frame, log.frame_count)


def scene_images(
    scene: Scene, shape: PolicyShape, *, shifted: int, seed: int
) -> Iterator[PosedImage]:
    """Images drawn along the recorded path of a scene, and ``shifted`` beside it at each instant.

    A policy that has only seen the path does not know how to come back to it (Pomerleau 1989
    turned images for that; here the scene is drawn from where the vehicle would be).
    """
    rng = np.random.default_rng(seed)
    camera = scene.rig[shape.camera].resized(2 * shape.width)
    backend, state = select_backend("auto"), ScenarioState.of(scene)
    instants = range(scene.start_us, scene.end_us + 1, STEP_US)
    for frame, t_us in enumerate(instants):
        T_world_ego = transform_from(*scene.ego.pose(t_us))
        for k in range(shifted + 1):
            pose = T_world_ego @ _random_offset(rng) if k else T_world_ego
            (rendered,) = render_cameras(
                instances_at(scene, state, t_us), [camera], pose, sky=scene.sky, backend=backend
            )
            yield PosedImage(rendered.rgb, t_us, pose, frame, len(instants) * (shifted + 1))


def _random_offset(rng: np.random.Generator) -> NDArray[np.float64]:
    lateral, yaw = np.clip(rng.normal(size=2), -2.0, 2.0) * [LATERAL_SIGMA, YAW_SIGMA]
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, 0], [s, c, 0, lateral], [0, 0, 1, 0], [0, 0, 0, 1]])
