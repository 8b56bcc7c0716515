"""Lanes and roads of a map: areas, stop lines, signals, and the reference lines of roads.

A position on a road is (s, t): s along its reference line seen from above, t to its left [m].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.lanes import AreaKind, LaneKind, SignalKind

from ..geometry import Float
from .errors import SceneError

# Roads and their reference lines, as in OpenDRIVE and OpenSCENARIO.


@dataclass(frozen=True, eq=False)
class RoadLane:
    """A section of a numbered lane of a road.

    Attributes:
        number: number of the lane, negative to the right of the reference line, else positive.
        lane_id: the corresponding lane of the graph.
        s: [M] float64, increasing positions along the road [m], M >= 2.
        inner: [M] float64, t of the border towards the reference line [m].
        outer: [M] float64, t of the other border [m].
    """

    number: int
    lane_id: str
    s: Float
    inner: Float
    outer: Float

    def __post_init__(self) -> None:
        for name in ("s", "inner", "outer"):
            object.__setattr__(self, name, _column(getattr(self, name), f"lane {self.lane_id!r}"))
        if not len(self.s) == len(self.inner) == len(self.outer) >= 2:
            raise SceneError(
                f"lane {self.lane_id!r} of a road needs s, inner and outer of a length"
            )

    def centre_t(self, s: float) -> float:
        """t of the lane's centre at ``s`` [m], clamped to its ends."""
        inner, outer = np.interp(s, self.s, self.inner), np.interp(s, self.s, self.outer)
        return float(inner + outer) / 2

    def width(self, s: float) -> float:
        """Width at ``s`` [m]."""
        inner, outer = np.interp(s, self.s, self.inner), np.interp(s, self.s, self.outer)
        return float(abs(outer - inner))


@dataclass(frozen=True, eq=False)
class Road:
    """The reference line of a road, sampled with its directions.

    Samples are joined by cubics through positions and directions; arcs of 5 m radius sampled every
    0.5 m are accurate to 0.02 mm. Heights are linear in between.

    Attributes:
        road_id: unique in the graph.
        s: [N] float64, increasing positions [m] from 0, N >= 2.
        points: [N, 3] float64, world frame [m].
        headings: [N] float64, direction of increasing s [rad].
        rolls: [N] float64, superelevation: positive raises the left side [rad].
        lanes: sections of its lanes.
        junction: the junction that the road is part of, or None.
        drives_right: whether lanes with negative numbers run along s.
    """

    road_id: str
    s: Float
    points: Float
    headings: Float
    rolls: Float
    lanes: tuple[RoadLane, ...] = ()
    junction: str | None = None
    drives_right: bool = True

    def __post_init__(self) -> None:
        what = f"road {self.road_id!r}"
        for name in ("s", "headings", "rolls"):
            object.__setattr__(self, name, _column(getattr(self, name), what))
        points = np.array(self.points, dtype=np.float64)
        if points.shape != (len(self.s), 3) or not np.isfinite(points).all():
            raise SceneError(f"{what}: points must be finite [{len(self.s)}, 3]")
        if not len(self.s) == len(self.headings) == len(self.rolls) >= 2:
            raise SceneError(f"{what}: s, headings and rolls must be of one length of at least 2")
        if (np.diff(self.s) <= 0).any():
            raise SceneError(f"{what}: s must increase")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "lanes", tuple(self.lanes))

    @property
    def length(self) -> float:
        """Length of the reference line [m]."""
        return float(self.s[-1])

    def at(self, s: float, t: float = 0.0) -> tuple[float, float, float, float]:
        """x, y, z [m] and heading [rad] at (s, t); ``s`` is clamped to the road's length.

        The heading is the direction of the reference line, independent of the lane's direction.
        """
        x, y, z, heading = self.sample(np.array([s]), np.array([t]))[0].tolist()
        return x, y, z, heading

    def sample(self, s: ArrayLike, t: ArrayLike = 0.0) -> Float:
        """[K, 4] float64: x, y, z [m] and heading [rad] of positions (``s`` [K], ``t`` [K])."""
        s = np.clip(np.asarray(s, dtype=np.float64), self.s[0], self.s[-1])
        k = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        step = self.s[k + 1] - self.s[k]
        u = (s - self.s[k]) / step
        a, b = self.points[k, :2], self.points[k + 1, :2]
        chord = np.linalg.norm(b - a, axis=1)
        da, db = (chord[:, None] * _unit(self.headings[i]) for i in (k, k + 1))
        u1 = u[:, None]
        line = (
            (1 + 2 * u1) * (1 - u1) ** 2 * a
            + u1 * (1 - u1) ** 2 * da
            + u1**2 * (3 - 2 * u1) * b
            + u1**2 * (u1 - 1) * db
        )
        slope = 6 * u1 * (1 - u1) * (b - a) + (1 - 4 * u1 + 3 * u1**2) * da
        slope = slope + (3 * u1**2 - 2 * u1) * db
        z = (1 - u) * self.points[k, 2] + u * self.points[k + 1, 2]
        roll = (1 - u) * self.rolls[k] + u * self.rolls[k + 1]
        heading = np.arctan2(slope[:, 1], slope[:, 0])
        t = np.broadcast_to(np.asarray(t, dtype=np.float64), s.shape)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        places = line + (t * np.cos(roll))[:, None] * left
        return np.column_stack([places, z + t * np.sin(roll), heading])

    def lane(self, number: int, s: float) -> RoadLane:
        """The section of lane ``number`` at ``s`` [m]; the later one at a border.

        Raises:
            SceneError: the lane does not exist; the message lists the lanes.
        """
        there = [p for p in self.lanes if p.s[0] - 1e-6 <= s <= p.s[-1] + 1e-6]
        for part in reversed(there):
            if part.number == number:
                return part
        numbers = ", ".join(str(n) for n in sorted({p.number for p in there})) or "none"
        raise SceneError(
            f"road {self.road_id!r} has no lane {number} at s = {s:.2f} m (it is {self.length:.2f} "
            f"m long); lanes there: {numbers}"
        )

    def on_lane(
        self, number: int, s: float, offset: float = 0.0
    ) -> tuple[float, float, float, float]:
        """x, y, z [m] and heading [rad] of the centre of lane ``number`` at ``s``.

        Args:
            number: number of the lane.
            s: along the road [m].
            offset: offset to the left of the reference line's direction [m].

        Raises:
            SceneError: the road has no lane ``number`` at ``s``.
        """
        return self.at(s, self.lane(number, s).centre_t(s) + offset)

    def runs_along(self, number: int) -> bool:
        """Whether vehicles on lane ``number`` drive towards increasing s."""
        return (number < 0) == self.drives_right

    def project(self, x: float, y: float) -> tuple[float, float]:
        """(s, t) [m] of the position on the road nearest to (x, y), seen from above."""
        a, b = self.points[:-1, :2], self.points[1:, :2]
        d = b - a
        u = np.clip((([x, y] - a) * d).sum(axis=1) / np.maximum((d * d).sum(axis=1), 1e-12), 0, 1)
        k = int(np.argmin(np.linalg.norm(a + u[:, None] * d - [x, y], axis=1)))
        s = float(self.s[k] + u[k] * (self.s[k + 1] - self.s[k]))
        for _ in range(4):
            px, py, _, heading = self.at(s)
            along = (x - px) * np.cos(heading) + (y - py) * np.sin(heading)
            s = float(np.clip(s + along, self.s[0], self.s[-1]))
        px, py, _, heading = self.at(s)
        return s, float(-(x - px) * np.sin(heading) + (y - py) * np.cos(heading))

    def moved(self, yaw: float, shift: Float) -> Road:
        """The road rotated about the world's z axis by ``yaw`` [rad], then moved by ``shift``
        [3] [m]."""
        points = turned(self.points, yaw) + shift
        return replace(self, points=points, headings=self.headings + yaw)


def turned(points: Float, yaw: float) -> Float:
    """Points [N, 3] rotated about the z axis by ``yaw`` [rad]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    found: Float = points @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return found


def _unit(heading: Float) -> Float:
    return np.stack([np.cos(heading), np.sin(heading)], axis=1)


def _column(values: ArrayLike, what: str) -> NDArray[np.float64]:
    column = np.array(values, dtype=np.float64)
    if column.ndim != 1 or not np.isfinite(column).all():
        raise SceneError(f"{what}: holds values that are not finite numbers in a row")
    column.flags.writeable = False
    return column


LANE_KINDS: tuple[str, ...] = get_args(LaneKind)
AREA_KINDS: tuple[str, ...] = get_args(AreaKind)
SIGNAL_KINDS: tuple[str, ...] = get_args(SignalKind)
TRAVELLED: frozenset[str] = frozenset({"driving", "bus"})
"""Kinds of lanes that cars drive along."""
DRIVABLE: frozenset[str] = TRAVELLED | {"bicycle", "shoulder", "parking"}
"""Kinds of lanes with a surface that a car may use."""
SAME_PLACE_M = 1e-6


class LanePlace(NamedTuple):
    """A position in lane coordinates.

    Attributes:
        lane_id: the lane.
        s: arc length along its centre line, seen from above [m].
        offset: distance from it, positive to the left [m].
        heading: heading of the lane there [rad].
        inside: whether the position is between the lane's borders.
    """

    lane_id: str
    s: float
    offset: float
    heading: float
    inside: bool


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane, in its driving direction.

    Attributes:
        lane_id: unique in the graph.
        kind: type of the lane.
        centre: [N, 3] float64, centre line in the world [m], N >= 2, without repeated points.
        widths: [N] float64, across the centre line, half to each side [m], >= 0.
        speed_limit: [m/s], None if the map has none.
        successors: lanes that continue at its end.
        left, right: adjacent lanes of the same direction.
        opposite: adjacent lane to the left with the opposite direction.
        may_change_left, may_change_right: whether markings allow a change to those neighbours.
        junction: the junction that it crosses, or None.

    Raises:
        SceneError: invalid values; names the lane.
    """

    lane_id: str
    kind: LaneKind
    centre: Float
    widths: Float
    speed_limit: float | None = None
    successors: tuple[str, ...] = ()
    left: str | None = None
    right: str | None = None
    opposite: str | None = None
    may_change_left: bool = True
    may_change_right: bool = True
    junction: str | None = None

    def __post_init__(self) -> None:
        what = f"lane {self.lane_id!r}"
        centre = points_of(self.centre, what)
        widths = np.array(self.widths, dtype=np.float64)
        if self.kind not in LANE_KINDS:
            raise SceneError(f"{what}: kind {self.kind!r}; allowed: {', '.join(LANE_KINDS)}")
        if widths.shape != (len(centre),) or not (np.isfinite(widths) & (widths >= 0)).all():
            raise SceneError(f"{what}: widths must be {len(centre)} lengths from 0")
        if (np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1) < SAME_PLACE_M).any():
            raise SceneError(f"{what}: two points of its centre line share a place")
        limit = self.speed_limit
        if limit is not None and not (math.isfinite(limit) and limit > 0):
            raise SceneError(f"{what}: speed limit {limit!r} must be positive [m/s], or None")
        widths.flags.writeable = False
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "widths", widths)
        object.__setattr__(self, "successors", tuple(dict.fromkeys(self.successors)))

    @cached_property
    def s(self) -> Float:
        """[N] float64, arc length of each point of the centre line seen from above [m]."""
        steps = np.linalg.norm(np.diff(self.centre[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """Length of the centre line seen from above [m]."""
        return float(self.s[-1])

    @cached_property
    def headings(self) -> Float:
        """[N] float64, direction of the centre line at its points [rad], without jumps of 2 pi."""
        d = np.diff(self.centre[:, :2], axis=0)
        along = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
        steps = np.linalg.norm(d, axis=1)
        if len(along) == 1:
            return np.array([along[0], along[0]])
        # The direction at a point is the mean of its segments, weighted by inverse length.
        between = (along[:-1] * steps[1:] + along[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
        ends = np.array([2 * along[0] - between[0], 2 * along[-1] - between[-1]])
        return np.concatenate([ends[:1], between, ends[1:]])

    @property
    def turn(self) -> float:
        """Change of direction from start to end, positive left [rad]."""
        return float(self.headings[-1] - self.headings[0])

    @cached_property
    def rims(self) -> tuple[Float, Float]:
        """Left and right border, [N, 3] float64 each, at the points of the centre line [m]."""
        aside = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)
        half = np.zeros_like(self.centre)
        half[:, :2] = aside * (self.widths / 2)[:, None]
        return self.centre + half, self.centre - half

    def at(self, s: float, offset: float = 0.0) -> tuple[float, float, float, float]:
        """x, y, z [m] and heading [rad] at ``s``, ``offset`` to the left of the centre line.

        Before its start and past its end the lane continues straight.
        """
        x, y, z = (float(np.interp(s, self.s, self.centre[:, i])) for i in range(3))
        heading = float(np.interp(s, self.s, self.headings))
        beyond = min(s, 0.0) + max(s - self.length, 0.0)
        cos, sin = math.cos(heading), math.sin(heading)
        return x + beyond * cos - offset * sin, y + beyond * sin + offset * cos, z, heading

    def width(self, s: float) -> float:
        """Width at ``s`` [m]."""
        return float(np.interp(s, self.s, self.widths))

    def moved(self, yaw: float, shift: Float) -> Lane:
        """The lane rotated about the world's z axis by ``yaw`` [rad], then moved [m]."""
        return replace(self, centre=turned(self.centre, yaw) + shift)


@dataclass(frozen=True, eq=False)
class Area:
    """A marked part of the ground.

    Attributes:
        area_id: unique among the areas.
        kind: type of the area.
        outline: [N, 3] float64, corners of a simple polygon in the world [m], N >= 3.
    """

    area_id: str
    kind: AreaKind
    outline: Float

    def __post_init__(self) -> None:
        if self.kind not in AREA_KINDS:
            raise SceneError(
                f"area {self.area_id!r}: kind {self.kind!r}; allowed: {', '.join(AREA_KINDS)}"
            )
        outline = points_of(self.outline, f"area {self.area_id!r}", least=3)
        object.__setattr__(self, "outline", outline)


@dataclass(frozen=True, eq=False)
class StopLine:
    """A line at which vehicles stop.

    Attributes:
        stop_line_id: unique among the stop lines.
        points: [N, 3] float64, across the lanes [m], N >= 2.
        lanes: lanes with traffic that stops there.
    """

    stop_line_id: str
    points: Float
    lanes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        points = points_of(self.points, f"stop line {self.stop_line_id!r}")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "lanes", tuple(dict.fromkeys(self.lanes)))


@dataclass(frozen=True, eq=False)
class Signal:
    """A traffic light or sign.

    Attributes:
        signal_id: unique among the signals.
        kind: type of the signal.
        position: x, y, z in the world [m].
        heading: direction that its face looks in [rad].
        lanes: controlled lanes.
        stop_line: stop line of their traffic; None for the ends of the lanes.
        value: value of a speed limit [m/s], else None.
        group: the map's controller of a traffic light, or None.
    """

    signal_id: str
    kind: SignalKind
    position: tuple[float, float, float]
    heading: float = 0.0
    lanes: tuple[str, ...] = ()
    stop_line: str | None = None
    value: float | None = None
    group: str | None = None

    def __post_init__(self) -> None:
        what = f"signal {self.signal_id!r}"
        if self.kind not in SIGNAL_KINDS:
            raise SceneError(f"{what}: kind {self.kind!r}; allowed: {', '.join(SIGNAL_KINDS)}")
        numbers = (*self.position, self.heading, 0.0 if self.value is None else self.value)
        if len(self.position) != 3 or not all(math.isfinite(v) for v in numbers):
            raise SceneError(f"{what}: holds a number that is not finite")
        object.__setattr__(self, "position", tuple(float(v) for v in self.position))
        object.__setattr__(self, "lanes", tuple(dict.fromkeys(self.lanes)))


class StopLineAt(NamedTuple):
    """A stop line: centre [m] and heading of traffic [rad], world frame; half its width [m]."""

    x: float
    y: float
    heading: float
    half: float


def points_of(values: ArrayLike, what: str, *, least: int = 2) -> Float:
    """Finite, read-only points [N, 3], N >= ``least``.

    Raises:
        SceneError: invalid points; names ``what``.
    """
    points = np.array(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < least:
        raise SceneError(f"{what}: points must be [N, 3] with N >= {least}, not {points.shape}")
    if not (np.abs(points) < 1e7).all():
        raise SceneError(f"{what}: holds points that are not finite or beyond 10,000 km")
    points.flags.writeable = False
    return points
