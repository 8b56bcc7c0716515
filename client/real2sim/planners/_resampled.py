"""Images of a camera that a scene lacks, out of those that it has.

All cameras of a vehicle stand close together, so a ray of the wanted one is looked up where a
camera of the scene sees the same direction; how far apart they stand is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._poses import Matrix

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera on the vehicle.

    Attributes:
        K: [3, 3] intrinsics [px].
        size: width, height [px].
        R_vehicle_camera: [3, 3] rotation of its axes (x right, y down, z forward).
    """

    K: Matrix
    size: tuple[int, int]
    R_vehicle_camera: Matrix

    def rays(self) -> Matrix:
        """[H, W, 3] directions of its pixels' centres in the vehicle frame."""
        width, height = self.size
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        inverse = np.linalg.inv(self.K)
        directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ inverse.T
        rays: Matrix = directions @ self.R_vehicle_camera.T
        return rays

    def apart(self, other: PinholeView) -> float:
        """Angle between the axes of two cameras [rad]."""
        cosine = float(self.R_vehicle_camera[:, 2] @ other.R_vehicle_camera[:, 2])
        return math.acos(min(max(cosine, -1.0), 1.0))


@dataclass(frozen=True, eq=False)
class Lookup:
    """Where the pixels of a wanted view are seen.

    Attributes:
        size: of the view, width, height [px].
        parts: of each camera that sees some: its name, rows of the view's pixels [N], and for each
            four pixels around and their weights [N, 4].
        covered: fraction of the view that any camera sees.
    """

    size: tuple[int, int]
    parts: tuple[tuple[str, NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]], ...]
    covered: float

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that see any of it."""
        return tuple(name for name, *_ in self.parts)

    def image(self, images: Mapping[str, Pixels]) -> Pixels:
        """[H, W, 3] of the view, out of the images of the cameras; black where none sees it."""
        width, height = self.size
        found = np.zeros((height * width, 3), np.uint8)
        for name, rows, around, weights in self.parts:
            pixels = images[name].reshape(-1, 3)
            mixed = np.einsum("nk,nkc->nc", weights, pixels[around].astype(np.float32))
            found[rows] = np.rint(mixed).astype(np.uint8)
        return found.reshape(height, width, 3)


def lookup_of(wanted: PinholeView, cameras: Mapping[str, PinholeView]) -> Lookup:
    """Where the pixels of ``wanted`` are seen: by the camera that looks most nearly the same way,
    and what that does not see by the next one."""
    rays = wanted.rays().reshape(-1, 3)
    free = np.ones(len(rays), np.bool_)
    parts = []
    for name in _nearest_first(wanted, cameras):
        camera = cameras[name]
        rows = np.flatnonzero(free)
        local = rays[rows] @ camera.R_vehicle_camera
        ahead = local[:, 2] > 1e-6
        rows, local = rows[ahead], local[ahead]
        places = (local / local[:, 2:]) @ camera.K.T
        width, height = camera.size
        seen = (
            (places[:, 0] >= 0) & (places[:, 0] < width)
            & (places[:, 1] >= 0) & (places[:, 1] < height)
        )  # fmt: skip
        if not seen.any():
            continue
        rows = rows[seen]
        around, weights = _around(places[seen, :2], width, height)
        parts.append((name, rows, around, weights))
        free[rows] = False
    return Lookup(wanted.size, tuple(parts), float(1.0 - free.mean()))


def _nearest_first(wanted: PinholeView, cameras: Mapping[str, PinholeView]) -> Sequence[str]:
    return sorted(cameras, key=lambda name: (wanted.apart(cameras[name]), name))


def _around(
    places: Matrix, width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The four pixels around places [N, 2] of an image, and their weights (bilinear)."""
    place = places - 0.5
    low = np.floor(place)
    a, b = (place - low).T
    i, j = low.astype(np.int64).T
    columns = [np.clip(i, 0, width - 1), np.clip(i + 1, 0, width - 1)]
    lines = [np.clip(j, 0, height - 1), np.clip(j + 1, 0, height - 1)]
    around = np.stack([line * width + column for line in lines for column in columns], axis=1)
    weights = np.stack([(1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a], axis=1)
    return around, weights.astype(np.float32)
