"""The sky, and whatever is out of the LiDAR's reach, as a cube map around the drive."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...scene import Sky
from ...scene.scene import face_directions
from .views import DEPTH_DOWNSCALE, ProjectedView

Coordinates = NDArray[np.floating[Any]]

SLOTS = 15
"""Samples of which the median is taken for a direction."""
PANORAMA = (256, 512)
ZENITH = np.array([0.75, 0.82, 0.9])
"""Colour of a sky that no camera observed."""
FADE = 1 / 24
"""Fraction of a full turn over which the weight of an observed colour falls to 1/e."""
GROUND_ELEVATION = -0.03
"""Below this elevation [rad] directions are given the colour of the ground."""


class SkySamples:
    """Collects, for each direction, pixels of the sky, or else those that no Gaussian covers."""

    def __init__(self, resolution: int) -> None:
        self._resolution = resolution
        self._directions = face_directions(resolution).reshape(-1, 3)
        n = len(self._directions)
        self._slots: list[NDArray[np.uint8]] = []
        self._counts = np.zeros(n, dtype=np.uint8)
        self._is_sky = np.zeros(n, dtype=np.bool_)

    def add(self, view: ProjectedView, sky: NDArray[np.bool_]) -> None:
        """Take pixels of the sky, and those that show neither a Gaussian nor a tracked object.

        Args:
            sky: [H, W] bool, pixels of ``view`` that show the sky. A direction in which any view
                shows it keeps pixels of the sky alone.
        """
        texels, u, v = self._texels_in(view)
        row, column = (v / DEPTH_DOWNSCALE).astype(np.int64), (u / DEPTH_DOWNSCALE).astype(np.int64)
        shows_sky = sky[v.astype(np.int64), u.astype(np.int64)]
        found = texels[shows_sky & ~self._is_sky[texels]]
        self._is_sky[found] = True
        self._counts[found] = 0
        for values in self._slots:
            values[found] = 255
        free = np.where(self._is_sky[texels], shows_sky, uncovered_pixels(view)[row, column])
        free &= self._counts[texels] < SLOTS
        texels, u, v = texels[free], u[free], v[free]
        colours = _bilinear(view.image, u, v)
        slot = self._counts[texels]
        while len(self._slots) <= int(slot.max(initial=0)):
            self._slots.append(np.full((len(self._directions), 3), 255, dtype=np.uint8))
        for s in range(int(slot.max(initial=0)) + 1):
            mine = slot == s
            self._slots[s][texels[mine]] = colours[mine]
        self._counts[texels] += 1

    def _texels_in(self, view: ProjectedView) -> tuple[NDArray[np.int64], Coordinates, Coordinates]:
        """Texels inside the image and their pixel coordinates u, v."""
        camera = view.camera
        rotation = view.T_camera_world[:3, :3].astype(np.float32)
        ahead = np.flatnonzero(self._directions @ rotation[2] > 0.05)
        x, y, z = (self._directions[ahead] @ rotation.T).T
        u = camera.K[0, 0] * x / z + camera.K[0, 2]
        v = camera.K[1, 1] * y / z + camera.K[1, 2]
        inside = (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
        return ahead[inside], u[inside], v[inside]

    def finish(self, ground_colour: NDArray[np.float32]) -> Sky:
        """The cube map: medians where anything was seen, smoothly filled elsewhere."""
        known = self._counts > 0
        texels = np.zeros((len(self._directions), 3), dtype=np.float32)
        texels[known] = self._median(known)
        fill = _panorama(self._directions, texels, known, ground_colour)
        texels[~known] = _look_up(fill, self._directions[~known])
        r = self._resolution
        return Sky(torch.from_numpy(texels.reshape(6, r, r, 3).clip(0, 1)))

    def _median(self, known: NDArray[np.bool_]) -> NDArray[np.float32]:
        stack = np.stack([slot[known] for slot in self._slots])
        # Unused slots hold 255 and so stay behind the used ones.
        stack.sort(axis=0)
        middle = (self._counts[known].astype(np.int64) - 1) // 2
        chosen = np.take_along_axis(stack, middle[None, :, None], axis=0)[0]
        return np.asarray(chosen.astype(np.float32) / 255)


def uncovered_pixels(view: ProjectedView) -> NDArray[np.bool_]:
    """[H / 2, W / 2] bool: no Gaussian and no object there; pinholes closed."""
    import cv2

    covered = (np.isfinite(view.depth) | view.on_object).astype(np.uint8)
    closed = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(closed == 0)


def _bilinear(image: NDArray[np.uint8], u: Coordinates, v: Coordinates) -> NDArray[np.uint8]:
    if len(u) == 0:
        return np.zeros((0, 3), dtype=np.uint8)
    return np.asarray(_remap(image, u - 0.5, v - 0.5), dtype=np.uint8)


def _remap(image: NDArray[Any], columns: Coordinates, rows: Coordinates) -> NDArray[Any]:
    """Bilinear values [N, 3] of an image [H, W, 3] at ``columns`` and ``rows`` [N]."""
    import cv2

    # OpenCV bounds the width of a map, so that a long list of places takes several rows.
    side = 1 << 14
    shape = -(-len(columns) // side), side
    maps = [np.zeros(shape, dtype=np.float32) for _ in range(2)]
    for given, values in zip(maps, (columns, rows), strict=True):
        given.reshape(-1)[: len(values)] = values
    flat = np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR))
    return flat.reshape(-1, 3)[: len(columns)]


def _panorama(
    directions: NDArray[np.float32],
    texels: NDArray[np.float32],
    known: NDArray[np.bool_],
    ground_colour: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Elevation x azimuth image [H, W, 3] that extends the known texels all around."""
    height, width = PANORAMA
    row, column = _panorama_place(directions[known])
    flat = row.astype(np.int64) * width + column.astype(np.int64)
    counts = np.bincount(flat, minlength=height * width).reshape(height, width)
    sums = np.stack([np.bincount(flat, texels[known, c], height * width) for c in range(3)], -1)
    values = sums.reshape(height, width, 3) / np.maximum(counts, 1)[..., None]
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    seen = np.flatnonzero((counts > 0).any(axis=1) & (elevation > 0))
    panorama = np.empty((height, width, 3))
    for r in range(height):
        if elevation[r] < GROUND_ELEVATION or len(seen) == 0:
            panorama[r] = ground_colour if elevation[r] < 0 else ZENITH
        else:
            # Directions never observed take the colours observed at the same elevation.
            nearest = int(seen[np.abs(seen - r).argmin()])
            panorama[r] = _around(values[nearest], counts[nearest] > 0)
    return _softened(panorama)


def _around(row: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """A closed ring of colours [W, 3]: from the nearest known ones, fading to their mean."""
    width = len(row)
    place = np.flatnonzero(known)
    gap = np.abs(np.arange(width)[:, None] - place)
    gap = np.minimum(gap, width - gap)
    trust = np.exp(-gap.min(axis=1) / (FADE * width))[:, None]
    nearest = row[place[gap.argmin(axis=1)]]
    return np.asarray(trust * nearest + (1 - trust) * row[place].mean(axis=0))


def _softened(panorama: NDArray[np.float64]) -> NDArray[np.float32]:
    import cv2

    width = panorama.shape[1]
    # Three turns side by side, so that there is no seam at the back.
    blurred = cv2.GaussianBlur(np.tile(panorama, (1, 3, 1)).astype(np.float32), (0, 0), 2)
    return np.asarray(blurred, dtype=np.float32)[:, width : 2 * width]


def _panorama_place(directions: NDArray[np.float32]) -> tuple[Coordinates, Coordinates]:
    height, width = PANORAMA
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    row = np.clip((np.pi / 2 - elevation) / np.pi * height, 0, height - 1e-3)
    return row, np.clip((azimuth + np.pi) / (2 * np.pi) * width, 0, width - 1e-3)


def _look_up(panorama: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.float32]:
    row, column = _panorama_place(directions)
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    values = _remap(wrapped, column + 0.5, np.maximum(row - 0.5, 0))
    return np.asarray(values, dtype=np.float32)
