"""Impacts that take time: what two bodies in contact have exchanged so far, and what comes next.

While they approach, a force pushes them apart that grows with the depth to which their structures
are crushed; once they do not, a part of it remains until the impulse of restitution is given
(Poisson's hypothesis). So collinear impacts exchange what a sudden impulse would, over the time
that their masses and structures take. Crush is never given back: who comes again meets what is
already crushed, which yields no further before as much force acts on it; and two whose boxes still
overlap when it is over do not push each other until they come nearer than they were then.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .manifold import (
    Bodies,
    Body,
    ContactImpulse,
    ContactManifold,
    Corner,
    contact_impulse,
    overlap_patch,
    overlap_span,
    relative_motion,
    span_across,
)
from .rigid_body import BodyState

SPREAD = 0.5
"""By how much wider than the place of contact a structure is that yields there [m]."""
KEPT = 0.38
"""Of the largest crush that stays: 0.26 of 0.68 m in the barrier test of the 2015 Malibu."""
SQUARE = 1e-6
"""Faces across a normal lie so well across it, as a sine."""
LEAST_LENGTH = 1.0
"""Of a body that has been crushed [m]."""
LEAST_WIDTH = 0.1
"""Of a place of contact [m]."""


class Patch(NamedTuple):
    """Where two bodies reach into one another: centroid x, y; depth and width across [m]."""

    x: float
    y: float
    depth: float
    width: float


class Pulse(NamedTuple):
    """An impact under way.

    Attributes:
        normal: direction of the unit normal, out of the second body, less the yaw of the body whose
            face it belongs to [rad]: the face turns with it.
        restitution: of the impulse of compression that comes back.
        compression, restored: impulses along the normal until now [N s].
        depth: to which the two were crushed together, at most until now [m].
        width: of the contact there [m].
        loading: whether the two still come nearer to each other.
        kept: part of the depth by which they are shorter already [m].
        settled: depth at which they were when it was over [m].
        face: whose face the normal belongs to, 0 or 1.
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
        """The unit normal as it is now."""
        owner = bodies[self.face]
        angle = self.normal + (owner[0].yaw if owner is not None else 0.0)
        return math.cos(angle), math.sin(angle)

    def has_settled(self, patch: Patch) -> bool:
        """Whether the impact is over and the two are no deeper in one another than at its end."""
        return self.over and patch.depth <= self.settled

    @property
    def over(self) -> bool:
        """Whether nothing is left to be given back."""
        return (
            not self.loading and self.restored >= (1 - 1e-9) * self.restitution * self.compression
        )


def face_owner(bodies: Bodies, nx: float, ny: float) -> int:
    """Which of two bodies has a face across a normal: 0 or 1, which is where both have one."""
    first, second = bodies
    if second is None:
        return 1
    off = [min(abs(u) for u in _along(body, nx, ny)) for body in (first[0], second[0])]
    return 0 if off[0] < off[1] - SQUARE else 1


def mutual_stiffness(bodies: Bodies, nx: float, ny: float) -> float:
    """Of the faces that meet, one behind the other, per width [N/m^2]; ``n`` out of the second."""
    first, second = bodies
    own = _face_stiffness(first, -nx, -ny)
    if second is None:
        return own
    other = _face_stiffness(second, nx, ny)
    return own * other / (own + other)


def yielding_patch(first: list[Corner], second: list[Corner], nx: float, ny: float) -> Patch | None:
    """Where two boxes reach into one another, with the middle of what yields there; None where they
    do not.

    Structure yields beside the contact, too, but not beyond an edge: a place at the edge of a face
    is pushed back from further inside.
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
    """Of structure that yields where the contact is ``width`` wide [m]."""
    first, second = bodies
    face = _face_width(first, nx, ny)
    if second is not None:
        face = min(face, _face_width(second, nx, ny))
    return min(max(width, LEAST_WIDTH) + SPREAD, face)


def advance_pulse(
    bodies: Bodies, pulse: Pulse, patch: Patch, h: float, *, friction: float
) -> tuple[Pulse, ContactImpulse | None]:
    """What the two exchange in the next ``h`` seconds; None for nothing.

    Args:
        bodies: both; None for what cannot move.
        pulse: until now.
        patch: where they overlap now.
        h: [s].
        friction: tangential per normal impulse at most.
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
    """Of the face that looks along (ux, uy) most [N/m^2]."""
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
    """By how much the front and the rear of a body stay shorter after a pulse [m].

    Args:
        body: whose face towards (ux, uy) was struck.
        pulse: at its end.
        stiffness: of both faces together, per width [N/m^2].
    """
    ahead, aside = _along(body[0], ux, uy)
    if abs(ahead) < abs(aside):
        return 0.0, 0.0
    front, rear, _ = body[1].stiffness
    own = stiffness / (front if ahead > 0 else rear)
    mean = KEPT * own * (pulse.depth - pulse.kept) * min(pulse.width / body[1].width, 1.0)
    left = body[1].length - LEAST_LENGTH
    mean = max(min(mean, left), 0.0)
    return (mean, 0.0) if ahead > 0 else (0.0, mean)
