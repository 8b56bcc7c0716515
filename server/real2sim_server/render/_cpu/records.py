"""Data exchanged between the CPU kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CHUNK = 2048
"""Gaussians per projection task; also the size of a chunk's region of records."""
TILE = 16
"""Edge length of a tile [px]."""
RECORD = 16
"""float32 values of a record: one cache line per potentially visible Gaussian."""

MEAN_X, MEAN_Y = 0, 1
"""Centre on the image [px]."""
SHARPNESS, SLOPE, FALLOFF = 2, 3, 4
"""exponent = (SHARPNESS (x - MEAN_X - SLOPE dy))^2 + FALLOFF dy^2 + LEVEL with dy = y - MEAN_Y.

This is the Cholesky form of the conic. A sum of squares stays precise for needles, where
a dx^2 + 2 b dx dy + c dy^2 cancels.
"""
LEVEL = 5
"""-ln(opacity) in EXPONENT_UNIT."""
RED, GREEN, BLUE, DEPTH, INSTANCE = 6, 7, 8, 9, 10
"""Colour, depth of the centre [m], instance id as a float32."""
EXTENT_Y, TIP_Y = 11, 12
"""Ellipse alpha >= 1/255: largest dy, and dy of its rightmost point [px]."""

EXTENT_X = 13
"""Largest dx of the same ellipse [px]."""
MEMBER = 14
"""Index of the Gaussian within its chunk, 0 to CHUNK - 1, as a float32."""

EXPONENT_UNIT = 16.0
"""Divisor of stored exponents: exp(-s) = polynomial(s / 16)^16."""
EXPONENT_LIMIT = math.log(255.0) / EXPONENT_UNIT
"""Exponent above which alpha is below 1/255."""


class Cluster(NamedTuple):
    """Arrays of one cloud, all contiguous; ``covars`` is [0, 3, 3] if absent.

    ``coefficients`` [N, F, 3] times ``tones`` [F] is added to ``sh[:, 0]``; F is 0 for colours that
    are constant over time.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh: NDArray[np.float32]
    covars: NDArray[np.float32]
    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]
    instance_id: np.float32
    coefficients: NDArray[np.float32]
    tones: NDArray[np.float32]


class CameraParameters(NamedTuple):
    """Camera and options as float32 numbers.

    Attributes:
        fx, fy, cx, cy, width, height: pinhole intrinsics and image size [px].
        left, right, top, bottom: bounds of x/z and y/z in the Jacobian of the projection.
        near_plane, far_plane, eps2d, radius_clip, antialiased: see RasterOptions.
        blur: square root of ``eps2d`` [px].
    """

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    width: np.float32
    height: np.float32
    left: np.float32
    right: np.float32
    top: np.float32
    bottom: np.float32
    near_plane: np.float32
    far_plane: np.float32
    eps2d: np.float32
    radius_clip: np.float32
    antialiased: np.float32
    blur: np.float32


class Records(NamedTuple):
    """Gaussians on the image plane. Each chunk of CHUNK fills its region from the start.

    Attributes:
        values: [M, RECORD] float32.
        footprints: [M] int64, see :mod:`.project`. Separate, so that they fit a cache.
        depths: [M] float32, depth of the centres [m].
        counts: [M / CHUNK] int64, used records of each region.
    """

    values: NDArray[np.float32]
    footprints: NDArray[np.int64]
    depths: NDArray[np.float32]
    counts: NDArray[np.int64]


class Images(NamedTuple):
    """Images of one camera; ``depth``, ``instance`` and ``median`` are [0, 0] if not requested.

    Attributes:
        rgb: [H, W, 3] float32.
        alpha: [H, W] float32.
        depth: [H, W] float32 [m].
        instance: [H, W] uint16.
        median: [H, W] float32, depth of the Gaussian at which transmittance falls to 0.5 [m].
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    median: NDArray[np.float32]


# Cameras with lenses

RAY_RECORD = 2 * RECORD
"""float32 values of a record: two cache lines. The first is that of a pinhole; its ellipse bounds
the pixels that the Gaussian may touch. Rays decide which ones it does touch."""
FRAME = RECORD
"""First of nine, for rays from one point: rows of the map of directions to a space where the
Gaussian is a unit sphere with its centre on the third axis."""
SQUARE = RECORD + 9
"""Squared distance of the centre in that space, over twice EXPONENT_UNIT."""

WHITENING = RECORD
"""First of six, for rays from many points: map of the Gaussian to a unit sphere, lower triangle by
rows."""
ORIGIN = RECORD + 6
"""First of three: camera position relative to the centre, in that space, at mid-readout."""
DRIFT = RECORD + 9
"""First of three: displacement of the camera in that space over the readout."""


class RayParameters(NamedTuple):
    """Camera and options for the lens kernels.

    Attributes:
        width, height: image size [px].
        near_plane, far_plane, eps2d, radius_clip, antialiased: see RasterOptions.
        ranges: 1 if depth is the distance from the camera, 0 if it is along z.
        rolls: whether the camera has a rolling shutter.
        bend, slack: see LensTables.
        edge: extent of small Gaussians on the image beyond their size [px].
        cosine, sine: cosine and sine of the largest angle between a ray and the axis.
        turned: length of ``turn`` [rad].
        directory: see LensTables.
        line: [3] float32; the dot product with (x, y, 1), clipped to -0.5 to 0.5, is the exposure
            time of an image position.
        shift, turn: [3] float64, camera motion over the readout, see LensView.
        drift: [2, 3] float64, cluster motion over the readout: displacement of its origin [m] and
            rotation vector [rad], in the camera frame.
    """

    width: np.float32
    height: np.float32
    near_plane: np.float32
    far_plane: np.float32
    eps2d: np.float32
    radius_clip: np.float32
    antialiased: np.float32
    ranges: np.float32
    rolls: bool
    bend: np.float32
    slack: np.float32
    edge: np.float32
    cosine: np.float32
    sine: np.float32
    turned: np.float32
    directory: NDArray[np.float32]
    line: NDArray[np.float32]
    shift: NDArray[np.float64]
    turn: NDArray[np.float64]
    drift: NDArray[np.float64]
