"""Bodies that cannot yield to what touches them: they stay rigid, and are colliders for the rest.

A cone does not dent a truck. Where all the energy of an impact could not dent a body by as much as
its particles resolve, only the lighter one deforms. The other is a few boxes about its surface
near by for the solver of the lighter one, and takes back what these have given, impulse and moment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import Float
from ..physics.colliders import Box
from ..physics.solver import ContactTotals
from .body import DeformableBody

LIGHTER = 10.0
"""A body may stay rigid against what is so many times lighter."""
DENT = 0.5
"""Dents that are shallower than so many spacings of particles are not resolved by them."""
PATCH_CELLS = 4.0
"""Boxes cover a body's surface as far as this around what touches it [cells]."""
ALIKE = 1.5
"""Layers whose sides lie within so many spacings of each other are one box."""


def withstands(body: DeformableBody, other: DeformableBody, gravity: Float) -> bool:
    """Whether a body keeps its shape whatever another does to it at the speeds they have now.

    The force that yielding takes is the least yield stress near by over the other's smallest face.
    What is only elastic gives way at any force, and so never withstands.

    Args:
        body: any.
        other: that touches it, or will.
        gravity: [3] [m/s^2].
    """
    a, b = body.motion, other.motion
    if LIGHTER * b.mass > a.mass:
        return False
    near = np.unique(body.regions[_patch(body, other)]).tolist()
    if not near:
        return True
    strength = min(body.materials[region].strength for region in near)
    if not math.isfinite(strength):
        return False
    speed = float(np.linalg.norm(a.velocity - b.velocity))
    speed += body.reach * float(np.linalg.norm(a.angular_velocity))
    speed += other.reach * float(np.linalg.norm(b.angular_velocity))
    energy = a.mass * b.mass / (a.mass + b.mass) * speed * speed / 2
    edges = np.sort(other.box()[1])
    force = strength * float(edges[0] * edges[1]) - b.mass * float(np.linalg.norm(gravity))
    return bool(energy < force * DENT * body.spacing)


def as_boxes(body: DeformableBody, other: DeformableBody) -> list[Box]:
    """The part of a body that another may touch, layer upon layer, moving as the body does."""
    pose, m, s = body.T_world_object, body.motion, body.spacing
    local = body.local_positions()[_patch(body, other)]
    boxes: list[Box] = []
    for low, high in _layers(local, body.cell, s):
        middle = np.eye(4)
        middle[:3, 3] = (low + high) / 2
        place = pose @ middle
        boxes.append(
            Box(
                name=f"{body.name}:{other.name}:{len(boxes)}",
                T_world_box=place,
                size=high - low,
                velocity=m.velocity_at(place[:3, 3]),
                angular_velocity=m.angular_velocity,
                friction=math.sqrt(body.friction * other.friction),
            )
        )
    return boxes


def by_owner(
    contacts: Iterable[ContactTotals], owners: Mapping[str, DeformableBody]
) -> list[ContactTotals]:
    """Contacts with what boxes of a body have done added up and under its name."""
    found: dict[tuple[str, str], ContactTotals] = {}
    for c in contacts:
        other = owners[c.other].name if c.other in owners else c.other
        known = found.get((c.body, other))
        if known is None:
            found[c.body, other] = replace(c, other=other)
            continue
        found[c.body, other] = replace(
            known,
            impulse=known.impulse + c.impulse,
            moment=known.moment + c.moment,
            friction_work=known.friction_work + c.friction_work,
            work=known.work + c.work,
        )
    return list(found.values())


def _patch(body: DeformableBody, other: DeformableBody) -> NDArray[np.bool_]:
    """Which particles [N] of a body lie in a cube about another, edges along the body's own."""
    pose = body.T_world_object
    centre = pose[:3, :3].T @ (other.motion.centre - pose[:3, 3])
    half = other.reach + PATCH_CELLS * body.cell
    inside: NDArray[np.bool_] = np.all(np.abs(body.local_positions() - centre) < half, axis=1)
    return inside


def _layers(local: Float, cell: float, spacing: float) -> list[tuple[Float, Float]]:
    """Corners (low, high) of boxes about particles [N, 3], one above the other."""
    level = np.floor(local[:, 2] / cell)
    layers: list[tuple[Float, Float]] = []
    for k in np.unique(level).tolist():
        own = local[level == k]
        low, high = own.min(axis=0) - spacing / 2, own.max(axis=0) + spacing / 2
        if layers:
            below_low, below_high = layers[-1]
            apart = np.abs(np.concatenate([low - below_low, high - below_high])[[0, 1, 3, 4]])
            if apart.max() < ALIKE * spacing:
                low, high = np.minimum(low, below_low), np.maximum(high, below_high)
                layers.pop()
        layers.append((low, high))
    return layers
