"""Contact manifold of two boxes on the plane, and the impulse that they exchange there."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

from .rigid_body import BodyProperties, BodyState

Corner = tuple[float, float]

SLOW = 0.3
"""Approach below this speed ends without rebound [m/s]."""


class ContactManifold(NamedTuple):
    """Where two bodies overlap.

    Attributes:
        x, y: middle of the overlap [m].
        nx, ny: unit normal, out of the second body into the first.
        depth: of the overlap along the normal [m].
    """

    x: float
    y: float
    nx: float
    ny: float
    depth: float


class ContactImpulse(NamedTuple):
    """An impulse on the first body [N s], and the speed at which the two approached [m/s]."""

    jx: float
    jy: float
    approach: float


Body = tuple[BodyState, BodyProperties]
Bodies = tuple[Body, Body | None]
"""Two bodies in contact; None for what cannot move."""


class RelativeMotion(NamedTuple):
    """How two bodies move against each other at a place, and what impulses there change of it.

    Attributes:
        nx, ny: unit normal, out of the second body into the first.
        normal, tangent: velocity of the first against the second [m/s].
        knn, knt, ktt: change of these per impulse [1/kg].
    """

    nx: float
    ny: float
    normal: float
    tangent: float
    knn: float
    knt: float
    ktt: float

    def limited(self, push: float, friction: float) -> ContactImpulse:
        """An impulse with the normal part ``push`` [N s], and across it as much as ends sliding,
        at most friction times that."""
        jt = -(self.tangent + self.knt * push) / self.ktt
        jt = min(max(jt, -friction * push), friction * push)
        nx, ny = self.nx, self.ny
        return ContactImpulse(push * nx - jt * ny, push * ny + jt * nx, -self.normal)

    def normal_part(self, impulse: ContactImpulse) -> float:
        """Of an impulse along the normal [N s]."""
        return impulse.jx * self.nx + impulse.jy * self.ny


def relative_motion(bodies: Bodies, manifold: ContactManifold) -> RelativeMotion:
    """Of two bodies at a contact."""
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
    """Centroid x, y of the overlap of two convex quadrilaterals, its mean depth along the normal
    and its width across it [m]; None where there is none."""
    return patch_of(overlap_shape(first, second), nx, ny)


def patch_of(shape: list[Corner], nx: float, ny: float) -> tuple[float, float, float, float] | None:
    """The same of an overlap as it is."""
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
    """From where to where across a unit normal two overlapping quadrilaterals overlap [m]."""
    return span_across(overlap_shape(first, second), nx, ny)


def span_across(shape: list[Corner], nx: float, ny: float) -> tuple[float, float]:
    """From where to where a shape reaches across a unit normal [m]."""
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
    """Where two convex quadrilaterals overlap; None where they do not.

    The normal is that of least penetration among the edges of both (separating axes); the point
    is the centroid of the overlap.
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
    """The impulse of a planar impact; None where the bodies part already.

    Newton's restitution along the normal, and along the tangent as much as ends sliding, at most
    friction times the normal impulse (Brach & Brach 2011, Vehicle Accident Analysis and
    Reconstruction Methods, ch. 6).

    Args:
        first, second: bodies before the impact; None for what cannot move.
        manifold: point and normal.
        restitution: separation per approach speed; 0 for slow approaches.
        friction: tangential per normal impulse at most.
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
