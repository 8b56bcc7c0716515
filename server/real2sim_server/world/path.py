"""The recorded path of the ego: the reference for route distances and lateral offsets."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from .._numba import kernel
from ..geometry import quaternion_to_matrix, quaternion_yaw
from ..scene import Trajectory

KNOT = 11

NEAR_BEHIND, NEAR_AHEAD = 20.0, 60.0
"""Range along the path that is searched first, relative to the last position [m]."""

LOST = 10.0
"""Distance from the path beyond which the whole path is searched [m]."""

PIECE = 4.0
"""Length of the segments for curvature [m]."""

REACH = 80
"""Search range for the leading object [m], in points one metre apart."""

SIDE = 0.3
"""Lateral clearance of a box that counts as blocked [m]."""


@kernel
def nearest_point(knots, x, y, near_s):
    """The nearest point of the path to (x, y) [m].

    Args:
        knots: see above.
        x, y: world frame [m].
        near_s: distance along the path at which to start the search [m]; NaN for none.

    Returns:
        Distance along the path [m], lateral offset, positive left [m], position (x, y, z) [m],
        heading [rad] and unit normal of the floor. Beyond its ends the path continues straight.
    """
    segments = len(knots) - 1
    k, f, offset = 0, 0.0, math.inf
    if not math.isnan(near_s):
        first = max(_first_not_before(knots, near_s - NEAR_BEHIND) - 1, 0)
        last = min(max(_first_not_before(knots, near_s + NEAR_AHEAD), first + 1), segments)
        k, f, offset = _foot(knots, x, y, first, last)
    if not abs(offset) <= LOST:
        k, f, offset = _foot(knots, x, y, 0, segments)
    a, b, rest = knots[k], knots[k + 1], 1.0 - f
    if (k == 0 and f == 0.0) or (k == segments - 1 and f == 1.0):
        offset = ((x - a[1]) * a[9] + (y - a[2]) * a[8]) * math.sqrt(a[10])
    ux, uy, uz = (
        rest * a[5] + f * b[5],
        rest * a[6] + f * b[6],
        rest * a[7] + f * b[7],
    )
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    return (
        rest * a[0] + f * b[0],
        offset,
        (
            rest * a[1] + f * b[1],
            rest * a[2] + f * b[2],
            rest * a[3] + f * b[3],
        ),
        rest * a[4] + f * b[4],
        (ux / length, uy / length, uz / length),
    )


@kernel
def waypoints(knots, s, pose, count, spacing):
    """Waypoints along the path, vehicle frame; beyond its end the path continues straight.

    Args:
        knots: see above.
        s: start distance along the path [m].
        pose: x, y [m], yaw [rad] of the vehicle, world frame.
        count: number of waypoints.
        spacing: distance between waypoints, and from ``s`` to the first [m].

    Returns:
        [count, 2] float64 in the vehicle frame [m].
    """
    x, y, yaw = pose
    end = knots[len(knots) - 1]
    ahead_x, ahead_y = math.cos(end[4]), math.sin(end[4])
    cos, sin = math.cos(yaw), math.sin(yaw)
    found = np.empty((count, 2))
    for i in range(count):
        at = s + spacing * (i + 1)
        beyond = max(at - end[0], 0.0)
        dx = _along(knots, at, 1) + beyond * ahead_x - x
        dy = _along(knots, at, 2) + beyond * ahead_y - y
        found[i, 0], found[i, 1] = cos * dx + sin * dy, cos * dy - sin * dx
    return found


@kernel
def turn_between(knots, here, there):
    """Change of heading [rad] between two distances along the path [m]."""
    return _along(knots, there, 4) - _along(knots, here, 4)


@kernel
def point_at(knots, s):
    """The point x, y, z [m] and heading [rad] at distance ``s`` [m].

    Before its start and beyond its end the path continues straight.
    """
    yaw = _along(knots, s, 4)
    beyond = s - min(max(s, 0.0), knots[len(knots) - 1, 0])
    return (
        _along(knots, s, 1) + beyond * math.cos(yaw),
        _along(knots, s, 2) + beyond * math.sin(yaw),
        _along(knots, s, 3),
        yaw,
    )


@kernel
def sharpest_turn(knots, s, reach):
    """Largest curvature [1/m] of the path over the next ``reach`` metres, in pieces of 4 m."""
    most, before = 0.0, _along(knots, s, 4)
    for k in range(1, math.ceil(max(reach, 8.0) / PIECE) + 1):
        now = _along(knots, s + PIECE * k, 4)
        most, before = max(most, abs(now - before)), now
    return most / PIECE


@kernel
def next_in_strip(knots, s, box, bodies, own):
    """The next body ahead in the strip that a box sweeps along the path.

    Bodies whose centres are alongside or behind the centre of the box are ignored.

    Args:
        knots: see above.
        s: distance of the box centre along the path [m].
        box: lateral offset from the path, length and width of the box [m].
        bodies: [B, 7] float64: centre x, y [m], yaw [rad], length, width [m], velocity x, y [m/s].
        own: row of the box itself.

    Returns:
        Bumper-to-bumper gap [m], infinite if there is no body, and its speed along the path
        [m/s].
    """
    offset, length, width = box
    strip = strip_ahead(knots, s, offset)
    gap, speed = math.inf, 0.0
    for k in range(len(bodies)):
        if k == own:
            continue
        body = bodies[k]
        i = _nearest_row(strip, body[0], body[1])
        dx, dy, heading = body[0] - strip[i, 0], body[1] - strip[i, 1], strip[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        along, aside = i + dx * cos + dy * sin, dy * cos - dx * sin
        if along <= 0.5 or i == REACH - 1:
            continue
        c, n = abs(math.cos(body[2] - heading)), abs(math.sin(body[2] - heading))
        if abs(aside) >= width / 2 + (body[3] * n + body[4] * c) / 2 + SIDE:
            continue
        free = along - length / 2 - (body[3] * c + body[4] * n) / 2
        if free < gap:
            gap, speed = free, body[5] * cos + body[6] * sin
    return gap, speed


@kernel
def previous_in_strip(knots, s, box, bodies, own):
    """The next body behind or alongside a box in the strip that it sweeps along the path.

    Args:
        knots, s, box, bodies, own: see :func:`next_in_strip`.

    Returns:
        Gap from its front to the rear of the box [m], negative if they overlap along the path,
        infinite if there is no body; and its speed along the path [m/s].
    """
    offset, length, width = box
    back = REACH - 1
    strip = strip_ahead(knots, s - back, offset)
    gap, speed = math.inf, 0.0
    for k in range(len(bodies)):
        if k == own:
            continue
        body = bodies[k]
        i = _nearest_row(strip, body[0], body[1])
        dx, dy, heading = body[0] - strip[i, 0], body[1] - strip[i, 1], strip[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        along, aside = i - back + dx * cos + dy * sin, dy * cos - dx * sin
        if along > 0.5 or i == 0:
            continue
        c, n = abs(math.cos(body[2] - heading)), abs(math.sin(body[2] - heading))
        if abs(aside) >= width / 2 + (body[3] * n + body[4] * c) / 2 + SIDE:
            continue
        free = -along - length / 2 - (body[3] * c + body[4] * n) / 2
        if free < gap:
            gap, speed = free, body[5] * cos + body[6] * sin
    return gap, speed


@kernel
def strip_ahead(knots, s, offset):
    """Points [REACH, 3] x, y [m], heading [rad], every metre from ``s``, ``offset`` to the left.

    Same results as :func:`point_at`, without a search per point.
    """
    found = np.empty((REACH, 3))
    end, after = knots[len(knots) - 1, 0], _first_not_before(knots, s)
    for i in range(REACH):
        at = s + i
        while after < len(knots) and knots[after, 0] < at:
            after += 1
        x, y, yaw = (
            _between(knots, after, at, 1),
            _between(knots, after, at, 2),
            _between(knots, after, at, 4),
        )
        beyond = at - min(max(at, 0.0), end)
        if beyond != 0.0 or offset != 0.0:
            cos, sin = math.cos(yaw), math.sin(yaw)
            x, y = x + beyond * cos, y + beyond * sin
            x, y = x - offset * sin, y + offset * cos
        found[i, 0], found[i, 1], found[i, 2] = x, y, yaw
    return found


@kernel
def _nearest_row(strip, x, y):
    nearest, least = 0, math.inf
    for i in range(len(strip)):
        dx, dy = x - strip[i, 0], y - strip[i, 1]
        if dx * dx + dy * dy < least:
            nearest, least = i, dx * dx + dy * dy
    return nearest


@kernel
def _first_not_before(knots, s):
    """Index of the first pose at distance ``s`` or farther; the number of poses if none is."""
    low, high = 0, len(knots)
    while low < high:
        middle = (low + high) // 2
        if knots[middle, 0] < s:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _along(knots, s, column):
    """A column of the path at distance ``s``, linear between poses, constant beyond both ends."""
    return _between(knots, _first_not_before(knots, s), s, column)


@kernel
def _between(knots, after, s, column):
    """Like :func:`_along`, with the index ``after`` of the first pose at ``s`` or farther."""
    if after == 0:
        return knots[0, column]
    if after == len(knots):
        return knots[after - 1, column]
    a, b = knots[after - 1], knots[after]
    return a[column] + (b[column] - a[column]) / (b[0] - a[0]) * (s - a[0])


@kernel
def _foot(knots, x, y, first, last):
    """Nearest segment in [first, last), fraction along it, and offset, positive left [m]."""
    nearest, least, fraction, left = first, math.inf, 0.0, 0.0
    for k in range(first, last):
        dx, dy = x - knots[k, 1], y - knots[k, 2]
        along = dx * knots[k, 8] - dy * knots[k, 9]
        across = dx * knots[k, 9] + dy * knots[k, 8]
        foot = min(max(along, 0.0), 1.0)
        beyond = along - foot
        square = (beyond * beyond + across * across) * knots[k, 10]
        if square < least:
            nearest, least, fraction, left = k, square, foot, across
    return nearest, fraction, math.copysign(math.sqrt(least), left)


Float = NDArray[np.float64]

SPACING = 0.05
"""Minimum distance between logged poses [m]; closer ones only add noise."""

STUB = 1.0
"""Length of the path of a vehicle that never moved, along its heading [m]."""


class PathPoint(NamedTuple):
    """Nearest point of the path to a position.

    Attributes:
        s: distance from the start of the path [m].
        offset: lateral offset of the position from the path, positive left [m]; beyond its ends
            the path continues straight.
        position: the path point, world frame [m].
        yaw: heading of the recorded vehicle there [rad].
        up: unit normal of the recorded vehicle's floor there, world frame.
    """

    s: float
    offset: float
    position: tuple[float, float, float]
    yaw: float
    up: tuple[float, float, float]


class LoggedPath:
    """Logged ego poses by distance travelled.

    Attributes:
        s: [P] float64, distance of each pose from the start, increasing [m].
        positions: [P, 3] float64, world [m].
        yaws: [P] float64, heading, continuous (not wrapped) [rad].
        ups: [P, 3] float64, unit floor normals.
        knots: [P, 11] float64, in the layout that the kernels above read.
    """

    def __init__(self, ego: Trajectory) -> None:
        kept = _apart(ego.positions)
        positions = ego.positions[kept]
        yaws: Float = np.unwrap(quaternion_yaw(ego.quaternions[kept]))
        ups: Float = quaternion_to_matrix(ego.quaternions[kept])[:, :, 2]
        if len(kept) == 1:
            ahead = STUB * np.array([np.cos(yaws[0]), np.sin(yaws[0]), 0.0])
            positions = np.stack([positions[0], positions[0] + ahead])
            yaws, ups = np.repeat(yaws, 2), np.repeat(ups, 2, axis=0)
        self._measure(positions, yaws, ups)

    def _measure(self, positions: Float, yaws: Float, ups: Float) -> None:
        self.positions, self.yaws, self.ups = positions, yaws, ups
        plane = self.positions[:, 0] + 1j * self.positions[:, 1]
        steps = np.diff(plane)
        lengths = np.abs(steps)
        turns = steps.conj() / lengths**2
        self.s: Float = np.concatenate([[0.0], np.cumsum(lengths)])
        self.knots: Float = np.zeros((len(self.s), KNOT))
        self.knots[:, 0], self.knots[:, 1:4] = self.s, self.positions
        self.knots[:, 4], self.knots[:, 5:8] = self.yaws, self.ups
        self.knots[:-1, 8], self.knots[:-1, 9] = turns.real, turns.imag
        self.knots[:-1, 10] = lengths**2

    @classmethod
    def through(cls, positions: Float, yaws: Float, ups: Float) -> Self:
        """The path through positions [P, 3] [m], P >= 2.

        Headings [P] [rad] must be continuous; floor normals [P, 3] are unit vectors. Positions less
        than 5 cm from their predecessor are dropped.
        """
        made = cls.__new__(cls)
        kept = _apart(positions)
        made._measure(positions[kept], yaws[kept], ups[kept])
        return made

    def beside(self, offset: float, *, reverse: bool = False) -> Self:
        """The path ``offset`` metres to the left of this one, optionally in reverse direction."""
        left = np.stack([-np.sin(self.yaws), np.cos(self.yaws), np.zeros(len(self.yaws))], axis=1)
        positions, yaws, ups = self.positions + offset * left, self.yaws, self.ups
        if reverse:
            positions, yaws, ups = positions[::-1], yaws[::-1] + np.pi, ups[::-1]
        return self.through(positions, yaws, ups)

    @property
    def length(self) -> float:
        """Distance from start to end [m]."""
        return float(self.s[-1])

    def at(self, s: float) -> tuple[float, float, float, float]:
        """The point x, y, z [m] and heading [rad] at distance ``s`` [m]; see :func:`point_at`."""
        x, y, z, yaw = point_at(self.knots, float(s))
        return x, y, z, yaw

    def sharpest_turn(self, s: float, reach: float) -> float:
        """Largest curvature [1/m] over the ``reach`` metres from ``s`` on, in pieces of 4 m."""
        return float(sharpest_turn(self.knots, float(s), float(reach)))

    def nearest(self, x: float, y: float, *, near_s: float | None = None) -> PathPoint:
        """The nearest point of the path to (x, y).

        Args:
            x, y: world frame [m].
            near_s: last distance of the vehicle along the path. It keeps the result on the same
                branch of a self-crossing path while the vehicle is within 10 m of that branch.
        """
        around = math.nan if near_s is None else near_s
        return PathPoint(*nearest_point(self.knots, float(x), float(y), around))


def _apart(positions: Float) -> list[int]:
    """Indices of poses at least SPACING from the last selected one, in the plane."""
    kept = [0]
    x, y = positions[0, :2].tolist()
    for i, (px, py) in enumerate(positions[:, :2].tolist()):
        if (px - x) ** 2 + (py - y) ** 2 >= SPACING**2:
            kept.append(i)
            x, y = px, py
    return kept


# --- Loops ---------------------------------------------------------------------------------------


class LoopTransform(NamedTuple):
    """Transform from world positions before a loop reset to the equivalent ones after it.

    Attributes:
        x, y: shift after the rotation [m].
        turn: rotation about the world origin [rad].
    """

    x: float
    y: float
    turn: float

    @classmethod
    def between(
        cls, before: tuple[float, float, float], after: tuple[float, float, float]
    ) -> LoopTransform:
        """The transform from pose ``before`` (x, y [m], yaw [rad]) to pose ``after``."""
        turn = after[2] - before[2]
        cos, sin = math.cos(turn), math.sin(turn)
        x = after[0] - cos * before[0] + sin * before[1]
        return cls(x, after[1] - sin * before[0] - cos * before[1], turn)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Transform a position [m]."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return cos * x - sin * y + self.x, sin * x + cos * y + self.y

    def poses(self, poses: Float) -> Float:
        """Transform poses [N, 3] of x, y [m], yaw [rad]."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        x, y, yaw = poses.T
        return np.column_stack(
            [cos * x - sin * y + self.x, sin * x + cos * y + self.y, yaw + self.turn]
        )


# --- Route ---------------------------------------------------------------------------------------

ROUTE_SPACING, ROUTE_POINTS = 1.0, 4096
"""Point spacing of a whole route [m], and its maximum number of points."""

Command = Literal["straight", "left", "right"]

WAYPOINTS = 20
WAYPOINT_SPACING = 2.0
"""Distance along the path between waypoints, and to the first one [m]."""

COMMAND_AHEAD = 25.0
"""Distance ahead at which the heading determines the command [m]."""

TURN = 0.35
"""Minimum change of heading that counts as a turn [rad]."""


def route_ahead(path: LoggedPath, s: float, x: float, y: float, yaw: float) -> Float:
    """Waypoints [20, 2] along the path ahead of distance ``s``, vehicle frame [m].

    Beyond the end of the recording the route continues straight.

    Args:
        path: the recorded path.
        s: position of the vehicle along it [m].
        x, y, yaw: vehicle pose, world frame [m], [rad].
    """
    found: Float = waypoints(path.knots, s, (x, y, yaw), WAYPOINTS, WAYPOINT_SPACING)
    return found


def whole_route(path: LoggedPath) -> Float:
    """[N, 4] float64, x, y, z [m] and heading [rad] along a path from its start to its end."""
    count = min(max(round(path.length / ROUTE_SPACING), 1), ROUTE_POINTS - 1) + 1
    return np.array([path.at(s) for s in np.linspace(0.0, path.length, count).tolist()])


def command_ahead(path: LoggedPath, s: float) -> Command:
    """Turn direction of the path over the next 25 m."""
    turn = turn_between(path.knots, s, s + COMMAND_AHEAD)
    if turn > TURN:
        return "left"
    return "right" if turn < -TURN else "straight"
