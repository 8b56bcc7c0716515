"""Curves that entities follow: polylines, clothoids, NURBS."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard_actions import (
    Clothoid,
    ClothoidPiece,
    ClothoidSpline,
    Curve,
    Nurbs,
    Polyline,
    Timing,
    WorldPosition,
)

from ..common import WorldError
from ..path import Float
from .roads import Place

SAMPLE = 0.1
"""Way between samples of clothoids and NURBS [m]; chords of theirs are off by 0.1 mm at curvatures
of 0.1 / m."""

MAX_SAMPLES = 100_000


@dataclass(frozen=True, eq=False)
class SampledCurve:
    """A curve as places along it.

    Attributes:
        s: [N] way from the start, not decreasing [m].
        x, y: [N] [m].
        h: [N] heading at each, continuous [rad].
        times: [N] when to be there [s], or None.
        turns: whether headings change between places; else each holds up to the next.
    """

    s: Float
    x: Float
    y: Float
    h: Float
    times: Float | None
    turns: bool

    @property
    def length(self) -> float:
        """From start to end [m]."""
        return float(self.s[-1])

    def at(self, s: float) -> Place:
        """The place at a way from the start."""
        x, y = float(np.interp(s, self.s, self.x)), float(np.interp(s, self.s, self.y))
        if self.turns:
            return Place(x, y, float(np.interp(s, self.s, self.h)))
        k = int(np.searchsorted(self.s, s, side="right")) - 1
        return Place(x, y, float(self.h[min(max(k, 0), len(self.h) - 1)]))

    def way_at(self, time: float) -> float:
        """Way from the start at a time; the curve has times."""
        assert self.times is not None
        return float(np.interp(time, self.times, self.s))

    def nearest(self, x: float, y: float) -> float:
        """Way from the start to where the curve is nearest to a place."""
        dx, dy = np.diff(self.x), np.diff(self.y)
        square = np.maximum(dx * dx + dy * dy, 1e-18)
        u = np.clip(((x - self.x[:-1]) * dx + (y - self.y[:-1]) * dy) / square, 0.0, 1.0)
        far = (self.x[:-1] + u * dx - x) ** 2 + (self.y[:-1] + u * dy - y) ** 2
        k = int(np.argmin(far))
        return float(self.s[k] + u[k] * (self.s[k + 1] - self.s[k]))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """An entity on a course; immutable.

    Attributes:
        token: of the action.
        course: that it follows.
        timing: how the course's times are meant; None: at the entity's own speed.
        s: way along it [m].
        elapsed: since it began, or since the simulation did [s].
    """

    token: int
    course: SampledCurve
    timing: Timing | None
    s: float
    elapsed: float

    def ahead(self, x: float, y: float) -> float:
        """How far ahead a place is along it [m]."""
        return self.course.nearest(x, y) - self.s

    def step(self, way: float, h: float) -> tuple[float, Trajectory | None]:
        """Way made in ``h`` seconds, by its times or as given, and itself then; None: at its
        end."""
        if self.timing is None:
            s = self.s + way
            over = s >= self.course.length - 1e-9
            return way, None if over else replace(self, s=s)
        elapsed = self.elapsed + h
        time = elapsed * float(self.timing.scale) + float(self.timing.offset)
        s = self.course.way_at(time)
        assert self.course.times is not None
        over = time >= self.course.times[-1] - 1e-9
        return s - self.s, None if over else replace(self, s=s, elapsed=elapsed)

    def begun(self) -> bool:
        """Whether its first time has come."""
        if self.timing is None or self.course.times is None:
            return True
        time = self.elapsed * float(self.timing.scale) + float(self.timing.offset)
        return bool(time >= self.course.times[0] - 1e-9)

    def place(self) -> Place:
        """Where the entity is."""
        return self.course.at(self.s)


def course_of(curve: Curve, resolve: Callable[[Any], Place]) -> SampledCurve:
    """The course of a curve, whose positions ``resolve`` turns into places.

    Raises:
        WorldError: INVALID_REQUEST, a curve that leads nowhere.
    """
    if isinstance(curve, Polyline):
        course = _polyline(curve, resolve)
    elif isinstance(curve, Clothoid):
        course = _clothoid(curve, resolve(curve.position))
    elif isinstance(curve, ClothoidSpline):
        course = _spline(curve.pieces, resolve(curve.position))
    else:
        course = _nurbs(curve, [resolve(p.position) for p in curve.points])
    if course.length <= 0.0 and course.times is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a trajectory has no length",
            hint="give places that differ",
        )
    return course


def _polyline(curve: Polyline, resolve: Callable[[Any], Place]) -> SampledCurve:
    places = [resolve(v.position) for v in curve.vertices]
    x, y = np.array([p.x for p in places]), np.array([p.y for p in places])
    times = np.array([float(v.time) for v in curve.vertices])
    if (np.diff(times) < 0).any():
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "times of a polyline decrease",
            hint="order its vertices by time",
        )
    steps = np.hypot(np.diff(x), np.diff(y))
    h = np.empty(len(x))
    first = next((k for k, step in enumerate(steps) if step > 1e-9), None)
    heading = places[0].h
    if first is not None:
        heading = math.atan2(y[first + 1] - y[first], x[first + 1] - x[first])
    for k, step in enumerate(steps):
        if step > 1e-9:
            heading = math.atan2(y[k + 1] - y[k], x[k + 1] - x[k])
        h[k] = heading
    h[-1] = heading
    return SampledCurve(np.concatenate([[0.0], np.cumsum(steps)]), x, y, h, times, turns=False)


def _clothoid(curve: Clothoid, start: Place) -> SampledCurve:
    length = float(curve.length)
    count = min(max(math.ceil(length / SAMPLE), 1), MAX_SAMPLES)
    s = np.linspace(0.0, length, count + 1)
    curvature, rate = float(curve.curvature), float(curve.curvature_rate)

    def heading(way: Float) -> Float:
        found: Float = start.h + curvature * way + rate * way * way / 2
        return found

    # Gauss-Legendre with three nodes a piece: exact to far below a micrometre.
    nodes, weights = np.polynomial.legendre.leggauss(3)
    step = length / count
    at = s[:-1, None] + step * (nodes + 1) / 2
    psi = heading(at)
    x = start.x + np.concatenate([[0.0], np.cumsum(np.cos(psi) @ weights) * step / 2])
    y = start.y + np.concatenate([[0.0], np.cumsum(np.sin(psi) @ weights) * step / 2])
    times = None
    if curve.start_time is not None and curve.stop_time is not None:
        times = np.linspace(float(curve.start_time), float(curve.stop_time), count + 1)
    return SampledCurve(s, x, y, heading(s), times, turns=True)


def _spline(pieces: Sequence[ClothoidPiece], start: Place) -> SampledCurve:
    parts, time = list[SampledCurve](), 0.0
    timed = all(piece.end_time is not None for piece in pieces)
    for piece in pieces:
        length = float(piece.length)
        rate = (float(piece.end) - float(piece.start)) / length
        end = float(piece.end_time) if timed and piece.end_time is not None else 0.0
        made = Clothoid(
            position=WorldPosition(x=0.0, y=0.0),
            curvature=piece.start,
            curvature_rate=rate,
            length=length,
            start_time=time if timed else None,
            stop_time=end if timed else None,
        )
        parts.append(_clothoid(made, start))
        start, time = parts[-1].at(length), end
    shifts = np.concatenate([[0.0], np.cumsum([part.length for part in parts])])
    first, rest = parts[0], parts[1:]

    def joined(name: str) -> Float:
        found: Float = np.concatenate([getattr(first, name), *(getattr(r, name)[1:] for r in rest)])
        return found

    s = np.concatenate(
        [first.s, *(r.s[1:] + shift for r, shift in zip(rest, shifts[1:], strict=False))]
    )
    times = joined("times") if timed else None
    return SampledCurve(s, joined("x"), joined("y"), joined("h"), times, turns=True)


def _nurbs(curve: Nurbs, places: list[Place]) -> SampledCurve:
    degree = curve.order - 1
    knots = np.array([float(k) for k in curve.knots])
    if (np.diff(knots) < 0).any():
        raise WorldError(ErrorCode.INVALID_REQUEST, "knots of a NURBS decrease", hint="order them")
    weights = np.array([float(p.weight) for p in curve.points])
    points = np.array([(p.x, p.y) for p in places]) * weights[:, None]
    homogeneous = np.column_stack([points, weights])
    timed = all(p.time is not None for p in curve.points)
    if timed:
        clock = np.array([float(p.time or 0.0) for p in curve.points])
        homogeneous = np.column_stack([homogeneous, clock * weights])
    outline = float(np.hypot(*np.diff([(p.x, p.y) for p in places], axis=0).T).sum())
    count = min(max(math.ceil(2 * outline / SAMPLE), 50), MAX_SAMPLES)
    values = np.linspace(knots[degree], knots[-degree - 1], count + 1)
    found = np.array([_de_boor(knots, homogeneous, degree, float(u)) for u in values])
    x, y = found[:, 0] / found[:, 2], found[:, 1] / found[:, 2]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    h = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    times = np.maximum.accumulate(found[:, 3] / found[:, 2]) if timed else None
    return SampledCurve(s, x, y, h, times, turns=True)


def _de_boor(knots: Float, points: Float, degree: int, u: float) -> Float:
    """A point of a B-spline (de Boor 1972)."""
    k = int(np.searchsorted(knots, u, side="right")) - 1
    k = min(max(k, degree), len(points) - 1)
    d = [points[j + k - degree] for j in range(degree + 1)]
    for r in range(1, degree + 1):
        for j in range(degree, r - 1, -1):
            low = knots[j + k - degree]
            span = knots[j + 1 + k - r] - low
            a = (u - low) / span if span > 0 else 0.0
            d[j] = (1.0 - a) * d[j - 1] + a * d[j]
    found: Float = d[degree]
    return found
