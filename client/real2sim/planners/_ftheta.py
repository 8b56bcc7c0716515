"""A pinhole camera, said in the f-theta model of AlpaSim's own cameras.

Drivers that rectify images count in f-theta alone. A pinhole maps an angle t off the axis to the
radius f tan(t); both directions of that are fitted by polynomials over the angles of the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .._poses import Matrix

ODD_TERMS = 10
"""Of the polynomials; their worst error is below a fiftieth of a pixel for 120 degrees."""
SAMPLES = 2000


@dataclass(frozen=True)
class Ftheta:
    """An f-theta camera.

    Attributes:
        angle_to_pixels: coefficients from power 0 on; [rad] to [px].
        pixels_to_angle: the way back.
        max_angle: of a corner of the image off the axis [rad].
        stretch: factor of pixels along x against those along y.
    """

    angle_to_pixels: list[float]
    pixels_to_angle: list[float]
    max_angle: float
    stretch: float

    @classmethod
    def of(cls, K: Matrix, width: int, height: int) -> Ftheta:
        """Of a pinhole camera ``K`` [3, 3] and its image [px]."""
        focal, stretch = float(K[1, 1]), float(K[0, 0] / K[1, 1])
        x = max(K[0, 2], width - K[0, 2]) / K[0, 0]
        y = max(K[1, 2], height - K[1, 2]) / K[1, 1]
        reach = math.hypot(x, y)
        tangents = np.linspace(0.0, reach, SAMPLES)
        angles = np.arctan(tangents)
        return cls(
            angle_to_pixels=_odd_polynomial(angles, focal * tangents),
            pixels_to_angle=_odd_polynomial(focal * tangents, angles),
            max_angle=math.atan(reach),
            stretch=stretch,
        )


def _odd_polynomial(x: Matrix, y: Matrix) -> list[float]:
    """Coefficients from power 0 on, those of even powers 0."""
    powers = np.arange(1, 2 * ODD_TERMS, 2)
    scale = float(x[-1])
    found = np.linalg.lstsq((x[:, None] / scale) ** powers, y, rcond=None)[0]
    coefficients = np.zeros(2 * ODD_TERMS)
    coefficients[powers] = found / scale**powers
    return [float(c) for c in coefficients]
