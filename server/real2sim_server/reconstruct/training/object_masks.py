"""Where objects are on images: projected boxes."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from ...scene import Camera, Scene

NEAR = 0.2
"""Boxes that reach behind this depth are cut there [m]."""
EDGE_SAMPLES = 9
"""Points along each edge of a box, so that cut boxes keep their outline."""


def box_mask(
    scene: Scene, camera: Camera, t_us: int, *, only: Collection[str] | None = None
) -> NDArray[np.bool_]:
    """[H, W] bool, pixels within the outline of a box at ``t_us``.

    Args:
        only: ids of the objects that count; all by default.
    """
    import cv2

    mask = np.zeros((camera.height, camera.width), np.uint8)
    viewmat = camera.viewmat(scene.ego.transform(t_us))
    for name, item in scene.objects.items():
        if (only is not None and name not in only) or not item.trajectory.covers(t_us):
            continue
        edges = _along_edges(item.box_at(t_us))
        points = edges @ viewmat[:3, :3].T + viewmat[:3, 3]
        points = points[points[:, 2] > NEAR]
        if len(points) < 3:
            continue
        pixels = points @ camera.K.T
        outline = np.clip(pixels[:, :2] / pixels[:, 2:], -1e4, 1e4).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(outline), 1)
    return np.asarray(mask > 0)


def _along_edges(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points on the lines between all pairs of the 8 corners; their hull is that of the box."""
    fraction = np.linspace(0, 1, EDGE_SAMPLES)[:, None, None, None]
    return np.asarray((corners[:, None] * fraction + corners[None] * (1 - fraction)).reshape(-1, 3))
