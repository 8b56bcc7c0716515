"""What entities and conditions may know at one instant, and how distances are measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from real2sim_proto.storyboard_conditions import Frame, Measure

from ..traffic.driver import Surroundings
from .entity_state import EntityState
from .roads import Place, RoadNetwork

BESIDE = 8.0
"""Places further than this from a way are not along it [m]."""

CLOSED = 1e-9


@dataclass(frozen=True, eq=False)
class View:
    """One instant.

    Attributes:
        elapsed: time since the episode began [s].
        first: whether it is the first of its step, whose surroundings are exact.
        entities: entities by name.
        network: roads.
        surroundings: of the step.
    """

    elapsed: float
    first: bool
    entities: Mapping[str, EntityState]
    network: RoadNetwork
    surroundings: Surroundings


def ahead_on_way(actor: EntityState, x: float, y: float, network: RoadNetwork) -> float:
    """How far ahead a place is along the way of an entity; straight on where it is not beside it
    [m]."""
    way = actor.way if actor.trajectory is None else None
    if way is None:
        way = actor.on_lane(network).way
    assert way is not None
    here = way.path.nearest(actor.x, actor.y).s if actor.way is not way else actor.s
    near = way.path.nearest(x, y)
    if abs(near.offset) > BESIDE or way.lane == 0:
        return along(actor.h, x - actor.x, y - actor.y)
    beyond = 0.0
    if near.s <= 0.0 or near.s >= way.path.length:
        beyond = along(near.yaw, x - near.position[0], y - near.position[1])
    return near.s + beyond - here


def along(h: float, dx: float, dy: float) -> float:
    """Component of a vector along a heading."""
    return dx * math.cos(h) + dy * math.sin(h)


def across(h: float, dx: float, dy: float) -> float:
    """Component of a vector to the left of a heading."""
    return dy * math.cos(h) - dx * math.sin(h)


def offsets(
    actor: EntityState, place: Place, frame: Frame, network: RoadNetwork
) -> tuple[float, float]:
    """A place from an entity: ahead and to the left [m], in its own frame, or in its lane's."""
    dx, dy = place.x - actor.x, place.y - actor.y
    if frame == "entity":
        return along(actor.h, dx, dy), across(actor.h, dx, dy)
    here = network.locate(actor.x, actor.y, actor.h)
    there = network.locate(place.x, place.y, place.h)
    if here is None or there is None or here.road != there.road:
        return along(actor.h, dx, dy), across(actor.h, dx, dy)
    sense = 1.0 if math.cos(actor.h - here.h) >= 0.0 else -1.0
    return sense * (there.s - here.s), sense * (there.t - here.t)


def distance_to(
    actor: EntityState, other: EntityState | Place, measure: Measure, frame: Frame, *,
    freespace: bool, network: RoadNetwork,
) -> float:  # fmt: skip
    """Distance of an entity from another, or from a place [m], never negative."""
    if measure == "euclidean":
        if not freespace:
            return math.hypot(other.x - actor.x, other.y - actor.y)
        return box_distance(corners(actor), _outline(other))
    place = Place(other.x, other.y, other.h)
    number = 0 if measure == "longitudinal" else 1
    if not freespace:
        return abs(offsets(actor, place, frame, network)[number])
    h = actor.h
    if frame != "entity" and (here := network.locate(actor.x, actor.y, actor.h)) is not None:
        h = here.h
    own, others = _extent(corners(actor), h, number), _extent(_outline(other), h, number)
    if frame != "entity":
        # Along a bend the way counts; boxes reach as far as they do where they are.
        between = offsets(actor, place, frame, network)[number]
        sense = 1.0 if math.cos(actor.h - h) >= 0.0 else -1.0
        pick = along if number == 0 else across
        straight_on = pick(h, place.x - actor.x, place.y - actor.y)
        shift = sense * between - straight_on
        others = (others[0] + shift, others[1] + shift)
    return max(own[0] - others[1], others[0] - own[1], 0.0)


def closing_speed(actor: EntityState, other: EntityState | Place, measure: Measure) -> float:
    """Speed at which the distance shrinks [m/s]."""
    vx, vy = actor.velocity
    ox, oy = other.velocity if isinstance(other, EntityState) else (0.0, 0.0)
    dx, dy = other.x - actor.x, other.y - actor.y
    if measure == "euclidean":
        distance = math.hypot(dx, dy)
        return ((vx - ox) * dx + (vy - oy) * dy) / distance if distance > CLOSED else 0.0
    pick = along if measure == "longitudinal" else across
    return pick(actor.h, vx - ox, vy - oy) * math.copysign(1.0, pick(actor.h, dx, dy))


def corners(actor: EntityState) -> list[tuple[float, float]]:
    """Of its box seen from above, in turn [m]."""
    x, y = actor.middle
    return box_corners_of(x, y, actor.h, actor.size[0], actor.size[1])


def box_corners_of(
    x: float, y: float, h: float, length: float, width: float
) -> list[tuple[float, float]]:
    """Corners of a rectangle in turn [m]."""
    cos, sin = math.cos(h), math.sin(h)
    half, side = length / 2, width / 2
    return [
        (x + a * cos - b * sin, y + a * sin + b * cos)
        for a, b in ((half, side), (-half, side), (-half, -side), (half, -side))
    ]


def box_distance(a: list[tuple[float, float]], b: list[tuple[float, float]]) -> float:
    """Between two convex outlines [m]; 0 where they touch or overlap."""
    if overlapping(a, b):
        return 0.0
    pairs = [(p, edge) for p in a for edge in _edges(b)]
    pairs += [(p, edge) for p in b for edge in _edges(a)]
    return min(_to_segment(p, *edge) for p, edge in pairs)


def overlapping(a: list[tuple[float, float]], b: list[tuple[float, float]]) -> bool:
    """Whether two convex outlines have a place in common (separating axes)."""
    for outline in (a, b):
        for (x0, y0), (x1, y1) in _edges(outline):
            nx, ny = y1 - y0, x0 - x1
            of_a = [nx * x + ny * y for x, y in a]
            of_b = [nx * x + ny * y for x, y in b]
            if max(of_a) < min(of_b) or max(of_b) < min(of_a):
                return False
    return True


def _outline(other: EntityState | Place) -> list[tuple[float, float]]:
    return corners(other) if isinstance(other, EntityState) else [(other.x, other.y)]


def _extent(outline: list[tuple[float, float]], h: float, number: int) -> tuple[float, float]:
    pick = along if number == 0 else across
    values = [pick(h, x, y) for x, y in outline]
    return min(values), max(values)


def _edges(
    outline: list[tuple[float, float]],
) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    if len(outline) == 1:
        return [(outline[0], outline[0])]
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _to_segment(p: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    u = 0.0 if square == 0.0 else ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square
    u = min(max(u, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - u * dx, p[1] - a[1] - u * dy)
