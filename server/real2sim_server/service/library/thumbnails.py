"""Pictures of assets for the library."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...edit.shadow import contact_shadow
from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from ...render import Backend, Instance, RasterOptions, rasterize
from ...scene import Asset, GaussianCloud, Ground, Trajectory

BACKDROP = (0.90, 0.91, 0.93)
FOCAL = 1.6
"""Of the width of the picture: a mild telephoto lens, which bends cars little."""

VIEW_FROM = (1.0, 0.75, 0.45)
"""Front left, from above."""


def draw_thumbnail(asset: Asset, *, width: int, backend: Backend) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of an asset on a light floor, seen from its front left; H = 3/4 W."""
    height = width * 3 // 4
    radius = float(np.linalg.norm(asset.size)) / 2
    K = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]])
    distance = radius / np.sin(np.arctan(0.5 * height / (FOCAL * width)))
    eye = np.array(VIEW_FROM) / np.linalg.norm(VIEW_FROM) * distance
    floor = Ground.level(-asset.size[2] / 2)
    shadow = contact_shadow(np.eye(4), asset.size, floor, device=asset.cloud.device)
    output = rasterize(
        [Instance(_standing(asset)), *([shadow] if shadow else [])],
        invert_transform(_looking_at_origin(eye))[None],
        K[None],
        width,
        height,
        options=RasterOptions(background=BACKDROP, depth=False, instance=False),
        backend=backend,
    )
    rgb = output.rgb[0].clamp(0.0, 1.0).mul(255.0).round()
    pixels: NDArray[np.uint8] = rgb.to("cpu").numpy().astype(np.uint8)
    return pixels


def _standing(asset: Asset) -> GaussianCloud:
    if asset.figure is None:
        return asset.cloud
    place = np.array([[0.0, 0.0, asset.figure.middle]])
    here = Trajectory(np.zeros(1, np.int64), place, np.array([[1.0, 0.0, 0.0, 0.0]]))
    return asset.figure.posed(asset.cloud, here, 0)


def _looking_at_origin(eye: Float) -> Float:
    """``T_world_camera`` [4, 4] at ``eye`` [3], x right, y down, z towards the origin."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose
