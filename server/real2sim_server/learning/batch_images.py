"""Small images of all worlds of a batch, drawn in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..render import Backend, RasterOptions, View, rasterize_batch
from ..render.quantize import to_uint8
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
    """
    width, height = cameras[0].width, cameras[0].height
    views = []
    for w in worlds:
        instances = batch.instances(w)
        views += [View(instances, camera.viewmat(batch.poses[w]), camera.K) for camera in cameras]
    if not views:
        return np.zeros((0, len(cameras), height, width, 3), np.uint8)
    drawn = rasterize_batch(views, width, height, sky=batch.scene.sky, options=RGB, backend=backend)
    return to_uint8(drawn.rgb).reshape(len(worlds), len(cameras), height, width, 3)
