"""What the kernels of cameras with lenses hand to each other, besides what all hand on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .records import RECORD

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
