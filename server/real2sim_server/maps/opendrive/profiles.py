"""Cubic polynomials over s, piece by piece: elevation, superelevation, lane offset, widths."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import Float
from ..xml_files import number


@dataclass(frozen=True)
class Profile:
    """a + b d + c d^2 + d d^3 with d = s - start of the last record at or before s; 0 without one.

    Attributes:
        starts: [R] float64, increasing places [m].
        rows: [R, 4] float64.
    """

    starts: Float
    rows: Float

    def at(self, s: Float, *, until: float = np.inf) -> Float:
        """Values [K] at places ``s`` [K]; a record that starts at ``until`` counts no more there,
        so that ends of sections keep their own."""
        if not len(self.starts):
            return np.zeros_like(s)
        looked_up = np.minimum(s, until - 1e-9)
        k = np.searchsorted(self.starts, looked_up + 1e-12, side="right") - 1
        before = k < 0
        a, b, c, d = self.rows[np.maximum(k, 0)].T
        x = s - self.starts[np.maximum(k, 0)]
        return np.where(before, 0.0, a + x * (b + x * (c + x * d)))


def read_profile(
    elements: Iterable[ET.Element], where: str, *, start: str = "s", base: float = 0.0
) -> Profile:
    """The profile of elements with attributes ``start``, a, b, c and d; ``base`` [m] is added to
    their starts.

    Raises:
        MapError: an attribute is absent or no number.
    """
    rows = [[number(e, name, where) for name in (start, "a", "b", "c", "d")] for e in elements]
    table = np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 5)
    return Profile(table[:, 0] + base, table[:, 1:])
