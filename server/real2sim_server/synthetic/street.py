"""The street's course and cross-section.

Street coordinates are (s, d): s along the centre line, d to its left [m]. Traffic keeps right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.transform import Float

LANE = 3.4
"""Width of a driving lane [m]."""

KERB = 5.7
"""Distance of the kerbs from the centre line [m]: a lane and a parking strip."""

KERB_HEIGHT = 0.12
FACADE = 9.2
"""Distance of the building line from the centre line [m]."""

EGO_OFFSET = -LANE / 2
"""Where the ego vehicle drives, d [m]."""

_STEP = 0.5
_BEHIND, _AHEAD = 55.0, 105.0


@dataclass(frozen=True, eq=False)
class Street:
    """A gently winding centre line.

    Attributes:
        stations: [n] s of the samples [m].
        points: [n, 2] x, y in the world [m].
        headings: [n] direction of travel [rad].
        crossing: s of the pedestrian crossing [m].
    """

    stations: Float
    points: Float
    headings: Float
    crossing: float

    @property
    def start(self) -> float:
        """First s [m]."""
        return float(self.stations[0])

    @property
    def end(self) -> float:
        """Last s [m]."""
        return float(self.stations[-1])

    def heading(self, s: ArrayLike) -> Float:
        """Direction of travel [...] [rad] at s [...]."""
        return np.interp(np.asarray(s, dtype=np.float64), self.stations, self.headings)

    def point(self, s: ArrayLike, d: ArrayLike) -> Float:
        """World x, y [..., 2] of street coordinates [...]."""
        s, d = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(d, np.float64))
        heading = self.heading(s)
        x = np.interp(s, self.stations, self.points[:, 0]) - d * np.sin(heading)
        y = np.interp(s, self.stations, self.points[:, 1]) + d * np.cos(heading)
        return np.stack([x, y], axis=-1)


def lay_street(rng: np.random.Generator, *, drive_length: float) -> Street:
    """A street for a drive of ``drive_length`` [m] that starts at s = 0.

    The ego vehicle's lane passes the world's origin along x there.
    """
    stations = np.arange(-_BEHIND, drive_length + _AHEAD + _STEP, _STEP)
    bend = rng.choice([-1.0, 1.0]) * rng.uniform(1 / 260, 1 / 150)
    wave_length = rng.uniform(220, 320)
    curvature = bend * np.sin(2 * np.pi * (stations + rng.uniform(10, 30)) / wave_length)
    headings = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * _STEP)])
    headings -= np.interp(0, stations, headings)
    middle = (headings[1:] + headings[:-1]) / 2
    steps = np.stack([np.cos(middle), np.sin(middle)], axis=1) * _STEP
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    origin = [np.interp(0, stations, points[:, i]) for i in range(2)]
    points += np.array([0.0, -EGO_OFFSET]) - origin
    return Street(stations, points, headings, crossing=rng.uniform(22, 34))
