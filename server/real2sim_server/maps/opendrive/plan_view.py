"""Reference lines of OpenDRIVE seen from above: line, arc, spiral, poly3, paramPoly3.

Source: ASAM OpenDRIVE 1.8.1, chapter 9. Cubic curves are measured by arc length, as s is.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import fresnel

from ...geometry.rotation import Float
from ..errors import MapError
from ..xml_files import number

MAX_LENGTH_M = 1e6
STRAIGHT = 1e-12
LEAST_BEND = 1e-9
"""A spiral whose heading bends less than this beyond an arc's, times its length, is an arc."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)

Local = Callable[[Float], Float]
"""From distances [K] along a piece to x, y and heading [K, 3] in the frame of its start."""


@dataclass(frozen=True)
class Piece:
    """One <geometry>.

    Attributes:
        s: where it starts on the road [m].
        length: of it [m].
        x, y, heading: pose of its start.
        local: its shape.
        bends: whether it is anything but a line.
    """

    s: float
    length: float
    x: float
    y: float
    heading: float
    local: Local
    bends: bool


@dataclass(frozen=True)
class PlanView:
    """The reference line of a road, closed form."""

    pieces: tuple[Piece, ...]

    @property
    def length(self) -> float:
        """Of all pieces [m]."""
        last = self.pieces[-1]
        return last.s + last.length

    def at(self, s: Float) -> Float:
        """x, y [m] and heading [rad], [K, 3], at places ``s`` [K] (held to the line)."""
        starts = np.array([piece.s for piece in self.pieces])
        index = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(starts) - 1)
        found = np.empty((len(s), 3))
        for k in np.unique(index).tolist():
            piece, mine = self.pieces[k], index == k
            u, v, turn = piece.local(np.clip(s[mine] - piece.s, 0.0, piece.length)).T
            cos, sin = math.cos(piece.heading), math.sin(piece.heading)
            found[mine, 0] = piece.x + cos * u - sin * v
            found[mine, 1] = piece.y + sin * u + cos * v
            found[mine, 2] = piece.heading + turn
        return found


def read_plan_view(road: ET.Element, where: str) -> PlanView:
    """The reference line of a <road>.

    Raises:
        MapError: without geometry, of a kind that OpenDRIVE does not have, or not in order.
    """
    pieces: list[Piece] = []
    for element in road.findall("planView/geometry"):
        s, x, y, heading = (number(element, n, where) for n in ("s", "x", "y", "hdg"))
        length = number(element, "length", where)
        if not 0 <= length <= MAX_LENGTH_M:
            raise MapError(f"{where}: geometry of length {length} m at s = {s}")
        if length < 1e-9:
            continue
        if pieces and s < pieces[-1].s:
            raise MapError(f"{where}: geometry at s = {s} follows one at s = {pieces[-1].s}")
        local, bends = _shape(element, length, f"{where}, geometry at s = {s}")
        pieces.append(Piece(s, length, x, y, heading, local, bends))
    if not pieces:
        raise MapError(f"{where}: has no <planView> with a <geometry> that has a length")
    return PlanView(tuple(pieces))


def _shape(element: ET.Element, length: float, where: str) -> tuple[Local, bool]:
    kinds: dict[str, Callable[[ET.Element], Local]] = {
        "line": lambda e: line(),
        "arc": lambda e: arc(number(e, "curvature", where)),
        "spiral": lambda e: spiral(
            number(e, "curvStart", where), number(e, "curvEnd", where), length
        ),
        "poly3": lambda e: _poly3(e, length, where),
        "paramPoly3": lambda e: _param_poly3(e, length, where),
    }
    for child in element:
        if child.tag in kinds:
            return kinds[child.tag](child), child.tag != "line"
    given = ", ".join(child.tag for child in element) or "nothing"
    raise MapError(f"{where}: holds {given}; known shapes are {', '.join(kinds)}")


def line() -> Local:
    """A straight line."""
    return lambda d: np.stack([d, np.zeros_like(d), np.zeros_like(d)], axis=1)


def arc(curvature: float) -> Local:
    """A circle's arc of ``curvature`` [1/m], positive to the left."""
    if abs(curvature) < STRAIGHT:
        return line()

    def local(d: Float) -> Float:
        turn = curvature * d
        # Chord and half angle: exact for the flattest arcs as well.
        chord = d * np.sinc(turn / (2 * np.pi))
        return np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)

    return local


def spiral(start: float, end: float, length: float) -> Local:
    """A clothoid whose curvature goes linearly from ``start`` to ``end`` [1/m].

    Its place is the integral of (cos, sin)(k d + c d^2 / 2): with the square completed, Fresnel
    integrals.
    """
    change = (end - start) / length
    if abs(change) * length**3 < LEAST_BEND:
        return arc((start + end) / 2)
    scale = math.sqrt(math.pi / abs(change))
    sign = math.copysign(1.0, change)
    # Of a curve with positive change of curvature; the other is its mirror image.
    k, c = sign * start, abs(change)
    rest = k * k / (2 * c)
    sin0, cos0 = fresnel(k / (c * scale))

    def local(d: Float) -> Float:
        sin1, cos1 = fresnel((d + k / c) / scale)
        p, q = scale * (cos1 - cos0), scale * (sin1 - sin0)
        cos, sin = math.cos(rest), math.sin(rest)
        x, y = cos * p + sin * q, cos * q - sin * p
        return np.stack([x, sign * y, start * d + change * d * d / 2], axis=1)

    return local


def cubic(u: tuple[float, ...], v: tuple[float, ...], end: float, length: float) -> Local:
    """The curve (u(p), v(p)) of two cubics for p from 0 to ``end``, by its arc length; ``length``
    of the road goes to its whole, so that pieces meet where their files say."""
    grid = np.linspace(0.0, end, 257)
    du, dv = (np.polynomial.Polynomial(w).deriv() for w in (u, v))
    step = grid[1] - grid[0]
    p = grid[:-1, None] + step * (NODES + 1) / 2
    arcs = np.concatenate([[0.0], np.cumsum(np.hypot(du(p), dv(p)) @ WEIGHTS * step / 2)])
    total = arcs[-1]

    def local(d: Float) -> Float:
        wanted = d / length * total
        p = np.interp(wanted, arcs, grid)
        k = np.clip(np.searchsorted(arcs, wanted, side="right") - 1, 0, len(grid) - 2)
        for _ in range(3):  # Newton from within a 256th of the curve
            half = (p - grid[k]) / 2
            nodes = grid[k][:, None] + half[:, None] * (NODES + 1)
            passed = arcs[k] + np.hypot(du(nodes), dv(nodes)) @ WEIGHTS * half
            speed = np.maximum(np.hypot(du(p), dv(p)), 1e-12)
            p = np.clip(p + (wanted - passed) / speed, grid[k], grid[k + 1])
        pu, pv = (np.polynomial.Polynomial(w)(p) for w in (u, v))
        return np.stack([pu, pv, np.arctan2(dv(p), du(p))], axis=1)

    return local


def _poly3(element: ET.Element, length: float, where: str) -> Local:
    v = tuple(number(element, name, where) for name in "abcd")
    if max(abs(w) for w in v) > 1e6:
        raise MapError(f"{where}: poly3 with a coefficient above a million")
    slope = np.polynomial.Polynomial(v).deriv()
    # How far along u the curve is as long as its piece; arc length is never below the chord.
    grid = np.linspace(0.0, length, 4097)
    middle = (grid[1:] + grid[:-1]) / 2
    passed = np.concatenate([[0.0], np.cumsum(np.hypot(1.0, slope(middle)) * np.diff(grid))])
    end = float(np.interp(length, passed, grid))
    return cubic((0.0, 1.0), v, end, length)


def _param_poly3(element: ET.Element, length: float, where: str) -> Local:
    u, v = (tuple(number(element, name + axis, where) for name in "abcd") for axis in ("U", "V"))
    if max(abs(w) for w in (*u, *v)) > 1e6:
        raise MapError(f"{where}: paramPoly3 with a coefficient above a million")
    ranges = {"arcLength": length, "normalized": 1.0}
    given = element.get("pRange", "normalized")
    if given not in ranges:
        raise MapError(f"{where}: pRange {given!r}; allowed: {', '.join(ranges)}")
    curve = cubic(u, v, ranges[given], length)
    if not np.isfinite(curve(np.array([0.0, length]))).all():
        raise MapError(f"{where}: paramPoly3 that is no curve: all of its coefficients are zero")
    return curve
