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
        ranges: whether depths are distances from the camera, else along z.
        rolls, by_row, forward: of the shutter; ``forward``: the first line comes first.
        slack, bend: see LensTables.
        cosine, sine: of the angle from the axis that no ray exceeds.
        turned: length of ``turn``.
        directory: see LensTables.
        shift, turn: [3] float64, of the camera over the read-out, see LensView.
    """

    width: float
    height: float
    near_plane: float
    far_plane: float
    eps2d: float
    radius_clip: float
    antialiased: bool
    ranges: bool
    rolls: bool
    by_row: bool
    forward: bool
    slack: float
    bend: float
    cosine: float
    sine: float
    turned: float
    directory: NDArray[np.float32]
    shift: NDArray[np.float64]
    turn: NDArray[np.float64]
