"""What the kernels of cast() hand to each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RECORD = 16
"""float32 values of a record: one cache line for each Gaussian that a ray may meet."""
WHITENING = 0
"""Six planes: the lower triangle W, by rows, with exponent = |W (x - mean)|^2 + LEVEL."""
MEAN = 6
"""Three: the centre in the frame of the sweep [m]."""
LEVEL = 9
"""-ln(opacity) in EXPONENT_UNIT."""
LOW, HIGH = 10, 11
"""Elevations between which the Gaussian is met [rad]."""
BODY = 12
"""Which instance, as a float."""
MEMBER = 13
"""Which Gaussian of it, as a float; exact up to 16 million."""
REFLECTIVITY, LOSS = 14, 15
"""Attributes for the LiDAR."""

SHAPE = RECORD
"""Seven: quaternion and scales, or the upper half of a covariance by rows."""
OPACITY = RECORD + 7
FRAME = RECORD + 8
"""Twelve: from the frame of the sweep to the sensor's at the instant that it looks there, by rows
of three turns and a shift."""
RANGE = RECORD + 20
"""Distance of the centre from the sensor at that instant [m]."""
LEFT, RIGHT = RECORD + 21, RECORD + 22
"""Azimuths between which the Gaussian is met, LEFT < RIGHT [rad]."""
GAIN = RECORD + 23
"""How fast it moves as the sensor sees it, at most [rad/s]."""
PREPARATION = RECORD + 24


class Body(NamedTuple):
    """Arrays of one instance, all contiguous.

    Attributes:
        means, quats, scales, opacities: of the cloud.
        covars: [N, 3, 3], or [0, 3, 3] where not given.
        attributes: [N, 2] float32, or [0, 2].
        linear, offset: [3, 3] and [3] float64, from the cloud's frame to that of the sweep.
        frames: [S, 12] float32, from there to the sensor's at each instant.
        speed, turn: of the sensor against this body, at most [m/s], [rad/s].
        number: of the instance in the request.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    covars: NDArray[np.float32]
    attributes: NDArray[np.float32]
    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    frames: NDArray[np.float32]
    speed: np.float32
    turn: np.float32
    number: np.float32


class Sensor(NamedTuple):
    """A LiDAR as float32 numbers.

    Attributes:
        near, far: bounds of returns [m].
        wide, high: standard deviations of a beam at a distance of one metre [m].
        spread: how far the instants of rays are from that at which a place is looked at [s].
        period: time in which the sensor turns by one radian [s]; 0 where it does not turn.
        duration: of a sweep [s].
    """

    near: np.float32
    far: np.float32
    wide: np.float32
    high: np.float32
    spread: np.float32
    period: np.float32
    duration: np.float32


class Lights(NamedTuple):
    """What the blending writes, by ray; [0] where not asked for.

    Attributes:
        values: [R, 6] float32: median range, sum of w tau, sum of w, of w reflectivity, of w loss,
            and the return modes after them.
        owners: [R, 2] int32: body and member at the median, -1 where there is none.
        returns: [R, 9] float32: range, power and reflectivity of first, strongest and last.
    """

    values: NDArray[np.float32]
    owners: NDArray[np.int32]
    returns: NDArray[np.float32]
