"""Rendered depth against the LiDAR."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...scene import Camera

NEAR, FAR = 0.5, 80.0
"""Points at other depths are not compared [m]."""
HIDDEN_BEHIND = 0.3
"""What lies so much nearer hides a point, unless the road alone recedes as quickly [m]."""
REACH = 0.006
"""Radius on the image within which an occluder is searched [rad]; about two beams apart."""
ROAD_BELOW = 1.2
"""The road is at least so far below the cameras [m]."""


def seen_points(
    points: Float, camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rows [M], columns [M] and depths [M] [m] of the points that the camera can see.

    The LiDAR stands elsewhere than the camera and looks over things that hide what is behind
    them. A point counts as hidden when any point within REACH of it on the image is nearer by
    more than HIDDEN_BEHIND plus what a road ROAD_BELOW the camera recedes over that distance,
    z^2 angle / height, so that far stretches of road are compared too.

    Args:
        points: [N, 3] in the camera frame [m].
        camera: gives size and K.
    """
    import cv2

    points = points[(points[:, 2] > NEAR) & (points[:, 2] < FAR)]
    depth = points[:, 2]
    column = np.floor(camera.K[0, 0] * points[:, 0] / depth + camera.K[0, 2]).astype(np.int64)
    row = np.floor(camera.K[1, 1] * points[:, 1] / depth + camera.K[1, 2]).astype(np.int64)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column, depth = row[inside], column[inside], depth[inside]
    nearest = np.full((camera.height, camera.width), FAR, dtype=np.float64)
    np.minimum.at(nearest, (row, column), depth)
    focal = camera.K[0, 0]
    reach = max(1, round(REACH * focal))
    # The default border is the largest finite number, which hides nothing.
    nearest = np.asarray(cv2.erode(nearest, np.ones((2 * reach + 1,) * 2, np.uint8)))
    # One pixel more, as points are rounded to pixels.
    recedes = depth**2 * (reach + 1) / (focal * ROAD_BELOW)
    seen = depth - nearest[row, column] <= HIDDEN_BEHIND + recedes
    return row[seen], column[seen], depth[seen]


def depth_errors(depth: NDArray[np.float32], points: Float, camera: Camera) -> NDArray[np.float64]:
    """Absolute errors [M] [m] of a rendered depth image at the points the camera can see.

    Infinite where nothing was rendered, so that holes count and a median stays honest.

    Args:
        depth: [H, W] along the camera's z [m], 0 where nothing is.
        points: [N, 3] in the camera frame [m].
        camera: of the image.
    """
    row, column, expected = seen_points(points, camera)
    rendered = depth[row, column].astype(np.float64)
    return np.where(rendered > 0, np.abs(rendered - expected), np.inf)


def median_error(errors: NDArray[np.float64]) -> float:
    """Median [m]; nan for no points, infinite where most are holes."""
    # The mean of a finite and an infinite middle value is infinite, as it should be.
    return float(np.median(errors)) if len(errors) else float("nan")


def mean_error(errors: NDArray[np.float64]) -> float:
    """Mean over the points that are no holes [m]; nan where there are none.

    What a median hides shows here: surfaces that are haze have long tails.
    """
    finite = errors[np.isfinite(errors)]
    return float(finite.mean()) if len(finite) else float("nan")


def error_p90(errors: NDArray[np.float64]) -> float:
    """90th percentile [m]: the smallest error that nine of ten do not exceed.

    Nan for no points, infinite where more than a tenth are holes.
    """
    if len(errors) == 0:
        return float("nan")
    # Between a finite and an infinite value there is nothing to interpolate.
    return float(np.percentile(errors, 90, method="inverted_cdf"))
