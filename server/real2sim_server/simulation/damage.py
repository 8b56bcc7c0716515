"""Rendering of damaged vehicles: displaces, folds, shades and breaks their Gaussians.

Particles provide the displacement field; this module derives the appearance of the sheet metal.
Rollouts, the REST API and the closed loop use the same code.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import Float
from ..scene import GaussianCloud
from .breakage import Part, in_wheels, parts_of
from .particles import Deformed, Embedding, deform_cloud, replaced_rows

# Crumpled sheet: flat facets between sharp ridges, in an irregular pattern.
#
# Sheet metal neither stretches nor bends in two directions at once, so a dent bends it along lines.
# Its height above the smooth surface is linear in each facet. Facets are the intersections of the
# skin with the tetrahedra of a tilted lattice, so no surface coordinates are needed.

CELLS = (0.5, 0.22)
"""Sizes of facets and of the dents in them [m]."""
HEIGHTS = (0.2, 0.04)
"""Maximum heights of their corners [m]."""
HIGHEST = sum(HEIGHTS)
STREAK = np.array([0.45, 0.45, 0.05])
"""Length, width and height of scrapes [m], elongated along the road."""
SCRAPED_FROM, SCRAPE_EDGE = (0.68, 0.66), 0.1
"""Thresholds of a noise field in [0, 1] above which paint is gone or smeared, and the width of the
transition."""
MAX_SCRAPE = (0.5, 0.3)
"""Maximum fractions of paint scraped off and smeared."""
TABLE = 16
"""Period of the noise, in cells; longer than a vehicle."""


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
    """[G, 2] fractions of paint scraped off and smeared at points [G, 3] [m], at maximum depth."""
    random = np.random.default_rng(seed + 1)
    found = np.zeros((len(points), 2))
    for k, least in enumerate(SCRAPED_FROM):
        corners = random.uniform(0.0, 1.0, (TABLE,) * 3)
        values, _ = _piecewise(points / STREAK, corners)
        found[:, k] = MAX_SCRAPE[k] * np.clip((values - least) / SCRAPE_EDGE, 0.0, 1.0)
    return found


def _piecewise(places: Float, corners: Float) -> tuple[Float, Float]:
    """[G] values and [G, 3] gradients at points [G, 3] of a lattice of unit cells.

    Linear in each of the six tetrahedra of a cell, from its values at ``corners`` [T, T, T].
    """
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


# Sheet metal under compression keeps its length and buckles out of plane.
#
# Particles are a tenth of a metre apart and only give the local shortening. A sheet shortened by a
# fraction 1 - s folds: with folds every ``wavelength`` of its own length and flat flanks, a chord
# of s per unit length gives flanks at the angle acos(s) and an amplitude of wavelength / 4 sqrt(1 -
# s^2). Flanks keep their length, so their Gaussians leave no gaps. They rotate, so they are shaded
# like folds. A bonnet has one fold at half its length, by design.

WAVELENGTHS = (0.36, 0.17)
"""Wavelengths of folds and of the creases between them, along the sheet [m]."""
SHARES = (0.8, 0.35)
"""Fractions of the shortening taken up by folds and by creases."""
IRREGULAR = 1.7
"""Amplitude of the deviation of folds from straight lines [rad]."""
ELASTIC = 0.03
"""Shortening without folds, as a fraction."""
KEPT = 0.5
"""Fraction of the largest shortening that stays folded when the body springs back."""
MAX_SHORTENING = 0.75
"""Maximum shortening by folds: flanks at 66 degrees."""
SKIN = (0.25, 0.7)
"""Distances [spacings] to the mean of nearby particles: a point is inside below the first and on
the skin above the second."""
AROUND, NEIGHBOURS = 3.0, 64
"""Radius [spacings] and maximum number of the nearby particles that determine the outward
direction."""
BONNET_BEHIND, BONNET_UP = 0.2, 0.55
"""A bonnet is in this fraction of the length at the front; minimum z of its normals."""
BONNET_HEIGHT = 0.72
"""Maximum height of a bonnet, as a fraction of the vehicle's height."""
ACROSS_BONNET = 0.35
"""Fraction of a bonnet's shortening that also appears as small folds."""
BONNET_MOST = 0.32
"""Maximum rise of a bonnet [m]."""
SKY, SIDE = 0.45, 0.55
"""Fractions of the light from the whole sky and from one side."""
GROUND = 0.3
"""Fraction of the sky's light on surfaces that face down."""
SLANT, HEIGHT = 0.6, 0.8
"""Light from one side: horizontal offset from the normal at rest, and vertical component."""
AHEAD = np.array([0.45, 0.4, 0.0])
"""Horizontal direction of this light for surfaces that face up."""
DARKEST, BRIGHTEST = 0.35, 1.7
DENT = (0.03, 0.14)
"""Depths at which dented sheet starts to crumple, and is fully crumpled [m]."""
HOLLOW = 0.4
"""Fraction of light that the lowest facets of a deep dent lose."""
FLATTER = 0.4
"""Fraction of the facet height by which Gaussians move. Shading uses the full slope, because
Gaussians are too coarse to show facets otherwise."""
OCCLUDED = 0.4
"""Fraction of light lost at the bottom of a deep fold."""


@dataclass(frozen=True, eq=False)
class FoldedSheet:
    """Geometry and appearance of points on a sheet.

    Attributes:
        deformed: positions, F and rotation of each point.
        light: [G] light relative to the undeformed sheet.
        scraped: [G, 2] fractions of paint scraped off and smeared, 0 to 1.
    """

    deformed: Deformed
    light: Float
    scraped: Float


class Sheet:
    """The skin of a vehicle.

    Args:
        points: [G, 3] vehicle frame [m].
        rest: [N, 3] particles at rest, same frame [m].
        spacing: particle spacing [m].
        size: (length, width, height) of the vehicle [m].
        smooth: [G] points that never fold, such as wheels and glass.
        seed: seed of the fold positions.
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
        """[G, 3] relative shortening of the sheet along the vehicle axes."""
        shorter: Float = np.clip(1 - np.linalg.norm(F, axis=1) - ELASTIC, 0.0, MAX_SHORTENING)
        return shorter

    def fold(self, body: Deformed, most: Float, rows: NDArray[np.int64]) -> FoldedSheet:
        """The deformed sheet.

        Args:
            body: deformation of R points.
            most: [R, 3] their largest shortening so far, including this instant.
            rows: [R] indices of the points; include all points of a bonnet or none.
        """
        at_rest, foldable = self.normals[rows], self._foldable[rows]
        shortened = np.maximum(self.shortening(body.F), KEPT * most) * foldable[:, None]
        # A sheet is only shortened in its own plane.
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
        """[R] relative depth by which points are pushed in, 0 to 1 (maximum visible depth)."""
        depth = -((body.positions - self._points[rows]) * self.normals[rows]).sum(axis=1)
        pressed: Float = np.clip((depth - DENT[0]) / (DENT[1] - DENT[0]), 0.0, 1.0)
        return pressed

    def _bonnet_rise(self, shortened: Float, rows: NDArray[np.int64]) -> tuple[Float, Float]:
        """[R] height by which the bonnet is raised, and [R] its slope."""
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
    """[G, 3] normals, away from the nearby particles, and distance to their mean [spacings]."""
    from scipy.spatial import cKDTree

    nearest = np.arange(1, min(NEIGHBOURS, len(rest)) + 1)
    distance, index = cKDTree(rest).query(points, k=nearest)
    weights = np.maximum(1 - (distance / (AROUND * spacing)) ** 2, 1e-6)
    middle = (weights[:, None] @ rest[index])[:, 0] / weights.sum(axis=1, keepdims=True)
    away = points - middle
    depth = np.linalg.norm(away, axis=1)
    return away / np.maximum(depth, 1e-9)[:, None], depth / spacing


def _phases(points: Float, seed: int) -> Float:
    """[3, 2, G] phases of folds and creases along each axis; they vary along the other axes."""
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
    """F without the shortening that folds represent."""
    factors = 1 / np.maximum(1 - shortened, 1 - MAX_SHORTENING)
    longer: Float = F * factors[:, None, :]
    return longer


def _turned(rotations: Float, vectors: Float) -> Float:
    turned: Float = (rotations @ vectors[:, :, None])[:, :, 0]
    return turned


def _faces(F: Float, normals: Float) -> Float:
    """[G, 3] unit ``normals`` of surfaces after the map F [G, 3, 3]."""
    faces = np.linalg.solve(F.transpose(0, 2, 1), normals[:, :, None])[:, :, 0]
    found: Float = faces / np.maximum(np.linalg.norm(faces, axis=1), 1e-9)[:, None]
    return found


def _between(first: Float, second: Float) -> Float:
    """[G, 3, 3] smallest rotations from unit vectors ``first`` [G, 3] to ``second``."""
    axis = np.cross(first, second)
    cosine = np.clip((first * second).sum(axis=1), -0.99, 1.0)
    cross = np.zeros((len(first), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    turned: Float = np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]
    return turned


def _lit_from(normals: Float) -> Float:
    """[G, 3] direction of the light on surfaces with unit ``normals`` [G, 3] at rest.

    The recorded colours include the original lighting. Light is therefore placed obliquely above
    each surface: every rotation makes the surface lighter or darker.
    """
    x, y = normals[:, 0], normals[:, 1]
    beside = np.stack([x - y, x + y, np.zeros(len(x))], axis=1) * np.sqrt(0.5)
    towards = SLANT * beside + (1 - np.hypot(x, y))[:, None] * AHEAD
    towards[:, 2] = HEIGHT
    found: Float = towards / np.linalg.norm(towards, axis=1)[:, None]
    return found


def _light(normals: Float, towards: Float) -> Float:
    """[G] light on surfaces with unit ``normals`` [G, 3]."""
    sky = SKY * (GROUND + (1 - GROUND) * (1 + normals[:, 2]) / 2)
    light: Float = sky + SIDE * np.maximum((normals * towards).sum(axis=1), 0.0)
    return light


SH_0 = 0.28209479177387814
GLASS_DARKER = 0.7
"""Glass is darker than this fraction of the vehicle's paint, within the box of a pane."""
OTHER_HUE = 0.05
"""Or its share of a colour channel differs by this much, for glass that reflects the sky."""
LEANING = 0.12
"""Inward lean of side windows, as a fraction of the width."""
OF_GLASS = 0.1
"""Minimum colour difference between a windscreen and the paint."""
SILLS = 0.3
"""Fraction of a vehicle's height below which only wheels and shadow are expected."""
OTHER_COLOUR = 0.22
"""Minimum colour difference between a lamp and the paint."""
LAMP_DARKER, LAMP_SHARE = 0.6, 0.6
"""A lamp is brighter than this fraction of the paint, unlike grilles; of these Gaussians, the most
different ones up to this share belong to it."""
LAMP_LEFT, PANE_LEFT = 0.22, 0.35
"""Fraction of light from the hole left by a lamp or a pane."""
CRACKED = np.array([0.62, 0.67, 0.68])
"""Colour of crazed laminated glass."""
CRAZED = 0.55
"""Fraction of a cracked windscreen that is crazed."""
BARE, SMEAR = np.array([0.55, 0.56, 0.57]), np.array([0.1, 0.1, 0.1])
"""Metal under scraped paint; rubber, plastic and dirt left by scraping."""
DROOP, DROOP_TIME = 0.16, 0.35
"""Droop angle of a loose bumper at one end [rad], and its duration [s]."""
HANGS_STILL = 3 * DROOP_TIME
"""Time after which a loose bumper is at rest [s]: it would sink by less than 0.1 mm more."""
LOOSE = 0.25
"""Outward displacement of the loose end, as a fraction of its droop."""
CLEARANCE = 0.04
"""Clearance of a loose bumper above the road [m]."""
MIN_DISPLACEMENT = 8e-3
"""Minimum displacement of particles that moves Gaussians [m]. A vehicle that is hit hard bends
elastically by several millimetres everywhere; the slowest impact that deforms it dents it by more
than twice as much."""
CARRIED_ROUNDS, CARRIED_SCALE = 5, 0.01
"""Iterations of reweighting, and length scale of the weights [m], for the rigid motion of a
vehicle."""
SPLIT = 1.5
"""Gaussians stretched by more than this factor are split in two."""


class DamagedVehicle:
    """An object whose Gaussians follow its particles.

    Args:
        cloud: its Gaussians at rest, object frame.
        rest: [N, 3] particles at rest, object frame [m].
        spacing: particle spacing [m].
        category, size: category and size of the object.
        object_id: id of the object; seeds the fold pattern.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        rest: Float,
        *,
        spacing: float,
        category: str,
        size: Sequence[float],
        object_id: str,
    ) -> None:
        self._cloud, self._size = cloud, size
        points = cloud.means.detach().cpu().numpy().astype(np.float64)
        self._points, self._rest = points, rest
        self._embedding = Embedding(rest, points, spacing=spacing)
        self._parts = {part.name: part for part in parts_of(category, size)}
        colours = np.clip(cloud.sh[:, 0].detach().cpu().numpy() * SH_0 + 0.5, 0.0, 1.0)
        self._brightness = colours.mean(axis=1)
        painted = self._painted()
        self._paint = float(np.median(self._brightness[painted]))
        hues = colours / np.maximum(3 * self._brightness, 0.05)[:, None]
        self._other_hue = np.abs(hues - np.median(hues[painted], axis=0)).max(axis=1)
        self._unlike_paint = np.abs(colours - np.median(colours[painted], axis=0)).max(axis=1)
        self._rows = {name: self._rows_of(part) for name, part in self._parts.items()}
        glass = np.zeros(len(points), dtype=bool)
        for name, part in self._parts.items():
            if part.kind in ("pane", "windscreen"):
                glass[self._rows[name]] = True
        self._seed = zlib.crc32(object_id.encode())
        self._sheet = Sheet(
            points,
            rest,
            spacing=spacing,
            size=size,
            smooth=glass | in_wheels(points, size),
            seed=self._seed,
        )

    def shortening(self, displacements: Float) -> Float:
        """[G, 3] relative shortening of the sheet at each Gaussian along the vehicle axes.

        Takes particle displacements [N, 3] [m]. Pass the maximum so far to :meth:`cloud`.
        """
        shorter = np.zeros((len(self._points), 3))
        rows = np.flatnonzero(self._embedding.near(_moved(displacements)))
        shorter[rows] = self._sheet.shortening(self._embedding.gradients(displacements, rows))
        return shorter

    def cloud(
        self, displacements: Float, most: Float, broken: Mapping[str, float]
    ) -> GaussianCloud:
        """The damaged Gaussians; undisplaced ones are bitwise unchanged.

        Args:
            displacements: [N, 3] particle displacements from rest [m].
            most: [G, 3] largest shortening so far.
            broken: names of broken parts, and the time since then [s].
        """
        changed = self._embedding.near(_moved(displacements)) | (most > 0).any(axis=1)
        if (changed & self._sheet.bonnet).any():
            changed |= self._sheet.bonnet
        rows = np.flatnonzero(changed)
        body = self._embedding.follow(displacements, rows)
        # Only motion relative to the vehicle as a whole is damage.
        turn, shift = _carried(self._rest, displacements)
        folded = self._sheet.fold(_without(body, turn, shift), most[rows], rows)
        index = torch.from_numpy(rows).to(self._cloud.device)
        part = deform_cloud(self._cloud.select(index), _with(folded.deformed, turn, shift))
        light = np.ones(len(self._points))
        light[rows] = folded.light
        for name in broken:
            kind = self._parts[name].kind
            if kind in ("lamp", "pane"):
                light[self._rows[name]] *= LAMP_LEFT if kind == "lamp" else PANE_LEFT
        moved = replaced_rows(self._cloud, index, part)
        sh = _lit(_scraped(moved.sh, index, folded.scraped), light)
        if "windscreen" in broken:
            sh = self._crazed(sh)
        means = moved.means
        for name, age in broken.items():
            if self._parts[name].kind == "bumper":
                means = self._drooped(name, means, age)
        return _split(replace(moved, means=means, sh=sh), rows, body.F)

    def _rows_of(self, part: Part) -> NDArray[np.int64]:
        """Rows of the Gaussians of a part: those in its box, without the surrounding paint."""
        inside = part.holds(self._points)
        if part.kind == "pane" and part.outward[1]:
            inside |= self._leaning(part)
        if part.kind == "windscreen":
            # A windscreen reflects the sky and can be brighter than paint, so brightness does not
            # help.
            inside &= self._unlike_paint > OF_GLASS
        elif part.kind == "pane":
            dark = self._brightness < max(GLASS_DARKER * self._paint, 0.12)
            inside &= dark | (self._other_hue > OTHER_HUE)
        elif part.kind == "lamp":
            bright = self._brightness > LAMP_DARKER * self._paint
            inside &= bright & (self._unlike_paint > OTHER_COLOUR)
            if inside.any():
                least = np.quantile(self._unlike_paint[inside], 1 - LAMP_SHARE)
                inside &= self._unlike_paint >= least
        return np.flatnonzero(inside)

    def _leaning(self, part: Part) -> NDArray[np.bool_]:
        """[G] whether Gaussians belong to side windows, which lean inwards between the screens."""
        low, high = np.array(part.low), np.array(part.high)
        inwards = LEANING * self._size[1]
        low[1], high[1] = (low[1] - inwards, high[1]) if low[1] > 0 else (low[1], high[1] + inwards)
        high[0] = min(high[0], self._parts["windscreen"].low[0])
        if "rear window" in self._parts:
            low[0] = max(low[0], self._parts["rear window"].high[0])
        return replace(part, low=tuple(low), high=tuple(high)).holds(self._points)

    def _painted(self) -> NDArray[np.bool_]:
        """[G] whether a Gaussian is neither glass nor below the sills; all if none remains."""
        height = self._points[:, 2] / self._size[2] + 0.5
        painted: NDArray[np.bool_] = height > SILLS
        for part in self._parts.values():
            if part.kind in ("pane", "windscreen"):
                painted = painted & ~part.holds(self._points)
        return painted if painted.any() else np.ones(len(painted), dtype=bool)

    def _drooped(self, name: str, means: torch.Tensor, age: float) -> torch.Tensor:
        """A bumper that hangs by one end; the end varies between vehicles."""
        rows = self._rows[name]
        if not len(rows):
            return means
        places = means[rows].detach().cpu().numpy().astype(np.float64)
        side = 1.0 if (self._seed >> 3) % 2 else -1.0
        arm = places[:, 1] * side
        arm = arm - arm.min()
        fallen = 1 - np.exp(-3 * min(age, HANGS_STILL) / DROOP_TIME)
        sunk = np.tan(DROOP) * fallen * arm
        sunk = np.minimum(sunk, places[:, 2] + self._size[2] / 2 - CLEARANCE)
        sunk = np.maximum(sunk, 0.0)
        places[:, 2] -= sunk
        # The loose end also moves outwards.
        places[:, 0] += np.sign(places[:, 0].mean()) * LOOSE * sunk
        moved = means.clone()
        moved[rows] = torch.from_numpy(places.astype(np.float32)).to(means.device)
        return moved

    def _crazed(self, sh: torch.Tensor) -> torch.Tensor:
        """Cracks all over the screen, denser along rays."""
        rows = self._rows["windscreen"]
        if not len(rows):
            return sh
        points = self._points[rows]
        middle = points.mean(axis=0) + np.array([0.0, 0.2, 0.0])
        angle = np.arctan2(points[:, 2] - middle[2], points[:, 1] - middle[1])
        rays = 0.5 + 0.5 * np.cos(11 * angle + 2 * np.sin(3 * angle))
        random = np.random.default_rng(self._seed).uniform(size=len(rows))
        weight = np.where(random < CRAZED * (0.4 + rays), 0.65, 0.12)
        weights = torch.from_numpy(weight.astype(np.float32))[:, None, None].to(sh.device)
        target = torch.zeros_like(sh[rows])
        colour = torch.from_numpy(((CRACKED - 0.5) / SH_0).astype(np.float32)).to(sh.device)
        target[:, 0] = colour
        cracked = sh.clone()
        cracked[rows] = (1 - weights) * sh[rows] + weights * target
        return cracked


def _moved(displacements: Float) -> NDArray[np.bool_]:
    """[N] whether particles have moved by more than MIN_DISPLACEMENT."""
    moved: NDArray[np.bool_] = np.linalg.norm(displacements, axis=1) > MIN_DISPLACEMENT
    return moved


def _carried(rest: Float, displacements: Float) -> tuple[Float, Float]:
    """Robust rotation [3, 3] and translation [3] of particles [N, 3]; crushed ones weigh little."""
    places = rest + displacements
    weights = np.ones(len(rest))
    for _ in range(CARRIED_ROUNDS):
        share = (weights / weights.sum())[:, None]
        before, after = (share * rest).sum(axis=0), (share * places).sum(axis=0)
        left, _, right = np.linalg.svd((places - after).T @ (share * (rest - before)))
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        turn = left @ right
        shift = after - turn @ before
        off = np.linalg.norm(places - rest @ turn.T - shift, axis=1)
        weights = 1 / (off + CARRIED_SCALE)
    return turn, shift


def _without(body: Deformed, turn: Float, shift: Float) -> Deformed:
    """Points of a body without the rigid motion ``turn`` and ``shift``."""
    return Deformed((body.positions - shift) @ turn, turn.T @ body.F, turn.T @ body.rotations)


def _with(body: Deformed, turn: Float, shift: Float) -> Deformed:
    """Points of a body with the rigid motion ``turn`` and ``shift``."""
    return Deformed(body.positions @ turn.T + shift, turn @ body.F, turn @ body.rotations)


def _lit(sh: torch.Tensor, light: Float) -> torch.Tensor:
    """Harmonics with colours multiplied by ``light`` [G]."""
    factor = torch.from_numpy(light.astype(np.float32)).to(sh.device)
    lit = sh * factor[:, None, None]
    lit[:, 0] += ((factor - 1) * 0.5 / SH_0)[:, None]
    return lit


def _scraped(sh: torch.Tensor, rows: torch.Tensor, scraped: Float) -> torch.Tensor:
    """Harmonics with the paint of ``rows`` [R] scraped and smeared by ``scraped`` [R, 2]."""
    found = sh.clone()
    for colour, share in zip((BARE, SMEAR), scraped.T, strict=True):
        weight = torch.from_numpy(share.astype(np.float32))[:, None, None].to(sh.device)
        target = torch.zeros_like(found[rows])
        target[:, 0] = torch.from_numpy(((colour - 0.5) / SH_0).astype(np.float32)).to(sh.device)
        found[rows] = (1 - weight) * found[rows] + weight * target
    return found


def _split(cloud: GaussianCloud, changed: NDArray[np.int64], F: Float) -> GaussianCloud:
    """The cloud with strongly stretched Gaussians split in two, to avoid needles and gaps.

    F [R, 3, 3] belongs to the ``changed`` Gaussians [R].
    """
    stretch = np.linalg.norm(F, axis=1).max(axis=1)
    rows = torch.from_numpy(changed[stretch > SPLIT]).to(cloud.device)
    if not len(rows):
        return cloud
    part = cloud.select(rows)
    longest = part.scales.argmax(dim=1)
    axes = _axes(part.quats)
    each = torch.arange(len(rows), device=cloud.device)
    along = axes[each, :, longest] * part.scales[each, longest][:, None] * 0.6
    scales = part.scales.clone()
    scales[each, longest] *= 0.7
    means, sizes = cloud.means.clone(), cloud.scales.clone()
    means[rows], sizes[rows] = part.means + along, scales
    other = replace(part, means=part.means - along, scales=scales)
    return GaussianCloud.concatenate([replace(cloud, means=means, scales=sizes), other])


def _axes(quats: torch.Tensor) -> torch.Tensor:
    """[K, 3, 3] axes of Gaussians, as columns."""
    from ..geometry import quaternion_to_matrix

    matrices = quaternion_to_matrix(quats.detach().cpu().numpy())
    return torch.from_numpy(matrices.astype(np.float32)).to(quats.device)
