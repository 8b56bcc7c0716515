"""Points with labels: counted in boxes, and those that the cameras' depth gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform
from ...render.lens import back_projected
from .boxes import ObjectBox
from .images import CameraImages

ROOF = (0.9, 0.0, 1.73)
"""Where a LiDAR stands that is not placed itself, in the ego frame [m]."""
BEAMS, COLUMNS = 64, 1024
ELEVATION = (np.radians(-25.0), np.radians(3.0))
NEAR, FARTHEST = 1.0, 80.0
"""Between these distances seen from above there are points [m]."""
NEAREST = 0.25
"""A pixel is on a beam where it is off by less than this share of the gap between two."""


def points_in_boxes(points: ArrayLike, transforms: ArrayLike, sizes: ArrayLike) -> list[int]:
    """How many points are in each box, faces included, the box not enlarged.

    Args:
        points: [N, 3] in some frame [m].
        transforms: [K, 4, 4] poses of the boxes in that frame, origin at the centre.
        sizes: [K, 3] (length, width, height) [m].
    """
    sought = PointsByX(np.asarray(points, dtype=np.float64))
    counts = []
    for transform, size in zip(np.asarray(transforms), np.asarray(sizes), strict=True):
        near = sought.points[sought.near(transform[0, 3], float(np.linalg.norm(size)) / 2 + 1e-6)]
        local = apply_transform(invert_transform(transform), near)
        counts.append(int((np.abs(local) <= size / 2).all(axis=1).sum()))
    return counts


class PointsByX:
    """Points in the order of their x, so that who asks for a place need not look at all of them."""

    def __init__(self, points: Float) -> None:
        """Sort [N, 3] points."""
        self.points = points
        self._order = np.argsort(points[:, 0])
        self._x = points[self._order, 0]

    def near(self, x: float, reach: float) -> NDArray[np.int64]:
        """Rows of the points whose x is within ``reach`` of ``x``."""
        first = np.searchsorted(self._x, x - reach, side="left")
        last = np.searchsorted(self._x, x + reach, side="right")
        return self._order[first:last]


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of surfaces, as cameras or a LiDAR see them.

    Attributes:
        points: [N, 3] float32, ego frame [m].
        intensity: [N] float32, brightness of the pixel or reflectivity, 0 to 1.
        beam: [N] uint8, row of the sensor, 0 is the lowest; 0 of sensors without rows.
        instance: [N] uint16, 0 is background.
        semantic: [N] uint8, see SEMANTIC_CLASSES.
        velocity: [N, 3] float32, of the surface along the ego's axes [m/s].
        time_us: [N] int32, when each was measured, relative to the frame.
        return_number: [N] uint8, of several returns of a ray the nearest is 1.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    beam: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    semantic: NDArray[np.uint8]
    velocity: NDArray[np.float32]
    time_us: NDArray[np.int32]
    return_number: NDArray[np.uint8]


def seen_points(
    images: Sequence[CameraImages], boxes: Sequence[ObjectBox], T_world_ego: Float
) -> SeenPoints:
    """Points of the depth images along the beams of a spinning LiDAR on the roof.

    The nearest pixel of each beam counts, so that they are spread as those of a LiDAR are; what
    only a LiDAR would see, behind the cameras and beside them, is not there.
    """
    to_ego = invert_transform(T_world_ego)
    parts = [_beams_of(image, to_ego) for image in images]
    points = np.concatenate([p[0] for p in parts])
    intensity, beam, column, instance, semantic = (
        np.concatenate([p[k] for p in parts]) for k in range(1, 6)
    )
    _, first = np.unique(beam * COLUMNS + column, return_index=True)
    kept = instance[first]
    return SeenPoints(
        points=points[first].astype(np.float32),
        intensity=intensity[first].astype(np.float32),
        beam=beam[first].astype(np.uint8),
        instance=kept,
        semantic=semantic[first],
        velocity=_velocities(points[first], kept, boxes, to_ego),
        time_us=np.zeros(len(first), np.int32),
        return_number=np.ones(len(first), np.uint8),
    )


def _beams_of(image: CameraImages, to_ego: Float) -> tuple[NDArray[np.generic], ...]:
    """Points, brightness, beam, column, instance and class of one pixel for each beam."""
    points = back_projected(image.depth, image.camera.K, to_ego @ image.T_world_camera)
    x, y, z = (points[..., k] - np.float32(ROOF[k]) for k in range(3))
    flat = np.sqrt(x * x + y * y)
    elevation = np.arctan(z / np.maximum(flat, NEAR))
    row = (elevation - ELEVATION[0]) * np.float32((BEAMS - 1) / (ELEVATION[1] - ELEVATION[0]))
    beam = np.rint(row)
    off = np.abs(row - beam)
    inside = (image.depth > 0) & (beam >= 0) & (beam < BEAMS) & (off < NEAREST)
    inside &= (flat > NEAR) & (flat < FARTHEST)
    chosen = np.flatnonzero(inside)
    azimuth = np.arctan2(y.ravel()[chosen], x.ravel()[chosen])
    turn = (azimuth * np.float32(COLUMNS / (2 * np.pi)) + COLUMNS // 2).astype(np.int64) % COLUMNS
    place = beam.ravel()[chosen].astype(np.int64) * COLUMNS + turn
    # Of several pixels on a beam the last one written counts: the nearest to it.
    farthest_first = np.argsort((off.ravel()[chosen] * -60_000).astype(np.int16), kind="stable")
    nearest = np.full(BEAMS * COLUMNS, -1)
    nearest[place[farthest_first]] = chosen[farthest_first]
    places = np.flatnonzero(nearest >= 0)
    chosen = nearest[places]
    return (
        points.reshape(-1, 3)[chosen],
        image.rgb.reshape(-1, 3)[chosen].mean(axis=1) / 255,
        places // COLUMNS,
        places % COLUMNS,
        image.instance.ravel()[chosen],
        image.semantic.ravel()[chosen],
    )


def _velocities(
    points: Float, instance: NDArray[np.uint16], boxes: Sequence[ObjectBox], to_ego: Float
) -> NDArray[np.float32]:
    found = np.zeros((len(points), 3), np.float32)
    for box in boxes:
        found[instance == box.instance_id] = to_ego[:3, :3] @ box.velocity
    return found
