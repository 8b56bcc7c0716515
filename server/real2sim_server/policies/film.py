"""The film of a recorded episode: one camera with speed, scores, events, and a map."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import quaternion_yaw
from ..render import RasterOptions, render_cameras, select_backend
from ..render.video import video_file
from ..scene import Scene
from ..world import World
from ..world.recording.recording import Recording
from ..world.recording.replay import Replayer
from .plots import rectangle_corners

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

MAP_PIXELS, MAP_METRES = 160, 60.0
BACKGROUND, ROUTE, OBJECT, EGO = (40, 40, 40), (160, 160, 160), (255, 140, 60), (120, 220, 120)
"""Colors of the map."""


def film_episode(
    recording: Recording,
    replayer: Replayer,
    scene: Scene,
    path: Path,
    *,
    camera: str | None = None,
    width: int = 640,
) -> None:
    """Write an MP4 of an episode as it is replayed, an image a step.

    Args:
        recording: the episode.
        replayer: of it, before its first entry.
        scene: that it ran on.
        path: file to write.
        camera: name; None: the first one.
        width: of the film [px].
    """
    chosen = scene.rig[camera or scene.rig.names[0]].resized(width)
    backend = select_backend("auto")
    with contextlib.ExitStack() as stack:
        video = None
        for world in _instants(recording, replayer):
            (frame,) = render_cameras(
                world.instances(),
                [chosen],
                world.T_world_body,
                sky=scene.sky,
                options=RasterOptions(),
                backend=backend,
            )
            image = np.array(frame.rgb)
            _draw_caption(image, world)
            _draw_map(image, world)
            if video is None:
                rate = 1e6 / world.spec.dt_us
                video = stack.enter_context(video_file(path, frames_per_second=rate))
            video.add(image)


def _instants(recording: Recording, replayer: Replayer) -> Iterator[World]:
    for entry in recording.entries:
        world = replayer.apply(entry)
        if entry.kind in {"reset", "action", "restore"}:
            yield world


def _draw_caption(image: Image, world: World) -> None:
    metrics = world.metrics()
    lines = [
        f"{(world.t_us - world.scene.start_us) * 1e-6:5.1f} s  {world.motion.speed:4.1f} m/s",
        f"pdms {metrics['pdms']:.2f}  completed {100 * metrics['route_completion']:.0f} %",
        *(f"{e.type} {e.object_id or ''}" for e in world.observe().events),
    ]
    for k, line in enumerate(lines):
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(
                image, line, (8, 18 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness
            )


def _draw_map(image: Image, world: World) -> None:
    """Into the lower right corner: seen from above, the ego heading up."""
    size = min(MAP_PIXELS, image.shape[0] // 2, image.shape[1] // 2)
    scale, motion = size / MAP_METRES, world.motion
    drawn = np.full((size, size, 3), BACKGROUND, np.uint8)
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)

    def to_pixels(points: Array) -> NDArray[np.int32]:
        d = points - [motion.x, motion.y]
        ahead, left = d @ [cos, sin], d @ [-sin, cos]
        return np.stack([size / 2 - scale * left, 0.75 * size - scale * ahead], 1).astype(np.int32)

    cv2.polylines(drawn, [to_pixels(world.context.route)], False, ROUTE, 1)
    agents = world.agents
    for k in range(len(agents.objects)):
        yaw = float(quaternion_yaw(agents.quaternions[k]))
        corners = rectangle_corners(agents.positions[k, :2], yaw, agents.sizes[k])
        cv2.fillPoly(drawn, [to_pixels(corners)], OBJECT)
    ahead = world.context.centre_ahead
    centre = np.array([motion.x + ahead * cos, motion.y + ahead * sin])
    corners = rectangle_corners(centre, motion.yaw, np.array(world.scene.ego_size))
    cv2.fillPoly(drawn, [to_pixels(corners)], EGO)
    image[-size:, -size:] = drawn
