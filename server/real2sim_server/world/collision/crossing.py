"""Bodies that pass through a corner of one another between two substeps."""

from __future__ import annotations

import math

import numpy as np

from ...geometry.rotation import Float, yaw_quaternion
from ..boxes import first_contacts
from .rigid_body import BodyProperties, BodyState

SLOWEST = 0.05
"""Bodies that move less than this against each other in a substep cannot do so unseen [m]."""

HEIGHT = 1.0
"""Of both bodies here: whether they are above one another is looked at elsewhere."""

Way = tuple[BodyState, BodyState]
"""A body before and after a substep."""


def crossing(first: Way, second: Way, shapes: tuple[BodyProperties, BodyProperties]) -> float:
    """Fraction of a substep at which two bodies that do not overlap at its end first do; inf where
    they never do, or hardly move against each other."""
    (a, b), (c, d) = first, second
    if math.hypot((b.x - a.x) - (d.x - c.x), (b.y - a.y) - (d.y - c.y)) < SLOWEST:
        return math.inf
    ego, other = shapes
    way = np.array([(k, *_centre(body, ego), body.yaw, 0.0) for k, body in enumerate(first)])
    places = [np.array([(*_centre(body, other), HEIGHT / 2)]) for body in second]
    turns: list[Float] = [yaw_quaternion(np.array([body.yaw])) for body in second]
    found, _ = first_contacts(
        way,
        (ego.length, ego.width, HEIGHT),
        np.zeros(1, np.int64),
        (places[0], turns[0]),
        (places[1], turns[1]),
        np.array([(other.length, other.width, HEIGHT)]),
        0.0,
        1e-3,
    )
    return float(found[0])


def between(way: Way, fraction: float) -> BodyState:
    """A body at a fraction of a substep, with its velocity at the end."""
    before, after = way
    return after._replace(
        x=before.x + fraction * (after.x - before.x),
        y=before.y + fraction * (after.y - before.y),
        yaw=before.yaw + fraction * (after.yaw - before.yaw),
    )


def drifted(body: BodyState, seconds: float) -> BodyState:
    """A body so much later [s], its velocity kept."""
    return body._replace(
        x=body.x + seconds * body.vx,
        y=body.y + seconds * body.vy,
        yaw=body.yaw + seconds * body.turn,
    )


def _centre(body: BodyState, shape: BodyProperties) -> tuple[float, float]:
    ahead = shape.box_ahead
    return body.x + ahead * math.cos(body.yaw), body.y + ahead * math.sin(body.yaw)
