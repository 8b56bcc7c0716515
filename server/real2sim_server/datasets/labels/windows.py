"""The part of an image in which all of an object shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...geometry.rotation import Float
from ...render.types import Window
from ...scene import Camera
from .boxes import Box2D, ObjectBox, projected_box

MARGIN = 0.1
"""Gaussians of an object reach beyond its box: by this share of its projection, at least 8 px."""


def object_windows(
    boxes: Sequence[ObjectBox], camera: Camera, T_world_camera: Float
) -> list[Window]:
    """Windows of the objects that are in an image, in their order."""
    found = []
    for box in boxes:
        whole = projected_box(box.T_world_object, box.size, camera, T_world_camera)
        if whole is not None:
            window = window_about(box.instance_id, whole, camera)
            if window.left < window.right and window.top < window.bottom:
                found.append(window)
    return found


def window_about(instance_id: int, whole: Box2D, camera: Camera) -> Window:
    """Whole pixels about a projected box."""
    wide = max(8.0, MARGIN * (whole[2] - whole[0]))
    high = max(8.0, MARGIN * (whole[3] - whole[1]))
    # Boxes that reach behind the camera have corners at enormous places.
    return Window(
        instance_id,
        math.floor(min(max(whole[0] - wide, 0.0), float(camera.width))),
        math.floor(min(max(whole[1] - high, 0.0), float(camera.height))),
        math.ceil(max(min(whole[2] + wide, float(camera.width)), 0.0)),
        math.ceil(max(min(whole[3] + high, float(camera.height)), 0.0)),
    )
