"""Small images of all worlds of a batch, drawn in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..render import (
    Backend,
    RasterOptions,
    RenderError,
    View,
    WorldViews,
    rasterize_batch,
    rasterize_worlds,
)
from ..render.images import to_uint8
from ..scene import Camera
from ..world.batch import BatchWorld

RGB = RasterOptions(depth=False, instance=False, detail="auto")


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """A camera of another size that sees the middle of what ``camera`` sees: scaled until one side
    fits, and cut at the other, so that pixels stay square."""
    scale = max(width / camera.width, height / camera.height)
    K = camera.K.copy()
    K[:2] *= scale
    K[0, 2] -= (camera.width * scale - width) / 2
    K[1, 2] -= (camera.height * scale - height) / 2
    return replace(camera, width=width, height=height, K=K)


def batch_images(
    batch: BatchWorld,
    cameras: Sequence[Camera],
    worlds: Sequence[int],
    *,
    backend: str | Backend = "auto",
) -> NDArray[np.uint8]:
    """What cameras of one size see in some worlds, [len(worlds), C, H, W, 3] uint8.

    Args:
        batch: the worlds.
        cameras: C of them.
        worlds: which of the worlds.
        backend: draws.

    Raises:
        RenderError: for cameras that are no pinholes; batches draw none with lenses.
    """
    for camera in cameras:
        if not camera.is_pinhole:
            raise RenderError(
                f"camera {camera.name!r} has a lens or a rolling shutter; images of batches are "
                "those of pinholes"
            )
    width, height = cameras[0].width, cameras[0].height
    if not len(worlds):
        return np.zeros((0, len(cameras), height, width, 3), np.uint8)
    sky = batch.scene.sky
    shown = batch.shown(worlds)
    poses = np.stack([batch.body_pose(w) for w in worlds])
    viewmats = np.stack([camera.viewmat(poses) for camera in cameras], axis=1)
    if shown is None:
        views = [
            View(batch.instances(w), viewmat, camera.K)
            for w, each in zip(worlds, viewmats, strict=True)
            for viewmat, camera in zip(each, cameras, strict=True)
        ]
        drawn = rasterize_batch(views, width, height, sky=sky, options=RGB, backend=backend)
    else:
        Ks = np.stack([camera.K for camera in cameras])
        seen = WorldViews(shown.things, shown.poses, shown.there, shown.times_us, viewmats, Ks)
        drawn = rasterize_worlds(seen, width, height, sky=sky, options=RGB, backend=backend)
    return to_uint8(drawn.rgb).reshape(len(worlds), len(cameras), height, width, 3)
