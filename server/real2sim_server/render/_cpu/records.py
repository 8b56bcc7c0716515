"""Data exchanged between the CPU kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CHUNK = 2048
"""Gaussians that one task projects; also the size of a chunk's region of records."""
TILE = 16
"""Edge length of a tile [px]."""
RECORD = 16
"""float32 values of a record: one cache line for each Gaussian that may be seen."""

MEAN_X, MEAN_Y = 0, 1
"""Centre on the image [px]."""
SHARPNESS, SLOPE, FALLOFF = 2, 3, 4
"""exponent = (SHARPNESS (x - MEAN_X - SLOPE dy))^2 + FALLOFF dy^2 + LEVEL with dy = y - MEAN_Y.

The Cholesky form of the conic: a sum of squares keeps its precision for needles, where
a dx^2 + 2 b dx dy + c dy^2 loses all digits.
"""
LEVEL = 5
"""-ln(opacity) in EXPONENT_UNIT."""
RED, GREEN, BLUE, DEPTH, INSTANCE = 6, 7, 8, 9, 10
"""Colour, depth of the centre [m], instance id as a float."""
EXTENT_Y, TIP_Y = 11, 12
"""Of the ellipse alpha >= 1/255: largest dy, and dy of its rightmost point [px]."""

EXTENT_X = 13
"""Of the same ellipse: largest dx [px]."""
MEMBER = 14
"""Which Gaussian of its chunk a record is, as a float: 0 to CHUNK - 1."""

EXPONENT_UNIT = 16.0
"""Exponents are stored over this: exp(-s) = polynomial(s / 16)^16."""
EXPONENT_LIMIT = math.log(255.0) / EXPONENT_UNIT
"""Beyond this alpha is below 1/255."""


class Cluster(NamedTuple):
    """Arrays of one cloud, all contiguous; ``covars`` is [0, 3, 3] where not given.

    ``coefficients`` [N, F, 3] times ``tones`` [F] are added to ``sh[:, 0]``; F is 0 where colours
    do not change over time.
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
        fx, fy, cx, cy, width, height: of the camera [px].
        left, right, top, bottom: bounds of x/z and y/z in the projection's Jacobian.
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
        footprints: [M] int64, see :mod:`.project`; they fit a cache where the records do not.
        depths: [M] float32, depth of the centres [m].
        counts: [M / CHUNK] int64, records in use of each region.
    """

    values: NDArray[np.float32]
    footprints: NDArray[np.int64]
    depths: NDArray[np.float32]
    counts: NDArray[np.int64]


class Images(NamedTuple):
    """Pictures of one camera; ``depth`` and those after it are [0, 0] where not asked for.

    Attributes:
        rgb: [H, W, 3] float32.
        alpha: [H, W] float32.
        depth: [H, W] float32 [m].
        instance: [H, W] uint16.
        median: [H, W] float32, depth of the Gaussian that takes half of the light [m].
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    median: NDArray[np.float32]


# Cameras with lenses

RAY_RECORD = 2 * RECORD
"""float32 values of a record: two cache lines. The first is that of a pinhole, whose ellipse holds
what the Gaussian may touch; what it does touch is decided by rays."""
FRAME = RECORD
"""First of nine, for rays from one place: the rows of a map of directions to a space where the
Gaussian is a unit sphere and its centre lies on the third axis."""
SQUARE = RECORD + 9
"""Of the distance to the centre there, over twice EXPONENT_UNIT."""

WHITENING = RECORD
"""First of six, for rays from many places: the lower triangle, by rows, of the map that makes the
Gaussian a unit sphere."""
ORIGIN = RECORD + 6
"""First of three: the camera seen from the centre, in that space, in the middle of the read-out."""
DRIFT = RECORD + 9
"""First of three: how far it goes there over the read-out."""


class RayParameters(NamedTuple):
    """Camera and options for the kernels of lenses.

    Attributes:
        width, height: of the image [px].
        near_plane, far_plane, eps2d, radius_clip, antialiased: see RasterOptions.
        ranges: 1 where depths are distances from the camera, 0 where they are along z.
        rolls: whether lines are taken one after the other.
        bend, slack: see LensTables.
        edge: how far small things reach on the image beyond their size [px].
        cosine, sine: of the angle from the axis that no ray exceeds.
        turned: length of ``turn``.
        directory: see LensTables.
        line: [3] float32; x, y, 1 times these, within -0.5 to 0.5, is the time of a position.
        shift, turn: [3] float64, of the camera over the read-out, see LensView.
        drift: [2, 3] float64, of the cluster over the read-out: way of its origin [m] and rotation
            vector [rad], in the camera's frame.
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
