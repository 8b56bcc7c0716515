"""What a camera saw along a drive, and what it would have seen beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from real2sim.planners.learned import PolicyShape

from ..edit import ScenarioState
from ..edit.compose import instances_at
from ..geometry.rotation import transform_from
from ..logs import DrivingLog
from ..render import render_cameras, select_backend
from ..scene import Scene

STEP_US = 100_000
"""Between views of a scene."""
SIDEWAYS, TURNED = 1.0, 0.12
"""Standard deviations of views beside the path, cut at two of them [m], [rad]."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One image and where it was seen from.

    Attributes:
        image: RGB uint8 [H, W, 3].
        t_us: instant.
        T_world_vehicle: [4, 4] float64, of the vehicle that the camera is on.
        frame: number of the instant.
        count: of all views of the drive.
    """

    image: NDArray[np.uint8]
    t_us: int
    T_world_vehicle: NDArray[np.float64]
    frame: int
    count: int


def logged_views(log: DrivingLog, shape: PolicyShape) -> Iterator[Seen]:
    """The images of a log."""
    for frame in range(log.frame_count):
        t_us = log.image_time_us(shape.camera, frame)
        pose = transform_from(*log.ego.pose(t_us))
        yield Seen(log.image(shape.camera, frame), t_us, pose, frame, log.frame_count)


def scene_views(scene: Scene, shape: PolicyShape, *, shifted: int, seed: int) -> Iterator[Seen]:
    """Views along the recorded path of a scene, and ``shifted`` beside it at each instant.

    A policy that has only seen the path does not know how to come back to it (Pomerleau 1989
    turned images for that; here the scene is drawn from where the vehicle would be).
    """
    draw = np.random.default_rng(seed)
    camera = scene.rig[shape.camera].resized(2 * shape.width)
    backend, state = select_backend("auto"), ScenarioState.of(scene)
    instants = range(scene.start_us, scene.end_us + 1, STEP_US)
    for frame, t_us in enumerate(instants):
        middle = transform_from(*scene.ego.pose(t_us))
        for k in range(shifted + 1):
            pose = middle @ _shift(draw) if k else middle
            (drawn,) = render_cameras(
                instances_at(scene, state, t_us), [camera], pose, sky=scene.sky, backend=backend
            )
            yield Seen(drawn.rgb, t_us, pose, frame, len(instants) * (shifted + 1))


def _shift(draw: np.random.Generator) -> NDArray[np.float64]:
    aside, turn = np.clip(draw.normal(size=2), -2.0, 2.0) * [SIDEWAYS, TURNED]
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, -s, 0, 0], [s, c, 0, aside], [0, 0, 1, 0], [0, 0, 0, 1]])
