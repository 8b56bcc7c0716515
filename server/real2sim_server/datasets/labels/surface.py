"""Which pixels of an object show its surface, and not the shadow that belongs to it.

A reconstructed object holds the dark ground below it too, which moves with it. Those pixels are the
ground's: where they are is told by the object's box, of road vehicles with wheels below it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from .boxes import ObjectBox
from .pixels import BODY, TYRE, on_bodies

MARGIN = 0.1
"""Surface may lie so far outside of the box [m]: boxes are as exact as who drew them."""

CLEARANCE = 0.12
"""What is less above the box's lowest face, below it too, is the ground [m]."""

SILL = 0.11
"""Below this share of a road vehicle's height are its wheels alone, and between them the shadow."""

WHEELED = {
    "car": (0.15, 0.22, 0.3, 0.3),
    "van": (0.11, 0.16, 0.33, 0.3),
    "truck": (0.15, 0.145, 0.36, 0.26),
    "bus": (0.12, 0.155, 0.29, 0.26),
    "trailer": (0.15, 0.145, 0.36, 0.26),
}
"""Of road vehicles: where their sides end below and the radius of their wheels as shares of the
height, how far the axles are ahead of the centre and behind it as shares of the length."""

AXLES = 0.18, 0.43
"""Wheels lie between these shares of the length, ahead of the centre and behind."""

CONTACT = 0.08
"""Of wheels, what is less above the box's lowest face is the ground [m]."""


def on_surface(
    points: NDArray[np.floating], T_world_object: Float, box: ObjectBox
) -> NDArray[np.bool_]:
    """Which points [N, 3] of the world are of an object's surface, [N] bool.

    Args:
        points: at its pixels.
        T_world_object: [4, 4] of the box, at the instant of the points.
        box: gives size and category.
    """
    found = np.empty(len(points), np.bool_)
    on_bodies(np.asarray(points, np.float64), body_of(box, T_world_object), found)
    return found


def bodies_of(boxes: Sequence[ObjectBox]) -> Float:
    """What kernels take of boxes, [K, BODY], see ``is_surface``."""
    found = np.empty((len(boxes), BODY))
    for row, box in zip(found, boxes, strict=True):
        row[:] = body_of(box, box.T_world_object)
    return found


def body_of(box: ObjectBox, T_world_object: Float) -> Float:
    """One of :func:`bodies_of`, at another pose."""
    half = np.asarray(box.size) / 2
    to_object = invert_transform(T_world_object)[:3]
    lowest = -half[2] + min(CLEARANCE, half[2] / 4)
    limits: tuple[float, ...] = lowest, lowest, *[0.0] * 7
    if box.category in WHEELED:
        aside, (inner, outer) = half[1] - TYRE, AXLES
        sill = max(lowest, (2 * SILL - 1) * half[2])
        long, _, high = box.size
        side, radius, front, rear = WHEELED[box.category]
        seen = side * high, radius * high, front * long, rear * long
        limits = -half[2] + CONTACT, sill, aside, inner * long, outer * long, *seen
    return np.concatenate([to_object.ravel(), half, [MARGIN, *limits]])
