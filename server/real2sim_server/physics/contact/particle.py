"""Contact of one particle with a collider that is thin against the cells of the grid.

Nodes of the grid stop most of a body, see ``node``, but may all miss such a collider, so particles
are held by it themselves: each is followed over its way in a substep to where it first touches. Its
velocity loses what would carry it further in, nothing more, wherever the grid lies.
"""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any

from ..numerics.device import TINY, ZERO, device_function
from .collider_distance import (
    AXES,
    BOX,
    CAPSULE,
    CYLINDER,
    FRICTION,
    HALF_SIZE,
    KIND,
    POINT,
    SEPARABLE,
    collider_distance,
    collider_velocity,
    unit,
)
from .node import record_impulse
from .surface import coulomb

THIN_CELLS = 2.0
"""A solid thinner than this many cells is thin, and so is every mesh: fewer than two layers of
nodes may lie in it, and one layer does not stop what is pressed on it (measured: plates of 1.5
cells leak at some places of the grid, those of 2 cells at none)."""
SINK = 0.5
"""Particles stop this far before a face, in halves of their spacing: so nodes stop a body first."""
TOUCHING = 1e-3
"""A particle nearer to where it stops than this touches, in halves of its spacing."""
LOOKS = 12
"""Times that a particle looks ahead on one way, each as far as nothing can be in between."""
MISSES = 2.0
"""In place of the fraction of a way, where a particle does not touch."""


@device_function
def half_spacing(volume: Any) -> Any:
    """Half the spacing [m] of particles of ``volume`` [m^3]."""
    return 0.5 * float(volume) ** (1.0 / 3.0)


@device_function
def entry(q: Any, w: Any, stop: Any, tolerance: Any, holds: Any) -> Any:
    """Fraction of a way along one axis until ``stop`` is reached from outside; or MISSES.

    Args:
        q, w: place and way along the axis, from the centre of the box [m].
        stop: how far from the centre particles stop [m].
        tolerance: [m].
        holds: whether what has touched is held.
    """
    gap = abs(q) - stop
    if gap < -tolerance:
        return MISSES
    if holds and gap <= tolerance:
        return 0.0
    inward = -w if q > 0.0 else w
    if inward <= 0.0 or gap > inward:
        return MISSES
    return max(gap, 0.0) / inward


@device_function
def first_touch(row: Any, heights: Any, at: Any, way: Any, half: Any) -> Any:
    """Fraction of a way after which a particle touches a thin solid, and the normal out of it.

    Args:
        row, heights: packed solid, see ``collider_distance``.
        at: the particle at the start [m].
        way: that it goes relative to the solid [m].
        half: half the spacing of particles [m].

    Returns:
        Fraction in [0, 1], or MISSES, and the unit normal.
    """
    if int(row[KIND]) == BOX:
        return touch_of_box(row, at, way, half)
    return touch_of_surface(row, heights, at, way, half)


@device_function
def touch_of_surface(row: Any, heights: Any, at: Any, way: Any, half: Any) -> Any:
    """The same for any solid, by its distance alone: never further than that at once.

    Particles are balls here, or round posts would pass between their rows.
    """
    length = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    stop, near = half, TOUCHING * half
    distance, n = collider_distance(row, heights, at[0], at[1], at[2])
    gap, t = distance - stop, 0.0
    if gap < -near or (row[SEPARABLE] < 0.5 and gap <= near):
        return 0.0, n
    for _ in range(LOOKS):
        inward = -(way[0] * n[0] + way[1] * n[1] + way[2] * n[2])
        if gap <= near:
            return (t if inward > 0.0 else MISSES), face_on(row, way, length, n, half)
        t += gap / max(length, TINY)
        if t > 1.0:
            return MISSES, n
        distance, n = collider_distance(
            row, heights, at[0] + t * way[0], at[1] + t * way[1], at[2] + t * way[2]
        )
        gap = distance - stop
    return t, n


@device_function
def face_on(row: Any, way: Any, length: Any, n: Any, half: Any) -> Any:
    """The normal ``n`` of a touch, turned against the way where a round post is thinner than
    particles are apart: it stops those of both rows beside it, and does not part them."""
    kind = int(row[KIND])
    if not CYLINDER <= kind <= CAPSULE or row[HALF_SIZE] >= half:
        return n
    own = row[HALF_SIZE] / half
    against = (1.0 - own) / max(length, TINY)
    x, y, z = (
        own * n[0] - against * way[0],
        own * n[1] - against * way[1],
        own * n[2] - against * way[2],
    )
    turned, _ = unit(x, y, z)
    return turned


@device_function
def touch_of_box(row: Any, at: Any, way: Any, half: Any) -> Any:
    """The same for a box.

    A particle stops before any of the six faces that it meets within half a spacing of its edges,
    so that a post cannot pass between two rows of particles, nor push them aside.
    """
    px, py, pz = at[0] - row[POINT], at[1] - row[POINT + 1], at[2] - row[POINT + 2]
    t, axis, sign = MISSES, 0, 1.0
    deepest, inner, inner_sign = -1e30, 0, 1.0
    for k in range(3):
        q = row[AXES + k] * px + row[AXES + 3 + k] * py + row[AXES + 6 + k] * pz
        w = row[AXES + k] * way[0] + row[AXES + 3 + k] * way[1] + row[AXES + 6 + k] * way[2]
        stop = row[HALF_SIZE + k] + SINK * half
        outer = 1.0 if q > 0.0 else -1.0
        if abs(q) - stop > deepest:
            deepest, inner, inner_sign = abs(q) - stop, k, outer
        tk = entry(q, w, stop, TOUCHING * half, row[SEPARABLE] < 0.5)
        if tk < t:
            beside = False
            for other in range(3):
                o = row[AXES + other] * (px + tk * way[0])
                o += row[AXES + 3 + other] * (py + tk * way[1])
                o += row[AXES + 6 + other] * (pz + tk * way[2])
                if other != k and abs(o) > row[HALF_SIZE + other] + half:
                    beside = True
            if not beside:
                t, axis, sign = tk, k, outer
    if deepest < -TOUCHING * half:
        t, axis, sign = 0.0, inner, inner_sign
    return t, (sign * row[AXES + axis], sign * row[AXES + 3 + axis], sign * row[AXES + 6 + axis])


@device_function
def resolve_particle_collider(
    row: Any, heights: Any, dt: Any, body_friction: Any, volume: Any, at: Any, v: Any, m: Any,
    total: Any,
) -> Any:  # fmt: skip
    """Velocity of a particle at ``at`` once a thin collider has had its say; adds to the totals.

    What brings it to the surface within the substep stays, so that it comes to lie on it.
    """
    u = collider_velocity(row, at[0], at[1], at[2])
    relative = (v[0] - u[0], v[1] - u[1], v[2] - u[2])
    way = (dt * relative[0], dt * relative[1], dt * relative[2])
    t, n = first_touch(row, heights, at, way, half_spacing(volume))
    if t > 1.0:
        return v
    approach = t * (relative[0] * n[0] + relative[1] * n[1] + relative[2] * n[2])
    rest = (approach * n[0], approach * n[1], approach * n[2])
    stopped = (relative[0] - rest[0], relative[1] - rest[1], relative[2] - rest[2])
    friction = row[FRICTION] if row[FRICTION] >= ZERO else body_friction
    after = coulomb(stopped, n, friction, row[SEPARABLE] > 0.5)
    change = (after[0] - stopped[0], after[1] - stopped[1], after[2] - stopped[2])
    if change[0] == 0.0 and change[1] == 0.0 and change[2] == 0.0:
        return v
    impulse = (m * change[0], m * change[1], m * change[2])
    slip = (after[0] + rest[0], after[1] + rest[1], after[2] + rest[2])
    record_impulse(impulse, slip, u, at, 1.0, total)
    return (u[0] + slip[0], u[1] + slip[1], u[2] + slip[2])
