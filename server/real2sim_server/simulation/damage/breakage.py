"""Which parts break, and when: by what the particles around them were moved against each other."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ...geometry.rotation import Float
from .parts import Kind, Part, parts_of

LIMITS: dict[Kind, float] = {"lamp": 0.05, "bumper": 0.08, "windscreen": 0.03, "pane": 0.035}
"""A lamp or a bumper breaks when the outer part of what carries it was pushed in by so much; glass
when its frame is racked by so much, root mean square over the frame [m]. Laminated screens crack
first: side windows give way with their door."""
OUTER = 0.75
"""Quantile of the way in that counts: half of what is around a lamp is behind it."""
LEAST_PARTICLES = 3
NEAR = 0.6
"""Particles within so many spacings of a part's box carry it."""


@dataclass(frozen=True)
class Breakage:
    """A part that broke.

    Attributes:
        object_id, part, kind: which one.
        time_s: when, since the start [s].
        position: [3] of the middle of the part in the world [m].
        velocity: [3] of that place then [m/s].
        outward: [3] where the part faced, world.
        severity: how far the limit was passed by the end of it, at least 1.
    """

    object_id: str
    part: str
    kind: Kind
    time_s: float
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    outward: tuple[float, float, float]
    severity: float

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Breakage:
        """What :meth:`record` gave. Raises TypeError for other members."""
        members: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in record.items()
        }
        return cls(**members)


class BreakageLog:
    """Follows the parts of one vehicle through the frames of a crash.

    Args:
        category, size: of the vehicle; things that are no vehicles have no parts.
        rest: [N, 3] particles at rest, object frame [m].
        spacing: of the particles [m].
    """

    def __init__(
        self, category: str, size: Sequence[float], rest: Float, *, spacing: float
    ) -> None:
        self._rest = rest
        self._carried: list[tuple[Part, Any]] = []
        for part in parts_of(category, size):
            near = np.flatnonzero(part.holds(rest, NEAR * spacing))
            if len(near) >= LEAST_PARTICLES:
                self._carried.append((part, near))
        self.broken: dict[str, float] = {}
        """How far each part's limit was passed at most; 1 and more is broken."""

    def follow(self, displacements: Float) -> list[Part]:
        """Parts that break in a frame in which particles are displaced [N, 3] [m] from rest."""
        new = []
        # Most of a vehicle keeps its shape, and parts are broken against that.
        moved = displacements - np.median(displacements, axis=0)
        for part, near in self._carried:
            passed = _strain(part, moved[near]) / LIMITS[part.kind]
            if passed >= 1.0 and part.name not in self.broken:
                new.append(part)
            if passed >= 1.0:
                self.broken[part.name] = max(self.broken.get(part.name, 0.0), passed)
        return new

    def copy(self) -> BreakageLog:
        """A log that goes on from here on its own."""
        twin = copy(self)
        twin.broken = dict(self.broken)
        return twin

    def place(self, part: Part, displacements: Float) -> Float:
        """[3] where the middle of a part is, object frame [m]."""
        near = next(n for p, n in self._carried if p.name == part.name)
        place: Float = part.middle + displacements[near].mean(axis=0)
        return place


def _strain(part: Part, moved: Float) -> float:
    """What counts against the part's limit [m]."""
    if part.kind in ("windscreen", "pane"):
        return float(np.sqrt(((moved - moved.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return float(np.quantile(-(moved @ np.array(part.outward)), OUTER))
