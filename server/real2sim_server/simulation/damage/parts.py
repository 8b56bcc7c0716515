"""Parts of a vehicle that break or come loose, found by their place on its box.

ECE R48 puts headlamps 0.5 to 1.2 m above the road within 0.4 m of the outline, so that heights are
metres; glass begins at the belt and ends under the roof's edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ..structure import VEHICLES

Kind = Literal["lamp", "pane", "windscreen", "bumper"]
ENDS = 0.1
"""Length of an end on which lamps and bumpers are, as a fraction of the vehicle's."""
LAMP_HEIGHT, LAMP_WIDTH = (0.52, 0.9), 0.32
"""Above the road [m]; of each lamp, as a fraction of the vehicle's width."""
BUMPER_HEIGHT = (0.18, 0.52)
"""Above the road [m]."""
TALL = 1.9
"""Vehicles higher than this [m] are vans or lorries: belt and bumpers are higher."""
BELT, BELT_TALL = 0.6, 0.5
"""Heights at which glass begins, as fractions of the vehicle's."""
COWL, UNDER_ROOF = 0.05, 0.94
"""From the belt up to where a windscreen begins, and where glass ends, as such fractions."""
SCREEN, REAR_SCREEN = (0.56, 0.86), (0.02, 0.3)
"""Where screens are along a car, as fractions of its length from the rear."""
SCREEN_TALL = (0.72, 0.98)
INSIDE = 0.14
"""What is nearer to the middle plane than half the width less this fraction of the width is no side
window."""

AXLES, WHEEL_RADIUS, TREAD = 0.3, 0.38, 0.28
"""Of wheels: along the length from the middle, radius [m], width within the sides [m]."""


@dataclass(frozen=True)
class Part:
    """A part of a vehicle.

    Attributes:
        name: unique on a vehicle.
        kind: what it does when it breaks.
        low, high: corners of its box in the vehicle's frame [m].
        outward: [3] where it faces.
    """

    name: str
    kind: Kind
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    outward: tuple[float, float, float]

    def holds(self, points: Float, margin: float = 0.0) -> NDArray[np.bool_]:
        """[N] whether points [N, 3] are within its box, which is ``margin`` [m] larger."""
        low, high = np.array(self.low) - margin, np.array(self.high) + margin
        inside: NDArray[np.bool_] = np.all((points > low) & (points < high), axis=1)
        return inside

    @property
    def middle(self) -> Float:
        """[3] of its box [m]."""
        middle: Float = np.array([self.low, self.high]).mean(axis=0)
        return middle


def parts_of(category: str, size: Sequence[float]) -> tuple[Part, ...]:
    """Parts of a vehicle of ``size`` (length, width, height) [m]; none of other things."""
    if category not in VEHICLES:
        return ()
    return (*_end(size, ahead=True), *_end(size, ahead=False), *_glass(size))


def in_wheels(points: Float, size: Sequence[float]) -> NDArray[np.bool_]:
    """[N] whether points [N, 3] of a vehicle are where wheels are under a box of ``size``."""
    length, width, height = size
    along = np.abs(np.abs(points[:, 0]) - AXLES * length)
    up = points[:, 2] + height / 2 - WHEEL_RADIUS
    inside: NDArray[np.bool_] = np.hypot(along, up) < WHEEL_RADIUS
    return inside & (np.abs(points[:, 1]) > width / 2 - TREAD)


def _end(size: Sequence[float], *, ahead: bool) -> list[Part]:
    """Lamps and bumper of the front or the rear."""
    length, width, height = size
    end, sign = ("front", 1.0) if ahead else ("rear", -1.0)
    near, far = sign * length * (0.5 - ENDS), sign * (length / 2 + 0.1)
    x = min(near, far), max(near, far)
    raised = 0.12 if height > TALL else 0.0
    bumper = [h + raised - height / 2 for h in BUMPER_HEIGHT]
    out = (sign, 0.0, 0.0)
    found = [
        Part(
            f"{end} bumper",
            "bumper",
            (x[0], -width, bumper[0] - 0.1),
            (x[1], width, bumper[1]),
            out,
        )
    ]
    lamp = [h + raised - height / 2 for h in LAMP_HEIGHT]
    for side, name in ((1.0, "left"), (-1.0, "right")):
        inner, outer = side * width * (0.5 - LAMP_WIDTH), side * (width / 2 + 0.1)
        y = min(inner, outer), max(inner, outer)
        low, high = (x[0], y[0], lamp[0]), (x[1], y[1], lamp[1])
        found.append(Part(f"{end} {name} lamp", "lamp", low, high, (sign, 0.3 * side, 0.0)))
    return found


def _glass(size: Sequence[float]) -> list[Part]:
    """Windscreen, rear window, side windows."""
    length, width, height = size
    tall = height > TALL
    belt = ((BELT_TALL if tall else BELT) - 0.5) * height
    top = (UNDER_ROOF - 0.5) * height
    half, inner = width / 2 + 0.1, (0.5 - INSIDE) * width
    x = [(f - 0.5) * length for f in (SCREEN_TALL if tall else SCREEN)]
    found = [
        Part(
            "windscreen",
            "windscreen",
            (x[0], -inner, belt + COWL * height),
            (x[1], inner, top),
            (0.8, 0.0, 0.6),
        )
    ]
    back = [(f - 0.5) * length for f in REAR_SCREEN]
    if not tall:
        low, high = (back[0], -inner, belt), (back[1], inner, top)
        found.append(Part("rear window", "pane", low, high, (-0.8, 0.0, 0.6)))
    # Side windows end at the pillar before the front door, which a crushed front does not reach.
    along = (x[0] - 0.15 * length, x[0] + 0.1 * length) if tall else (-0.36 * length, 0.18 * length)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        y = (inner, half) if side > 0 else (-half, -inner)
        low, high = (along[0], y[0], belt), (along[1], y[1], top)
        found.append(Part(f"{name} windows", "pane", low, high, (0.0, side, 0.0)))
    return found
