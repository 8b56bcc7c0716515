"""Views of a scene as recorded, or from beside the recorded path, and how fast they come."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...render import Frame, Instance, RasterOptions, render_cameras
from ...scene import Camera, Scene


def scene_instances(scene: Scene, t_us: int) -> list[Instance]:
    """Background and all objects that exist at ``t_us``, where they were recorded."""
    instances = [Instance(scene.background)]
    for index, item in enumerate(scene.objects.values()):
        if item.trajectory.covers(t_us):
            pose = item.trajectory.transform(t_us)
            instances.append(Instance(item.cloud_at(t_us), pose, instance_id=index + 1))
    return instances


def shifted_pose(T_world_vehicle: Float, left: float) -> Float:
    """``T_world_vehicle`` [4, 4] moved ``left`` [m] along the vehicle's own y axis."""
    shift = np.eye(4)
    shift[1, 3] = left
    return T_world_vehicle @ shift


def render_view(
    scene: Scene, camera: Camera, t_us: int, *, left: float = 0.0, backend: str = "auto"
) -> Frame:
    """Colour and depth of ``camera`` on the recording vehicle at ``t_us``, ``left`` of its path.

    Raises:
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    [frame] = render_cameras(
        scene_instances(scene, t_us),
        [camera],
        shifted_pose(scene.ego.transform(t_us), left),
        sky=scene.sky,
        options=RasterOptions(instance=False),
        backend=backend,
    )
    return frame


def render_uncertainty(
    scene: Scene, camera: Camera, t_us: int, *, backend: str = "auto"
) -> NDArray[np.float32]:
    """Uncertainty [H, W] of what ``camera`` on the recording vehicle sees at ``t_us``.

    Raises:
        RenderError: the scene knows none.
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    [frame] = render_cameras(
        scene_instances(scene, t_us),
        [camera],
        scene.ego.transform(t_us),
        sky=scene.sky,
        modalities=("uncertainty",),
        backend=backend,
    )
    return frame.images["uncertainty"]


def render_logged_view(
    scene: Scene, camera: Camera, t_us: int, *, backend: str = "auto"
) -> NDArray[np.uint8]:
    """RGB [H, W, 3] of ``camera`` on the recording vehicle at ``t_us``, objects as recorded.

    Raises:
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    options = RasterOptions(depth=False, instance=False)
    [frame] = render_cameras(
        scene_instances(scene, t_us),
        [camera],
        scene.ego.transform(t_us),
        sky=scene.sky,
        options=options,
        backend=backend,
    )
    return frame.rgb


@dataclass(frozen=True)
class RenderRate:
    """How fast a scene is drawn.

    Attributes:
        frames_per_second: camera images per second, colour only, all cameras in one call: their
            number by the median time of a call.
        cameras: number of cameras.
        seconds: of each measured call.
    """

    frames_per_second: float
    cameras: int
    seconds: tuple[float, ...]


def measure_rate(
    scene: Scene,
    cameras: Sequence[Camera],
    times_us: Sequence[int],
    *,
    repeats: int = 10,
    backend: str = "auto",
) -> RenderRate:
    """Draw all ``cameras`` at ``times_us`` in turn, ``repeats`` times after one that is not timed.

    Images reach the memory of the host, as they do for users.
    """
    options = RasterOptions(depth=False, instance=False)
    seconds = []
    for index in range(repeats + 1):
        t_us = times_us[index % len(times_us)]
        start = time.perf_counter()
        render_cameras(
            scene_instances(scene, t_us),
            cameras,
            scene.ego.transform(t_us),
            sky=scene.sky,
            options=options,
            backend=backend,
        )
        seconds.append(time.perf_counter() - start)
    timed = tuple(seconds[1:])
    return RenderRate(len(cameras) / statistics.median(timed), len(cameras), timed)
