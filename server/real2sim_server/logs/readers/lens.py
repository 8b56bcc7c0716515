"""Lenses with distortion, and the pinhole images that logs promise instead."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...scene import BrownConrady, Camera, SceneError, Shutter
from ...scene.camera import Optics
from ...scene.shutter import GLOBAL

MAX_ZOOM = 4.0


@dataclass(frozen=True, eq=False)
class Lens:
    """A Brown-Conrady lens (Brown 1966, in OpenCV's notation).

    Attributes:
        width, height: image size [px].
        K: [3, 3] float64, intrinsics of the images as recorded, pixel centres at +0.5.
        distortion: k1, k2, p1, p2, k3; all zero for a pinhole.
    """

    width: int
    height: int
    K: Float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @cached_property
    def pinhole_K(self) -> Float:
        """``K`` [3, 3] of the undistorted images, which have the same size.

        It is the lens's own K, with focal lengths made just so much longer that every pixel lies
        inside the recorded image: no undistorted image has black corners.
        """
        if not any(self.distortion) or self._fits(1.0):
            return self.K.copy()
        low, high = 1.0, MAX_ZOOM
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (low, middle) if self._fits(middle) else (middle, high)
        return self._zoomed(high)

    def camera(self, name: str, T_vehicle_camera: Float, shutter: Shutter = GLOBAL) -> Camera:
        """The pinhole camera of the undistorted images, which knows the lens and the shutter that
        they had; not a lens that folds inside the image, through which nothing can be drawn.

        Raises:
            SceneError: values that make no camera.
        """
        pinhole = Camera(name, self.width, self.height, self.pinhole_K, T_vehicle_camera)
        k1, k2, p1, p2, k3 = self.distortion
        distorted = any(self.distortion)
        if not distorted and not shutter.rolls:
            return pinhole
        model = BrownConrady((k1, k2, k3, 0.0, 0.0, 0.0), (p1, p2)) if distorted else None
        try:
            return replace(pinhole, recorded=Optics(self.K, model, shutter))
        except SceneError:
            return pinhole

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The pinhole image of a recorded image, both RGB uint8 [height, width, 3]."""
        import cv2

        if not any(self.distortion):
            return image
        columns, rows = self._source
        return np.asarray(
            cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )

    def distort(self, pixels: Float) -> Float:
        """Recorded image positions [..., 2] of positions [..., 2] in the pinhole image [px]."""
        return self._recorded(pixels, self.pinhole_K)

    @cached_property
    def _source(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        recorded = self.distort(np.stack([column, row], axis=-1)) - 0.5
        return recorded[..., 0].astype(np.float32), recorded[..., 1].astype(np.float32)

    def _zoomed(self, zoom: float) -> Float:
        k = self.K.copy()
        k[0, 0] *= zoom
        k[1, 1] *= zoom
        return k

    def _fits(self, zoom: float) -> bool:
        column, row = np.arange(self.width + 1.0), np.arange(self.height + 1.0)
        border = np.concatenate(
            [np.stack([column, np.full_like(column, y)], 1) for y in (0, self.height)]
            + [np.stack([np.full_like(row, x), row], 1) for x in (0, self.width)]
        )
        found = self._recorded(border, self._zoomed(zoom))
        return bool((found >= 0).all() and (found <= [self.width, self.height]).all())

    def _recorded(self, pixels: Float, pinhole: Float) -> Float:
        k1, k2, p1, p2, k3 = self.distortion
        x = (pixels[..., 0] - pinhole[0, 2]) / pinhole[0, 0]
        y = (pixels[..., 1] - pinhole[1, 2]) / pinhole[1, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        u = (x * radial + dx) * self.K[0, 0] + self.K[0, 2]
        v = (y * radial + dy) * self.K[1, 1] + self.K[1, 2]
        return np.stack([u, v], axis=-1)
