"""Whether a body at rest stays there: forces of its contacts against gravity.

A body rests when normal forces at its contacts, each with friction within its cone, add up to its
weight and have no moment about its centre of mass. That holds for a block within the angle of
friction and within the polygon of its contacts, and for nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Collider
from .body import DeformableBody
from .surroundings import clearance

GAP_CELLS = 0.15
"""A corner of a particle that is nearer to something than this touches it [cells]."""
SINK_CELLS = 1.5
"""What is deeper inside a collider is no contact any more but was placed there [cells]."""
DIRECTIONS = 8
"""Of friction at a contact, the first against gravity's pull along the surface."""
CORNERS = 16
"""Directions in which the outermost contacts are taken; those between carry nothing more."""
SHORTFALL = 2e-3
"""Fraction of the weight that may stay unbalanced: a tenth of a degree of slope."""
FRICTION_MAX = 1e3
"""Stands for what sticks."""
_CUBE = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(8, 3)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where a body touches one other thing.

    Attributes:
        other: name of the collider or body.
        points: [K, 3] [m].
        normals: [K, 3] towards the body, unit.
        friction: most friction over normal force in a direction [3] along the surface.
    """

    other: str
    points: Float
    normals: Float
    friction: Callable[[Float], float]


def supports_of(
    body: DeformableBody,
    colliders: Sequence[Collider],
    road: Sequence[Collider],
    others: Iterable[DeformableBody],
    gravity: Float,
) -> tuple[str, ...] | None:
    """Names of what holds a body in rest, or None where it would not stay.

    Args:
        body: as it is now.
        colliders: that touch its surface.
        road: those that carry tyres.
        others: bodies at rest that may carry it.
        gravity: [3] [m/s^2]; without any, nothing has to hold it.
    """
    if not np.any(gravity):
        return ()
    contacts = [*_wheel_contacts(body, road), *collider_contacts(body, colliders)]
    if not _balanced(body, contacts, gravity):
        contacts += body_contacts(body, others)
        if not _balanced(body, contacts, gravity):
            return None
    return tuple(sorted({c.other for c in contacts}))


def _wheel_contacts(body: DeformableBody, road: Sequence[Collider]) -> Iterable[Contacts]:
    """Wheels that carry; locked along their way as far as brakes hold."""
    if body.tyres is None or not road:
        return
    tyres, pose = body.tyres, body.T_world_object
    forward = pose[:3, 0]

    def friction(along: Float) -> float:
        return tyres.grip_along(along, forward)

    for collider, point, normal in tyres.carrying(pose, road):
        yield Contacts(collider.name, point[None], normal[None], friction)


def collider_contacts(body: DeformableBody, colliders: Sequence[Collider]) -> Iterable[Contacts]:
    """Where corners of a body's particles touch colliders, the outermost of each."""
    shell = body.shell_points()
    turn = body.T_world_object[:3, :3]
    for collider in colliders:
        distance, _ = clearance(collider, shell)
        near = shell[distance < body.spacing]
        if not len(near):
            continue
        corners = (near[:, None] + body.spacing * _CUBE @ turn.T).reshape(-1, 3)
        distance, normals = clearance(collider, corners)
        touching = (distance < GAP_CELLS * body.cell) & (distance > -SINK_CELLS * body.cell)
        mu = body.friction if collider.friction is None else collider.friction
        yield from _by_normal(collider.name, corners[touching], normals[touching], mu)


def body_contacts(body: DeformableBody, others: Iterable[DeformableBody]) -> list[Contacts]:
    """Particles beside those of another body; the normal is the mean way from them."""
    from scipy.spatial import cKDTree

    contacts: list[Contacts] = []
    own = body.shell_points()
    for other in others:
        reach = (body.spacing + other.spacing) / 2 + GAP_CELLS * body.cell
        if other is body or body.gap_to(other) > reach:
            continue
        theirs = other.shell_points()
        found = cKDTree(theirs).query_ball_point(own, 1.2 * reach)
        touching = np.flatnonzero([len(f) > 0 for f in found])
        if not len(touching):
            continue
        away = np.stack([own[k] - theirs[found[k]].mean(axis=0) for k in touching])
        normals = away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
        mean = normals.mean(axis=0)
        mean /= max(float(np.linalg.norm(mean)), 1e-9)
        points = own[touching] - normals * body.spacing / 2
        mu = float(np.sqrt(body.friction * other.friction))
        contacts += _by_normal(other.name, points, np.tile(mean, (len(points), 1)), mu)
    return contacts


def _by_normal(name: str, points: Float, normals: Float, mu: float) -> Iterable[Contacts]:
    """Contacts of one thing, those with about the same normal together, the outermost of each."""
    if not len(points):
        return
    _, group = np.unique(np.round(4 * normals), axis=0, return_inverse=True)
    for g in range(int(group.max()) + 1):
        own = np.flatnonzero(group.ravel() == g)
        kept = own[_outermost(points[own], normals[own].mean(axis=0))]
        yield Contacts(name, points[kept], normals[kept], lambda along: mu)


def _outermost(points: Float, normal: Float) -> Float:
    first, second = tangents(normal, np.array([1.0, 0.3, 0.2]))
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    directions = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return np.unique((points @ directions.T).argmax(axis=0))


def tangents(normal: Float, pull: Float) -> tuple[Float, Float]:
    """Two unit vectors along the surface: against ``pull``, and across it."""
    along = (pull @ normal) * normal - pull
    length = float(np.linalg.norm(along))
    if length < 1e-6 * float(np.linalg.norm(pull)):
        along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        length = float(np.linalg.norm(along))
    first = along / length
    return first, np.cross(normal, first)


def _balanced(body: DeformableBody, contacts: Sequence[Contacts], gravity: Float) -> bool:
    """Whether forces within all friction cones hold the weight, without a moment."""
    from scipy.optimize import nnls

    if not contacts:
        return False
    arm = max(body.reach, 1e-6)
    columns = []
    for c in contacts:
        for point, normal in zip(c.points, c.normals, strict=True):
            first, second = tangents(normal, gravity)
            lever = (point - body.motion.centre) / arm
            for k in range(DIRECTIONS):
                angle = 2 * np.pi * k / DIRECTIONS
                along = np.cos(angle) * first + np.sin(angle) * second
                force = normal + min(c.friction(along), FRICTION_MAX) * along
                columns.append(np.concatenate([force, np.cross(lever, force)]))
    weight = np.concatenate([-gravity / np.linalg.norm(gravity), np.zeros(3)])
    _, left = nnls(np.array(columns).T, weight)
    return bool(left < SHORTFALL)
