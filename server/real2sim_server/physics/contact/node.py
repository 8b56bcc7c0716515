"""Contact at one node: of a body with a collider, of two bodies; the same for every device.

Arrays are rows of one node: velocity and mass [4], first moment of volume and volume [4], and the
totals [TOTALS] of one touch.
"""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any

from ..numerics.device import ZERO, device_function
from .collider_distance import (
    FRICTION,
    SEPARABLE,
    THIN,
    collider_distance,
    collider_velocity,
    unit,
)
from .surface import CRUSHED, INSIDE, OPPOSED, coulomb, face_score, surface_offset

ON_FACE = 1e-4
"""A node this near to a face of a thin solid, or to half a cell beyond its edges, lies in it
[cells]: centroids are known up to rounding, and nodes often lie on faces."""
THIN_MARGIN = 0.2
"""Nodes stop a body this much before it meets a thin solid [cells]: on the way to rest it still
sinks by up to a third of a cell, and what particles must stop themselves loses its elastic
energy."""


@device_function
def resolve_node_collider(
    row: Any, heights: Any, dx: Any, body_friction: Any, at: Any, node: Any, moment: Any, total: Any
) -> None:
    """Contact of one body's node at ``at`` with one collider, where surfaces have met."""
    margin = 0.0
    if row[THIN] > 0.5:
        distance, n = distance_behind(row, heights, dx, at, moment)
        margin = THIN_MARGIN
    else:
        distance, n = collider_distance(row, heights, at[0], at[1], at[2])
    if distance > 0.0:
        return
    depth = (moment[0] * n[0] + moment[1] * n[1] + moment[2] * n[2]) / moment[3]
    if distance / dx + surface_offset(depth) > margin:
        return
    friction = row[FRICTION] if row[FRICTION] >= ZERO else body_friction
    u = collider_velocity(row, at[0], at[1], at[2])
    apply_contact(node, n, u, friction, row[SEPARABLE] > 0.5, at, total)


@device_function
def distance_behind(row: Any, heights: Any, dx: Any, at: Any, moment: Any) -> Any:
    """Distance [m] of a node to the face of a thin solid that the body looks at; the normal.

    A node of the grid may lie beyond a thin solid and still stand for what is before it. The
    centroid of the body's volume near the node tells the side, and the solid counts as thick behind
    the face there, or the plane that touches it there, as far across as half a cell beyond its
    edges.
    """
    per_volume = dx / moment[3]
    out = (moment[0] * per_volume, moment[1] * per_volume, moment[2] * per_volume)
    distance, n = collider_distance(row, heights, at[0] + out[0], at[1] + out[1], at[2] + out[2])
    distance -= out[0] * n[0] + out[1] * n[1] + out[2] * n[2] + ON_FACE * dx
    across, _ = collider_distance(
        row, heights, at[0] - distance * n[0], at[1] - distance * n[1], at[2] - distance * n[2]
    )
    if across > (0.5 + ON_FACE) * dx:
        distance = across
    return distance, n


@device_function
def apply_contact(
    node: Any, n: Any, u: Any, friction: Any, separable: Any, at: Any, total: Any
) -> None:
    """Touch of a node with a collider that moves at ``u``; adds to the touch's totals."""
    relative = (node[0] - u[0], node[1] - u[1], node[2] - u[2])
    after = coulomb(relative, n, friction, separable)
    change = (after[0] - relative[0], after[1] - relative[1], after[2] - relative[2])
    if change[0] != 0.0 or change[1] != 0.0 or change[2] != 0.0:
        for axis in range(3):
            node[axis] = u[axis] + after[axis]
        m = node[3]
        impulse = (m * change[0], m * change[1], m * change[2])
        record_impulse(impulse, after, u, at, 1.0, total)


@device_function
def record_impulse(impulse: Any, slip: Any, other: Any, at: Any, fraction: Any, total: Any) -> None:
    """Add an impulse at a place, the friction work and the work it did; see ``base.TOTALS``."""
    px, py, pz = impulse
    total[0] += px
    total[1] += py
    total[2] += pz
    total[3] += at[1] * pz - at[2] * py
    total[4] += at[2] * px - at[0] * pz
    total[5] += at[0] * py - at[1] * px
    total[6] -= fraction * (px * slip[0] + py * slip[1] + pz * slip[2])
    total[7] += px * other[0] + py * other[1] + pz * other[2]


@device_function
def pair_friction(a: Any, b: Any) -> Any:
    """Coulomb coefficient between two surfaces."""
    return math.sqrt(a * b)


@device_function
def resolve_node_pair(
    node_a: Any, node_b: Any, moment_a: Any, moment_b: Any,
    friction: Any, dx: Any, at: Any, total_a: Any, total_b: Any,
) -> None:  # fmt: skip
    """Contact of two bodies at a node, where their surfaces have met.

    The normal is that of the body that shows more of a face, or edges would plough through faces;
    surfaces that do not look at each other pass by, unless one body has been crushed and is all
    around the node, and so has no surface there. Each surface lies where a half-space with that
    centroid has it.
    """
    ma, mb = node_a[3], node_b[3]
    volume_a, volume_b = moment_a[3], moment_b[3]
    into_b, size_b = unit(moment_b[0], moment_b[1], moment_b[2])
    out_of_a, size_a = unit(-moment_a[0], -moment_a[1], -moment_a[2])
    facing = into_b[0] * out_of_a[0] + into_b[1] * out_of_a[1] + into_b[2] * out_of_a[2]
    per_cell = 1.0 / (dx * dx * dx)
    if facing < OPPOSED:
        around_a = size_a <= INSIDE * volume_a and volume_a * per_cell >= CRUSHED
        around_b = size_b <= INSIDE * volume_b and volume_b * per_cell >= CRUSHED
        if not (around_a or around_b):
            return
    score_a = face_score(size_a * per_cell, volume_a * per_cell)
    score_b = face_score(size_b * per_cell, volume_b * per_cell)
    n = out_of_a if score_a > score_b else into_b
    depth_a = -(moment_a[0] * n[0] + moment_a[1] * n[1] + moment_a[2] * n[2]) / volume_a
    depth_b = (moment_b[0] * n[0] + moment_b[1] * n[1] + moment_b[2] * n[2]) / volume_b
    if surface_offset(depth_a) + surface_offset(depth_b) > ZERO:
        return
    relative = (node_b[0] - node_a[0], node_b[1] - node_a[1], node_b[2] - node_a[2])
    after = coulomb(relative, n, friction, True)
    change = (after[0] - relative[0], after[1] - relative[1], after[2] - relative[2])
    if change[0] != 0.0 or change[1] != 0.0 or change[2] != 0.0:
        reduced = ma * mb / (ma + mb)
        on_b = (reduced * change[0], reduced * change[1], reduced * change[2])
        on_a = (-on_b[0], -on_b[1], -on_b[2])
        for axis in range(3):
            node_a[axis] += on_a[axis] / ma
            node_b[axis] += on_b[axis] / mb
        record_impulse(on_a, (-after[0], -after[1], -after[2]), node_b, at, 0.5, total_a)
        record_impulse(on_b, after, node_a, at, 0.5, total_b)
