"""Crumpled sheet: flat facets between sharp ridges, in no order.

Sheet that is pushed in bends about lines, as it neither stretches nor bends both ways at once. Its
height over where it would be smooth is linear in each facet. Facets are where the skin cuts the
tetrahedra of a lattice that stands askew in the vehicle, which needs no coordinates on the skin.
"""

from __future__ import annotations

import numpy as np

from ...geometry.rotation import Float

CELLS = (0.5, 0.22)
"""Sizes of facets and of the dents in them [m]."""
HEIGHTS = (0.2, 0.04)
"""Largest heights of their corners [m]."""
HIGHEST = sum(HEIGHTS)
STREAK = np.array([0.45, 0.45, 0.05])
"""Length, width and height of scrapes [m]: what moves on a road scrapes along it."""
SCRAPED_FROM, SCRAPE_EDGE = (0.68, 0.66), 0.1
"""Of a field from 0 to 1, from where on paint is gone or smeared, and how soon wholly."""
MOST = (0.5, 0.3)
"""Of paint that is gone, and that is smeared."""
TABLE = 16
"""Heights repeat after so many cells, more than a vehicle is long."""


def crumple(points: Float, seed: int) -> tuple[Float, Float]:
    """[G] height [m] and [G, 3] its gradient at points [G, 3] [m]."""
    random = np.random.default_rng(seed)
    height, slope = np.zeros(len(points)), np.zeros((len(points), 3))
    for cell, most in zip(CELLS, HEIGHTS, strict=True):
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        corners = random.uniform(-most, most, (TABLE,) * 3)
        values, slopes = _piecewise(points @ turn / cell, corners)
        height += values
        slope += slopes @ turn.T / cell
    return height, slope


def scrapes(points: Float, seed: int) -> Float:
    """[G, 2] how much of the paint at points [G, 3] [m] is scraped off, and how much is smeared
    with what scraped it, where sheet is pushed in as deep as can be; from 0 to 1."""
    random = np.random.default_rng(seed + 1)
    found = np.zeros((len(points), 2))
    for k, least in enumerate(SCRAPED_FROM):
        corners = random.uniform(0.0, 1.0, (TABLE,) * 3)
        values, _ = _piecewise(points / STREAK, corners)
        found[:, k] = MOST[k] * np.clip((values - least) / SCRAPE_EDGE, 0.0, 1.0)
    return found


def _piecewise(places: Float, corners: Float) -> tuple[Float, Float]:
    """[G] values and [G, 3] slopes at places [G, 3] of a lattice of unit cells, linear in each of
    the six tetrahedra of a cell between values at its ``corners`` [T, T, T]."""
    corner = np.floor(places).astype(np.int64)
    inside = places - corner
    order = np.argsort(-inside, axis=1, kind="stable")
    each = np.arange(len(places))

    def value() -> Float:
        x, y, z = (corner % len(corners)).T
        found: Float = corners[x, y, z]
        return found

    values = value()
    slopes = np.zeros(places.shape)
    before = values.copy()
    for k in range(3):
        axis = order[:, k]
        corner[each, axis] += 1
        after = value()
        slopes[each, axis] = after - before
        values += inside[each, axis] * (after - before)
        before = after
    return values, slopes
