"""Planar box contact: manifolds, impulses, impacts of finite duration, and obstacles."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ...scene import Scene
from ...scene.ground import OBSTACLE_CELL, occupied_cells
from ..path import Float, LoggedPath
from .bodies import BodyProperties, BodyState

Corner = tuple[float, float]

SLOW = 0.3
"""Approach speed below which there is no rebound [m/s]."""


class ContactManifold(NamedTuple):
    """Overlap of two bodies.

    Attributes:
        x, y: centroid of the overlap [m].
        nx, ny: unit normal, out of the second body into the first.
        depth: penetration depth along the normal [m].
    """

    x: float
    y: float
    nx: float
    ny: float
    depth: float


class ContactImpulse(NamedTuple):
    """An impulse on the first body [N s], and the closing speed [m/s]."""

    jx: float
    jy: float
    approach: float


Body = tuple[BodyState, BodyProperties]
Bodies = tuple[Body, Body | None]
"""Two bodies in contact; None for an immovable one."""


class RelativeMotion(NamedTuple):
    """Relative motion of two bodies at a point, and its response to impulses there.

    Attributes:
        nx, ny: unit normal, out of the second body into the first.
        normal, tangent: velocity of the first body relative to the second [m/s].
        knn, knt, ktt: velocity change per impulse [1/kg].
    """

    nx: float
    ny: float
    normal: float
    tangent: float
    knn: float
    knt: float
    ktt: float

    def limited(self, push: float, friction: float) -> ContactImpulse:
        """An impulse with normal part ``push`` [N s] and Coulomb friction.

        The tangential part stops sliding, up to ``friction`` times the normal part.
        """
        jt = -(self.tangent + self.knt * push) / self.ktt
        jt = min(max(jt, -friction * push), friction * push)
        nx, ny = self.nx, self.ny
        return ContactImpulse(push * nx - jt * ny, push * ny + jt * nx, -self.normal)

    def normal_part(self, impulse: ContactImpulse) -> float:
        """Normal part of an impulse [N s]."""
        return impulse.jx * self.nx + impulse.jy * self.ny


def relative_motion(bodies: Bodies, manifold: ContactManifold) -> RelativeMotion:
    """Relative motion of two bodies at a contact."""
    nx, ny, tx, ty = manifold.nx, manifold.ny, -manifold.ny, manifold.nx
    vx = vy = knn = knt = ktt = 0.0
    for sign, pair in zip((1.0, -1.0), bodies, strict=True):
        if pair is None:
            continue
        body, properties = pair
        wx, wy = body.velocity_at(manifold.x, manifold.y)
        vx, vy = vx + sign * wx, vy + sign * wy
        rx, ry = manifold.x - body.x, manifold.y - body.y
        rn, rt = rx * ny - ry * nx, rx * ty - ry * tx
        knn += 1 / properties.mass + rn * rn / properties.inertia
        ktt += 1 / properties.mass + rt * rt / properties.inertia
        knt += rn * rt / properties.inertia
    return RelativeMotion(nx, ny, vx * nx + vy * ny, vx * tx + vy * ty, knn, knt, ktt)


def overlap_patch(
    first: list[Corner], second: list[Corner], nx: float, ny: float
) -> tuple[float, float, float, float] | None:
    """Centroid x, y, mean depth along the normal and width across it of an overlap [m].

    The overlap is that of two convex quadrilaterals; None without overlap.
    """
    return patch_of(overlap_shape(first, second), nx, ny)


def patch_of(shape: list[Corner], nx: float, ny: float) -> tuple[float, float, float, float] | None:
    """Like :func:`overlap_patch`, for a given overlap polygon."""
    if len(shape) < 3:
        return None
    x0, y0 = shape[0]
    double = mx = my = 0.0
    for (ax, ay), (bx, by) in itertools.pairwise(shape[1:]):
        part = (ax - x0) * (by - y0) - (bx - x0) * (ay - y0)
        double += part
        mx, my = mx + part * (ax + bx - 2 * x0), my + part * (ay + by - 2 * y0)
    low, high = span_across(shape, nx, ny)
    width = high - low
    if double <= 1e-12 or width <= 0.0:
        return None
    return x0 + mx / (3 * double), y0 + my / (3 * double), double / 2 / width, width


def overlap_span(
    first: list[Corner], second: list[Corner], nx: float, ny: float
) -> tuple[float, float]:
    """Interval of the overlap of two quadrilaterals across a unit normal [m]."""
    return span_across(overlap_shape(first, second), nx, ny)


def span_across(shape: list[Corner], nx: float, ny: float) -> tuple[float, float]:
    """Interval of a shape across a unit normal [m]."""
    across = [y * nx - x * ny for x, y in shape]
    return min(across), max(across)


def corners(body: BodyState, properties: BodyProperties) -> list[Corner]:
    """Corners of the body's box, counter-clockwise."""
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    cx, cy = body.x + properties.box_ahead * cos, body.y + properties.box_ahead * sin
    a, b = properties.length / 2, properties.width / 2
    return [
        (cx + u * cos - v * sin, cy + u * sin + v * cos)
        for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))
    ]


def contact_manifold(first: list[Corner], second: list[Corner]) -> ContactManifold | None:
    """The contact manifold of two convex quadrilaterals; None without overlap.

    The normal is the edge normal of least penetration (separating axes); the point is the centroid
    of the overlap.
    """
    best: tuple[float, float, float] | None = None
    for shape, outward in ((second, 1.0), (first, -1.0)):
        for k in range(4):
            (ax, ay), (bx, by) = shape[k], shape[(k + 1) % 4]
            length = math.hypot(bx - ax, by - ay)
            nx, ny = (by - ay) / length, (ax - bx) / length
            other = first if shape is second else second
            depth = -min((x - ax) * nx + (y - ay) * ny for x, y in other)
            if depth <= 0.0:
                return None
            if best is None or depth < best[0]:
                best = (depth, nx * outward, ny * outward)
    assert best is not None
    depth, nx, ny = best
    overlap = overlap_shape(first, second)
    if not overlap:
        return None
    x = sum(p[0] for p in overlap) / len(overlap)
    y = sum(p[1] for p in overlap) / len(overlap)
    return ContactManifold(x, y, nx, ny, depth)


def overlap_shape(subject: list[Corner], clip: list[Corner]) -> list[Corner]:
    """Corners of the overlap of two convex quadrilaterals (Sutherland & Hodgman 1974)."""
    shape = subject
    for k in range(4):
        (ax, ay), (bx, by) = clip[k], clip[(k + 1) % 4]
        inside = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in shape]
        kept: list[Corner] = []
        for i, (p, d) in enumerate(zip(shape, inside, strict=True)):
            q, e = shape[(i + 1) % len(shape)], inside[(i + 1) % len(shape)]
            if d >= 0:
                kept.append(p)
            if (d >= 0) != (e >= 0):
                t = d / (d - e)
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        shape = kept
        if not shape:
            return []
    return shape


def contact_impulse(
    first: tuple[BodyState, BodyProperties],
    second: tuple[BodyState, BodyProperties] | None,
    manifold: ContactManifold,
    *,
    restitution: float,
    friction: float,
) -> ContactImpulse | None:
    """The impulse of a planar impact; None if the bodies are already separating.

    Newton's restitution along the normal; the tangential impulse stops sliding, limited by friction
    times the normal impulse (Brach & Brach 2011, Vehicle Accident Analysis and Reconstruction
    Methods, ch. 6).

    Args:
        first, second: bodies before the impact; None for an immovable body.
        manifold: point and normal.
        restitution: separation speed over approach speed; 0 for slow approaches.
        friction: friction coefficient.
    """
    nx, ny, tx, ty = manifold.nx, manifold.ny, -manifold.ny, manifold.nx
    vx, vy = first[0].velocity_at(manifold.x, manifold.y)
    pairs = [first]
    if second is not None:
        wx, wy = second[0].velocity_at(manifold.x, manifold.y)
        vx, vy = vx - wx, vy - wy
        pairs.append(second)
    normal, tangent = vx * nx + vy * ny, vx * tx + vy * ty
    if normal >= 0.0:
        return None
    knn = knt = ktt = 0.0
    for body, properties in pairs:
        rx, ry = manifold.x - body.x, manifold.y - body.y
        rn, rt = rx * ny - ry * nx, rx * ty - ry * tx
        knn += 1 / properties.mass + rn * rn / properties.inertia
        ktt += 1 / properties.mass + rt * rt / properties.inertia
        knt += rn * rt / properties.inertia
    e = restitution if -normal > SLOW else 0.0
    wanted_n, wanted_t = -(1 + e) * normal, -tangent
    determinant = knn * ktt - knt * knt
    jn = (ktt * wanted_n - knt * wanted_t) / determinant
    jt = (knn * wanted_t - knt * wanted_n) / determinant
    if jn <= 0.0 or abs(jt) > friction * jn:
        slide = math.copysign(friction, jt if jn > 0 else -tangent)
        jn = wanted_n / max(knn + slide * knt, 1e-12)
        jt = slide * jn
    return ContactImpulse(jn * nx + jt * tx, jn * ny + jt * ty, -normal)


# --- Impacts of finite duration ------------------------------------------------------------------

# During compression, a force that grows with the crush depth pushes the bodies apart. During
# restitution, part of it acts until the impulse of restitution is reached (Poisson's hypothesis).
# A collinear impact therefore exchanges the same impulse as an instantaneous one, over a duration
# set by masses and stiffness. Crush is permanent: in a later impact the structure only yields
# beyond the force reached before. Boxes that still overlap after an impact exert no force until
# they come closer than at its end.

SPREAD = 0.5
"""Width of the yielding structure beyond the contact width [m]."""
KEPT = 0.38
"""Fraction of the maximum crush that is permanent: 0.26 of 0.68 m in the barrier test of the 2015
Malibu."""
SQUARE = 1e-6
"""Sine of the maximum angle at which a face counts as perpendicular to a normal."""
MIN_LENGTH = 1.0
"""Minimum length of a crushed body [m]."""
MIN_WIDTH = 0.1
"""Minimum contact width [m]."""


class Patch(NamedTuple):
    """Overlap of two bodies: centroid x, y, depth, and width across the normal [m]."""

    x: float
    y: float
    depth: float
    width: float


class Pulse(NamedTuple):
    """An ongoing impact.

    Attributes:
        normal: direction of the unit normal, out of the second body, relative to the yaw of the
            body that owns the face [rad], so that it rotates with the face.
        restitution: fraction of the compression impulse that is restored.
        compression, restored: normal impulses so far [N s].
        depth: maximum total crush depth so far [m].
        width: contact width at that depth [m].
        loading: whether the bodies are still approaching.
        kept: part of the depth already applied as shortening [m].
        settled: overlap depth at the end of the impact [m].
        face: index of the body that owns the face, 0 or 1.
    """

    normal: float
    restitution: float
    compression: float = 0.0
    restored: float = 0.0
    depth: float = 0.0
    width: float = 0.0
    loading: bool = True
    kept: float = 0.0
    settled: float = 0.0
    face: int = 1

    def along(self, bodies: Bodies) -> tuple[float, float]:
        """The current unit normal."""
        owner = bodies[self.face]
        angle = self.normal + (owner[0].yaw if owner is not None else 0.0)
        return math.cos(angle), math.sin(angle)

    def has_settled(self, patch: Patch) -> bool:
        """Whether the impact is over and the overlap is no deeper than at its end."""
        return self.over and patch.depth <= self.settled

    @property
    def over(self) -> bool:
        """Whether the restitution is complete."""
        return (
            not self.loading and self.restored >= (1 - 1e-9) * self.restitution * self.compression
        )


def face_owner(bodies: Bodies, nx: float, ny: float) -> int:
    """Index of the body with a face perpendicular to a normal: 0 or 1; 1 if both have one."""
    first, second = bodies
    if second is None:
        return 1
    off = [min(abs(u) for u in _along(body, nx, ny)) for body in (first[0], second[0])]
    return 0 if off[0] < off[1] - SQUARE else 1


def mutual_stiffness(bodies: Bodies, nx: float, ny: float) -> float:
    """Series stiffness of the contacting faces per width [N/m^2]; ``n`` out of the second."""
    first, second = bodies
    own = _face_stiffness(first, -nx, -ny)
    if second is None:
        return own
    other = _face_stiffness(second, nx, ny)
    return own * other / (own + other)


def yielding_patch(first: list[Corner], second: list[Corner], nx: float, ny: float) -> Patch | None:
    """The overlap of two boxes, with the centroid of the yielding structure; None without overlap.

    Structure next to the contact yields as well, but not beyond an edge, so at the edge of a face
    the centroid moves inwards.
    """
    found = overlap_patch(first, second, nx, ny)
    if found is None:
        return None
    patch = Patch(*found)
    low, high = overlap_span(first, second, nx, ny)
    edges = [span_across(shape, nx, ny) for shape in (first, second)]
    begin = max(low - SPREAD / 2, *(edge[0] for edge in edges))
    end = min(high + SPREAD / 2, *(edge[1] for edge in edges))
    aside = (begin + end - low - high) / 2
    return patch._replace(x=patch.x - aside * ny, y=patch.y + aside * nx)


def contact_width(bodies: Bodies, width: float, nx: float, ny: float) -> float:
    """Width of the yielding structure for a contact of ``width`` [m]."""
    first, second = bodies
    face = _face_width(first, nx, ny)
    if second is not None:
        face = min(face, _face_width(second, nx, ny))
    return min(max(width, MIN_WIDTH) + SPREAD, face)


def advance_pulse(
    bodies: Bodies, pulse: Pulse, patch: Patch, h: float, *, friction: float
) -> tuple[Pulse, ContactImpulse | None]:
    """The impulse exchanged in the next ``h`` seconds, or None.

    Args:
        bodies: both bodies; None for an immovable one.
        pulse: impact so far.
        patch: current overlap.
        h: duration [s].
        friction: friction coefficient.
    """
    nx, ny = pulse.along(bodies)
    if patch.depth > pulse.depth:
        pulse = pulse._replace(depth=patch.depth, width=patch.width)
    width = contact_width(bodies, pulse.width, nx, ny)
    force = mutual_stiffness(bodies, nx, ny) * width
    place = ContactManifold(patch.x, patch.y, nx, ny, patch.depth)
    motion = relative_motion(bodies, place)
    stopping, push = None, 0.0
    if motion.normal < 0.0:
        stopping = contact_impulse(*bodies, place, restitution=0.0, friction=friction)
        push = motion.normal_part(stopping) if stopping is not None else 0.0
    loading = min(push, force * pulse.depth * h)
    if loading < push:
        pulse = pulse._replace(compression=pulse.compression + loading, loading=True)
        return pulse, motion.limited(loading, friction)
    pulse = pulse._replace(loading=False, settled=patch.depth)
    if pulse.restored == 0.0:
        pulse = pulse._replace(compression=pulse.compression + push)
    left = pulse.restitution * pulse.compression - pulse.restored
    back = max(min(pulse.restitution * force * patch.depth * h, left), 0.0)
    if back == 0.0:
        return pulse, stopping if push > 0.0 else None
    return pulse._replace(restored=pulse.restored + back), motion.limited(push + back, friction)


def _face_stiffness(body: Body, ux: float, uy: float) -> float:
    """Stiffness of the face most aligned with (ux, uy) [N/m^2]."""
    ahead, aside = _along(body[0], ux, uy)
    front, rear, side = body[1].stiffness
    if abs(ahead) < abs(aside):
        return side
    return front if ahead > 0 else rear


def _face_width(body: Body, ux: float, uy: float) -> float:
    ahead, aside = _along(body[0], ux, uy)
    return body[1].length if abs(ahead) < abs(aside) else body[1].width


def _along(body: BodyState, ux: float, uy: float) -> tuple[float, float]:
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    return cos * ux + sin * uy, cos * uy - sin * ux


def shortened(
    body: Body, pulse: Pulse, ux: float, uy: float, stiffness: float
) -> tuple[float, float]:
    """Permanent shortening of the front and the rear of a body by a pulse [m].

    Args:
        body: body whose face towards (ux, uy) was struck.
        pulse: pulse at its end.
        stiffness: combined stiffness of both faces per width [N/m^2].
    """
    ahead, aside = _along(body[0], ux, uy)
    if abs(ahead) < abs(aside):
        return 0.0, 0.0
    front, rear, _ = body[1].stiffness
    own = stiffness / (front if ahead > 0 else rear)
    mean = KEPT * own * (pulse.depth - pulse.kept) * min(pulse.width / body[1].width, 1.0)
    left = body[1].length - MIN_LENGTH
    mean = max(min(mean, left), 0.0)
    return (mean, 0.0) if ahead > 0 else (0.0, mean)


# --- Obstacles of the background -----------------------------------------------------------------

# Occupied cells of a grid hold walls, poles and parked cars.

BREADTH = 1.0
"""Search distance to both sides of a contact for the breadth of an obstacle [m]."""


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """Occupancy grid of background obstacles.

    Attributes:
        origin: [2] lowest corner [m].
        occupied: [nx, ny] bool.
    """

    origin: Float
    occupied: NDArray[np.bool_]

    @cached_property
    def sums(self) -> NDArray[np.int64]:
        """[nx + 1, ny + 1], summed-area table of ``occupied``."""
        sums = np.zeros((self.occupied.shape[0] + 1, self.occupied.shape[1] + 1), np.int64)
        sums[1:, 1:] = self.occupied.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
        return sums

    def manifold(self, body: BodyState, properties: BodyProperties) -> ContactManifold | None:
        """Contact manifold of a body with occupied cells; the normal points towards its box."""
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / OBSTACLE_CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)
        hit = np.zeros(len(points), dtype=bool)
        hit[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
        if not hit.any():
            return None
        x, y = points[hit].mean(axis=0).tolist()
        return _nearest_side(body, properties, x, y)

    def patch(self, body: BodyState, properties: BodyProperties, nx: float, ny: float) -> Patch:
        """Overlap of occupied cells with a body, from its face opposite to the unit normal ``n``.

        ``n`` points out of the cells. Requires a :meth:`manifold`.
        """
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / OBSTACLE_CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)
        hit = np.zeros(len(points), dtype=bool)
        hit[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
        x, y = points[hit].mean(axis=0).tolist()
        along, across = points @ [nx, ny], points[hit] @ [-ny, nx]
        width = float(np.ptp(across)) + OBSTACLE_CELL / 2
        return Patch(x, y, float(along[hit].max() - along.min()), width)

    def breadth(self, x: float, y: float, nx: float, ny: float) -> tuple[float, float]:
        """Extent of the obstacle at x, y to both sides across the normal ``n`` [m].

        At most BREADTH: small for a pole, BREADTH for a wall.
        """
        steps = np.arange(0.0, BREADTH + OBSTACLE_CELL / 4, OBSTACLE_CELL / 2)
        deep = np.arange(-OBSTACLE_CELL, OBSTACLE_CELL * 1.01, OBSTACLE_CELL / 2)
        found = []
        for sign in (-1.0, 1.0):
            across = sign * steps[:, None]
            places = np.stack([x - across * ny + deep * nx, y + across * nx + deep * ny], axis=-1)
            cells = np.floor((places - self.origin) / OBSTACLE_CELL).astype(np.int64)
            inside = ((cells >= 0) & (cells < self.occupied.shape)).all(axis=-1)
            there = np.zeros(inside.shape, dtype=bool)
            there[inside] = self.occupied[cells[inside, 0], cells[inside, 1]]
            gaps = np.flatnonzero(~there.any(axis=1))
            found.append(float(steps[gaps[0] - 1]) if len(gaps) and gaps[0] else 0.0)
            if not len(gaps):
                found[-1] = BREADTH
        return found[0], found[1]

    def count(self, body: BodyState, properties: BodyProperties) -> int:
        """Number of occupied cells under a body."""
        points = footprint(body, properties)
        cells = np.floor((points - self.origin) / OBSTACLE_CELL).astype(np.int64)
        inside = cells[((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)]
        distinct = np.unique(inside[:, 0] * self.occupied.shape[1] + inside[:, 1])
        return int(self.occupied.reshape(-1)[distinct].sum())


def _nearest_side(
    body: BodyState, properties: BodyProperties, x: float, y: float
) -> ContactManifold:
    """The manifold at (x, y), on the nearest side of the box."""
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    dx = x - body.x - properties.box_ahead * cos
    dy = y - body.y - properties.box_ahead * sin
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    deep_x, deep_y = properties.length / 2 - abs(ahead), properties.width / 2 - abs(left)
    if deep_x <= deep_y:
        sign = -math.copysign(1.0, ahead)
        return ContactManifold(x, y, sign * cos, sign * sin, max(deep_x, 0.0))
    sign = -math.copysign(1.0, left)
    return ContactManifold(x, y, -sign * sin, sign * cos, max(deep_y, 0.0))


def footprint(body: BodyState, properties: BodyProperties) -> Float:
    """Points [N, 2] [m] that cover the body's box, at most half a cell apart."""
    nx = max(math.ceil(properties.length / (OBSTACLE_CELL / 2)), 1) + 1
    ny = max(math.ceil(properties.width / (OBSTACLE_CELL / 2)), 1) + 1
    u = np.linspace(-properties.length / 2, properties.length / 2, nx) + properties.box_ahead
    v = np.linspace(-properties.width / 2, properties.width / 2, ny)
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    points: Float = grid @ np.array([[cos, sin], [-sin, cos]]) + [body.x, body.y]
    return points


_grids: WeakKeyDictionary[Scene, ObstacleGrid] = WeakKeyDictionary()


def obstacle_grid(scene: Scene, path: LoggedPath) -> ObstacleGrid:
    """The obstacle grid of a scene's background, cached per scene.

    Occupied cells come from :func:`~...scene.ground.occupied_cells`, as in simulations.

    Args:
        scene: scene with the background.
        path: recorded path of the ego.
    """
    found = _grids.get(scene)
    if found is None:
        cells = occupied_cells(scene.background, scene.ground, path)
        found = _grids[scene] = ObstacleGrid(cells.origin, cells.occupied)
    return found
