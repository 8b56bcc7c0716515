"""Sheet metal under compression: it keeps its length and goes out of plane.

Particles are a tenth of a metre apart and only know by how much a place was shortened. Sheet that
is shortened by a fraction 1 - s folds: with folds every ``wavelength`` of its own length and flat
flanks, a chord of s per unit length leaves flanks at the angle acos(s) and an amplitude of
wavelength / 4 sqrt(1 - s^2). Flanks keep their length, so that what is drawn of them has no gaps,
and they face elsewhere, so that light falls on them as on folds. A bonnet has one fold, at half its
length, as it is made to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ..embedding import Deformed
from .crumple import HIGHEST, crumple, scrapes

WAVELENGTHS = (0.36, 0.17)
"""Of folds and of the creases between them, along the sheet [m]."""
SHARES = (0.8, 0.35)
"""Of the shortening that each takes up."""
IRREGULAR = 1.7
"""By how much folds wander from straight lines [rad]."""
ELASTIC = 0.03
"""Shortening that leaves no fold."""
KEPT = 0.5
"""Of the largest shortening so far that stays folded when the body behind it springs back."""
STEEPEST = 0.75
"""Largest shortening by folds: flanks at 66 degrees."""
SKIN = (0.25, 0.7)
"""Distance from the middle of the particles about a point, in spacings, from which on it is inside
and on the skin."""
AROUND, NEIGHBOURS = 3.0, 64
"""Particles about a point that say where outside is: within so many spacings, so many at most."""
BONNET_BEHIND, BONNET_UP = 0.2, 0.55
"""A bonnet is in this fraction of the length from the front, where the skin faces up so much."""
BONNET_HEIGHT = 0.72
"""Highest place of a bonnet, as a fraction of the vehicle's height."""
ACROSS_BONNET = 0.35
"""Of a bonnet's shortening that goes into folds besides."""
BONNET_MOST = 0.32
"""Height by which a bonnet rises at most [m]."""
SKY, SIDE = 0.45, 0.55
"""Shares of light from all of the sky and from one side."""
GROUND = 0.3
"""Of the sky's light that reaches what faces down."""
SLANT, HEIGHT = 0.6, 0.8
"""Of light from one side: how far beside the normal at rest, and how high it stands."""
AHEAD = np.array([0.45, 0.4, 0.0])
"""Where it comes from for what faces up."""
DARKEST, BRIGHTEST = 0.35, 1.7
DENT = (0.03, 0.14)
"""Depths from which on sheet that was pushed in is crumpled, and wholly so [m]."""
HOLLOW = 0.4
"""Light that the lowest facets of a deep dent lose to its rim and to the others."""
FLATTER = 0.4
"""Of the height of facets by which what is drawn is moved; it is lit by all of their slope, as what
is drawn is too coarse to show it otherwise."""
OCCLUDED = 0.4
"""Light that is lost at the bottom of a deep fold."""


@dataclass(frozen=True, eq=False)
class FoldedSheet:
    """Where points of a sheet are and what they look like.

    Attributes:
        deformed: positions, F and rotation of each point.
        light: [G] light on it against what fell on it before.
        scraped: [G, 2] how much of the paint is gone, and how much is smeared; 0 to 1.
    """

    deformed: Deformed
    light: Float
    scraped: Float


class Sheet:
    """The skin of a vehicle.

    Args:
        points: [G, 3] in the vehicle's frame [m].
        rest: [N, 3] particles at rest in the same frame [m].
        spacing: of the particles [m].
        size: (length, width, height) of the vehicle [m].
        smooth: [G] points that never fold, as wheels and glass.
        seed: of where folds are.
    """

    def __init__(
        self,
        points: Float,
        rest: Float,
        *,
        spacing: float,
        size: Sequence[float],
        smooth: NDArray[np.bool_],
        seed: int,
    ) -> None:
        self.normals, depth = _outward(points, rest, spacing)
        skin = np.clip((depth - SKIN[0]) / (SKIN[1] - SKIN[0]), 0.0, 1.0)
        self._foldable = skin * ~smooth
        self._points = points
        self._along = _phases(points, seed)
        self._crumple, self._crumple_slope = crumple(points, seed)
        self._scrapes = scrapes(points, seed)
        place = points / np.asarray(size) + 0.5
        bonnet = (self.normals[:, 2] > BONNET_UP) & (place[:, 2] < BONNET_HEIGHT)
        bonnet &= (place[:, 0] > 1 - BONNET_BEHIND) & ~smooth
        self.bonnet = bonnet
        self._bonnet_length = BONNET_BEHIND * size[0]
        self._hinge = np.clip((place[:, 0] - 1 + BONNET_BEHIND) / BONNET_BEHIND, 0.0, 1.0)

    def shortening(self, F: Float) -> Float:
        """[G, 3] by what fraction sheet is shorter along the vehicle's axes."""
        shorter: Float = np.clip(1 - np.linalg.norm(F, axis=1) - ELASTIC, 0.0, STEEPEST)
        return shorter

    def fold(self, body: Deformed, most: Float, rows: NDArray[np.int64]) -> FoldedSheet:
        """The sheet on a body.

        Args:
            body: how R points move with the particles around them.
            most: [R, 3] their largest shortening so far, of this instant too.
            rows: [R] which points; all of a bonnet or none.
        """
        at_rest, foldable = self.normals[rows], self._foldable[rows]
        shortened = np.maximum(self.shortening(body.F), KEPT * most) * foldable[:, None]
        # A sheet is shortened along itself only.
        shortened = shortened * (1 - at_rest**2)
        normals = _turned(body.rotations, at_rest)
        raised, hump = self._bonnet_rise(shortened, rows)
        shortened[self.bonnet[rows], 0] *= ACROSS_BONNET
        pressed = self._pressed(body, rows) * np.minimum(4 * foldable, 1.0)
        offset, deepest = FLATTER * pressed * self._crumple[rows], np.zeros(len(normals))
        tilted = _faces(body.F, at_rest)
        slope = self._crumple_slope[rows]
        slope = slope - (slope * at_rest).sum(axis=1)[:, None] * at_rest
        tilted -= pressed[:, None] * _turned(body.rotations, slope)
        F = body.F.copy()
        for axis in range(3):
            along = F[:, :, axis] / np.maximum(np.linalg.norm(F[:, :, axis], axis=1), 1e-6)[:, None]
            for k, (wavelength, share) in enumerate(zip(WAVELENGTHS, SHARES, strict=True)):
                sine = np.sqrt(1 - (1 - share * shortened[:, axis]) ** 2)
                wave, slope = _triangle(self._along[axis, k, rows])
                offset += wavelength / 4 * sine * wave
                tilted -= (sine * slope)[:, None] * along
                deepest += sine * (1 - wave) / 2
        tilted -= hump[:, None] * F[:, :, 0]
        tilted /= np.maximum(np.linalg.norm(tilted, axis=1), 1e-9)[:, None]
        up = np.zeros((len(normals), 3))
        up[:, 2] = raised
        positions = body.positions + offset[:, None] * normals + up
        tilt = _between(normals, tilted)
        F = tilt @ _lengthened(F, shortened)
        towards = _lit_from(at_rest)
        light = _light(tilted, towards) / _light(at_rest, towards)
        light *= 1 - OCCLUDED * np.clip(deepest, 0.0, 1.0)
        light *= 1 - HOLLOW * pressed * (1 - self._crumple[rows] / HIGHEST) / 2
        scraped = self._scrapes[rows] * pressed[:, None]
        light = np.where(foldable > 0, np.clip(light, DARKEST, BRIGHTEST), 1.0)
        return FoldedSheet(Deformed(positions, F, tilt @ body.rotations), light, scraped)

    def _pressed(self, body: Deformed, rows: NDArray[np.int64]) -> Float:
        """[R] how far points were pushed in, from not at all (0) to as deep as it looks (1)."""
        depth = -((body.positions - self._points[rows]) * self.normals[rows]).sum(axis=1)
        pressed: Float = np.clip((depth - DENT[0]) / (DENT[1] - DENT[0]), 0.0, 1.0)
        return pressed

    def _bonnet_rise(self, shortened: Float, rows: NDArray[np.int64]) -> tuple[Float, Float]:
        """[R] height by which the bonnet is raised, [R] and its slope."""
        raised, slope = np.zeros(len(shortened)), np.zeros(len(shortened))
        bonnet = self.bonnet[rows]
        if not bonnet.any():
            return raised, slope
        by = float(np.quantile(shortened[bonnet, 0], 0.6))
        sine = np.sqrt(1 - (1 - by) ** 2)
        rise = min(self._bonnet_length / 2 * sine, BONNET_MOST)
        hinge = self._hinge[rows]
        ridge = 1 - np.abs(2 * hinge - 1)
        slope = np.where(hinge < 0.5, 1.0, -1.0) * 2 * rise / self._bonnet_length
        return rise * ridge * bonnet, slope * bonnet


def _outward(points: Float, rest: Float, spacing: float) -> tuple[Float, Float]:
    """[G, 3] normals, away from the particles about each point, and how far away [spacings]."""
    from scipy.spatial import cKDTree

    nearest = np.arange(1, min(NEIGHBOURS, len(rest)) + 1)
    distance, index = cKDTree(rest).query(points, k=nearest)
    weights = np.maximum(1 - (distance / (AROUND * spacing)) ** 2, 1e-6)
    middle = (weights[:, None] @ rest[index])[:, 0] / weights.sum(axis=1, keepdims=True)
    away = points - middle
    depth = np.linalg.norm(away, axis=1)
    return away / np.maximum(depth, 1e-9)[:, None], depth / spacing


def _phases(points: Float, seed: int) -> Float:
    """[3, 2, G] phases of folds and creases along each axis; they wander with the other axes."""
    random = np.random.default_rng(seed)
    shifts = random.uniform(0, 2 * np.pi, (3, len(WAVELENGTHS), 3))
    phases = np.zeros((3, len(WAVELENGTHS), len(points)))
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for k, wavelength in enumerate(WAVELENGTHS):
            a, b, c = shifts[axis, k]
            slanted = points[:, axis] + (0.0, 0.6)[k] * (points[:, one] + points[:, two])
            wander = np.sin(points[:, one] / (0.23 * (2 - k)) + b)
            wander = wander + np.sin(points[:, two] / (0.17 * (2 - k)) + c)
            phases[axis, k] = 2 * np.pi * slanted / wavelength + a + IRREGULAR / 2 * wander
    return phases


def _triangle(phase: Float) -> tuple[Float, Float]:
    """A wave in [-1, 1] with flat flanks and slightly rounded edges, and its slope in [-1, 1]."""
    sharp = 0.94
    wave = np.arcsin(sharp * np.sin(phase)) / np.arcsin(sharp)
    slope = sharp * np.cos(phase) / np.sqrt(1 - (sharp * np.sin(phase)) ** 2)
    return wave, slope


def _lengthened(F: Float, shortened: Float) -> Float:
    """F with the length back that folding takes up."""
    factors = 1 / np.maximum(1 - shortened, 1 - STEEPEST)
    longer: Float = F * factors[:, None, :]
    return longer


def _turned(rotations: Float, vectors: Float) -> Float:
    turned: Float = (rotations @ vectors[:, :, None])[:, :, 0]
    return turned


def _faces(F: Float, normals: Float) -> Float:
    """[G, 3] where surfaces face that faced along unit ``normals``, mapped by F [G, 3, 3]."""
    faces = np.linalg.solve(F.transpose(0, 2, 1), normals[:, :, None])[:, :, 0]
    found: Float = faces / np.maximum(np.linalg.norm(faces, axis=1), 1e-9)[:, None]
    return found


def _between(first: Float, second: Float) -> Float:
    """[G, 3, 3] smallest rotations that turn unit vectors ``first`` [G, 3] to ``second``."""
    axis = np.cross(first, second)
    cosine = np.clip((first * second).sum(axis=1), -0.99, 1.0)
    cross = np.zeros((len(first), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    turned: Float = np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]
    return turned


def _lit_from(normals: Float) -> Float:
    """[G, 3] where light comes from that falls on surfaces with unit ``normals`` at rest [G, 3].

    What a surface shows at rest is how it was lit when it was seen, whichever side that was. So
    light comes from above and beside each surface, never along it: however it is turned, it gets
    lighter or darker.
    """
    x, y = normals[:, 0], normals[:, 1]
    beside = np.stack([x - y, x + y, np.zeros(len(x))], axis=1) * np.sqrt(0.5)
    towards = SLANT * beside + (1 - np.hypot(x, y))[:, None] * AHEAD
    towards[:, 2] = HEIGHT
    found: Float = towards / np.linalg.norm(towards, axis=1)[:, None]
    return found


def _light(normals: Float, towards: Float) -> Float:
    """[G] light on surfaces that face along unit ``normals`` [G, 3]."""
    sky = SKY * (GROUND + (1 - GROUND) * (1 + normals[:, 2]) / 2)
    light: Float = sky + SIDE * np.maximum((normals * towards).sum(axis=1), 0.0)
    return light
