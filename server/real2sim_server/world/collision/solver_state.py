"""Collision solver state within a step: bodies, contacts and exchanged impulses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto.episode import ContactSpec, EgoSpec

from ..agents import Agents
from ..boxes import REAR_OVERHANG
from ..driving import Command
from ..ego_motion import Motion
from ..scoring.instant import Side, side_of_contact
from .bodies import MUTUAL_STIFFNESS, BodyProperties, BodyState, ImpactedObject, ImpactParticipant
from .contact import (
    SLOW,
    Bodies,
    ContactImpulse,
    ContactManifold,
    Corner,
    ObstacleGrid,
    Patch,
    Pulse,
    advance_pulse,
    contact_impulse,
    contact_manifold,
    contact_width,
    corners,
    face_owner,
    mutual_stiffness,
    overlap_patch,
    overlap_shape,
    patch_of,
    relative_motion,
    shortened,
    span_across,
    yielding_patch,
)

EGO = ""
"""Key of the ego among the bodies; no object has an empty id."""
BACKGROUND = "\0"


@dataclass(frozen=True, eq=False)
class CollisionStep:
    """A step before its collisions are solved.

    Attributes:
        t_us, dt_us: start and duration of the step [us].
        motion, sliding: ego motion, and whether it is under physics control.
        advance: ``advance(motion, since_us, us)``, moves the ego with its controller.
        command: ``command(motion, since_us)``, the controller command.
        spec, ego_size, contact: parameters.
        before, after: objects as moved by their drivers, including impacted ones.
        impacted: objects under physics control, by id.
        ignored_pairs: overlapping bodies that do not collide.
        background: obstacles of the background; None if they are ignored.
        height: ground height [m] at x, y.
        pulses: ongoing impacts, by pair of names.
        ego_crush: permanent shortening of the ego's front and rear [m].
    """

    t_us: int
    dt_us: int
    motion: Motion
    sliding: bool
    advance: Callable[[Motion, int, int], Motion]
    command: Callable[[Motion, int], Command]
    spec: EgoSpec
    ego_size: tuple[float, float, float]
    contact: ContactSpec
    before: Agents
    after: Agents
    impacted: Mapping[str, ImpactedObject]
    ignored_pairs: frozenset[frozenset[str]]
    background: ObstacleGrid | None
    height: Callable[[float, float], float]
    pulses: Mapping[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)


@dataclass(eq=False)
class PairImpulse:
    """Impulse and energy exchanged by two bodies in this step."""

    manifold: ContactManifold
    approach: float
    relative: float
    side: Side
    speeds: tuple[float, float]
    began_us: int
    participants: tuple[ImpactParticipant, ImpactParticipant | None]
    jx: float = 0.0
    jy: float = 0.0
    energy: float = 0.0
    masses: tuple[float, float] = (math.inf, math.inf)
    whole: float | None = None
    lost: float = 0.0
    stiffness: float = MUTUAL_STIFFNESS
    breadth: tuple[float, float] | None = None


class PrescribedMotion(NamedTuple):
    """Motion of an object by its driver during the step.

    Positions at the start and end [m], initial yaw and its change [rad], velocity [m/s] and yaw
    rate [rad/s].
    """

    start: tuple[float, float]
    end: tuple[float, float]
    yaw: float
    turn: float
    velocity: tuple[float, float]
    rate: float

    def after(self, fraction: float) -> BodyState:
        """The object after a fraction of the step."""
        (ax, ay), (bx, by), rest = self.start, self.end, 1 - fraction
        x, y = rest * ax + fraction * bx, rest * ay + fraction * by
        return BodyState(x, y, self.yaw + fraction * self.turn, *self.velocity, self.rate)


@dataclass(eq=False)
class SolverState:
    """Bodies by id during the substeps.

    ``heights``: bottom and top of each box [m]. ``earlier``: bodies before the current substep, if
    contacts within it count.
    """

    step: CollisionStep
    properties: dict[str, BodyProperties]
    bodies: dict[str, BodyState]
    prescribed: dict[str, PrescribedMotion]
    dynamic: set[str]
    heights: dict[str, tuple[float, float]]
    reaches: dict[str, float]
    impulses: dict[tuple[str, str], PairImpulse] = field(default_factory=dict)
    ignored_pairs: set[frozenset[str]] = field(default_factory=set)
    earlier: dict[str, BodyState] = field(default_factory=dict)
    now_us: int = 0
    pulses: dict[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)


def bodies_of(state: SolverState, a: str, b: str) -> Bodies:
    """Current state of two bodies; None for the background."""
    second = None if b == BACKGROUND else (state.bodies[b], state.properties[b])
    return (state.bodies[a], state.properties[a]), second


def masses_of(bodies: Bodies) -> tuple[float, float]:
    """Masses of both bodies [kg]; infinite for the background."""
    first, second = bodies
    return first[1].mass, math.inf if second is None else second[1].mass


def pushed(
    bodies: Bodies, at: tuple[float, float], impulse: ContactImpulse
) -> tuple[tuple[BodyState, BodyState | None], float]:
    """Two bodies after an impulse on the first one at a point, and the lost energy [J]."""
    (first, properties), second = bodies
    after = first.pushed(properties, *at, impulse.jx, impulse.jy)
    lost = first.energy(properties) - after.energy(properties)
    if second is None:
        return (after, None), lost
    other = second[0].pushed(second[1], *at, -impulse.jx, -impulse.jy)
    lost += second[0].energy(second[1]) - other.energy(second[1])
    return (after, other), lost


def pair_impulse(
    state: SolverState, pair: tuple[str, str], manifold: ContactManifold, *, approach: float
) -> PairImpulse:
    """The exchange record of two bodies; a new one at the start of their contact."""
    exchanged = state.impulses.get(pair)
    if exchanged is None:
        first = (state.bodies[pair[0]], state.properties[pair[0]])
        vx, vy = first[0].vx, first[0].vy
        speeds: tuple[float, float] = (math.hypot(vx, vy), 0.0)
        side: Side = "stopped_track"
        if pair[1] != BACKGROUND:
            second = (state.bodies[pair[1]], state.properties[pair[1]])
            speeds = (speeds[0], math.hypot(second[0].vx, second[0].vy))
            vx, vy = vx - second[0].vx, vy - second[0].vy
            reversing = pair[0] == EGO and state.step.motion.reversing
            side = _side(first, second, speeds, reversing=reversing)
        participants = (
            _participant(state, pair[0]),
            None if pair[1] == BACKGROUND else _participant(state, pair[1]),
        )
        began_us = state.step.t_us + state.now_us
        relative = math.hypot(vx, vy)
        exchanged = PairImpulse(manifold, approach, relative, side, speeds, began_us, participants)
        state.impulses[pair] = exchanged
    return exchanged


def _participant(state: SolverState, i: str) -> ImpactParticipant:
    return ImpactParticipant(state.properties[i], state.bodies[i], *state.heights[i])


def _side(
    first: tuple[BodyState, BodyProperties],
    second: tuple[BodyState, BodyProperties],
    speeds: tuple[float, float],
    *,
    reversing: bool,
) -> Side:
    boxes = []
    for body, properties in (first, second):
        x = body.x + properties.box_ahead * math.cos(body.yaw)
        y = body.y + properties.box_ahead * math.sin(body.yaw)
        boxes.append((x, y, body.yaw, properties.length, properties.width))
    axle = boxes[0][3] / 2 - REAR_OVERHANG
    (ego, other), (ego_speed, speed) = boxes, speeds
    return side_of_contact(ego, ego_speed, other, speed, axle=axle, reversing=reversing)


def make_dynamic(state: SolverState, impacted_now: set[str]) -> None:
    """Put bodies under physics control.

    Existing overlaps other than this contact are ignored until the bodies separate.
    """
    for i in sorted(impacted_now):
        shape = corners(state.bodies[i], state.properties[i])
        for j in sorted(state.bodies.keys() - impacted_now - state.dynamic):
            reach = state.properties[i].length + state.properties[j].length
            near = math.dist(state.bodies[i][:2], state.bodies[j][:2]) < reach
            if (
                near
                and contact_manifold(shape, corners(state.bodies[j], state.properties[j]))
                is not None
            ):
                state.ignored_pairs.add(frozenset((i, j)))
    state.dynamic |= impacted_now


# --- Impact along a face -------------------------------------------------------------------------

# Strips of structure yield independently. Force acts only on strips that are still approaching and
# grows with their penetration depth, as on the points around a vehicle in SMAC (McHenry 1971). If
# one body rotates away, force remains on the strips still in compression and moves along the face;
# a single force at the contact centre would end as soon as that centre stops.
#
# The force of vehicles is progressive: the outer structure folds at a low force that grows with
# the folding speed, and the rails behind it have the published stiffness. An impact at 10 m/s
# therefore lasts longer than one at 30 m/s.

STRIPS = 16
SHALLOW, DEEPENING, RATE = 0.2, 0.35, 0.015
"""Progressive force between vehicles: fraction of the stiffness at zero depth, increase per metre
of depth, and equivalent depth of a closing speed of 1 m/s [m]. Fitted to the durations and forces
of MPM car impacts: 57 kN at once and 88 kN at 0.5 m in a rear-end impact at 10 m/s; 153 kN at once
and 435 kN at 1.25 m head-on at 30 m/s."""


class Strip(NamedTuple):
    """A strip of a contact: centre x, y and penetration depth [m]."""

    x: float
    y: float
    depth: float


class FaceContact(NamedTuple):
    """The overlap of two boxes: as a whole, and in strips of equal width."""

    patch: Patch
    strips: tuple[Strip, ...]


class Push(NamedTuple):
    """An impulse on the first body at x, y [m]; the second body receives the opposite."""

    x: float
    y: float
    impulse: ContactImpulse

    def on(self, bodies: Bodies) -> Bodies:
        """Both bodies after the push."""
        (first, properties), second = bodies
        jx, jy, _ = self.impulse
        pushed = first.pushed(properties, self.x, self.y, jx, jy), properties
        if second is None:
            return pushed, None
        return pushed, (second[0].pushed(second[1], self.x, self.y, -jx, -jy), second[1])


def face_contact(
    first: list[Corner], second: list[Corner], nx: float, ny: float
) -> FaceContact | None:
    """The overlap of two boxes along a unit normal; None without overlap."""
    shape = overlap_shape(first, second)
    found = patch_of(shape, nx, ny)
    if found is None:
        return None
    low, high = span_across(shape, nx, ny)
    turned = [(x * nx + y * ny, y * nx - x * ny) for x, y in shape]
    strips = []
    for k in range(STRIPS):
        across = low + (k + 0.5) * (high - low) / STRIPS
        begin, end = _chord(turned, across)
        middle = (begin + end) / 2
        x, y = middle * nx - across * ny, middle * ny + across * nx
        strips.append(Strip(x, y, end - begin))
    return FaceContact(Patch(*found), tuple(strips))


def advance_face_pulse(
    bodies: Bodies,
    pulse: Pulse,
    contact: FaceContact,
    h: float,
    *,
    friction: float,
    progressive: bool = False,
) -> tuple[Pulse, list[Push]]:
    """The pushes exchanged in the next ``h`` seconds, in order.

    Args:
        bodies: both bodies; None for an immovable one.
        pulse: impact so far.
        contact: current overlap.
        h: duration [s].
        friction: friction coefficient.
        progressive: whether the force grows with closing speed and superlinearly with depth.
    """
    nx, ny = pulse.along(bodies)
    if contact.patch.depth > pulse.depth:
        pulse = pulse._replace(depth=contact.patch.depth, width=contact.patch.width)
    # Impulse per depth of a strip [N s/m].
    stiffness = mutual_stiffness(bodies, nx, ny) * contact.patch.width / STRIPS * h
    rate = RATE if progressive else 0.0
    loading = _progressive(contact, 0.0) if progressive else contact
    pulse, pushes = _compressed(bodies, pulse, loading, (stiffness, rate), friction)
    for push in pushes:
        bodies = push.on(bodies)
    if not pulse.loading:
        if progressive:
            contact = _progressive(contact, pulse.restitution)
        pulse, back = _restored(bodies, pulse, contact, stiffness, friction)
        pushes += back
    return pulse, pushes


def _compressed(
    bodies: Bodies,
    pulse: Pulse,
    contact: FaceContact,
    law: tuple[float, float],
    friction: float,
) -> tuple[Pulse, list[Push]]:
    """The push of approaching strips, limited to stopping them.

    ``law``: impulse per depth of a strip [N s/m], and equivalent depth per speed [s].
    """
    nx, ny = pulse.along(bodies)
    stiffness, rate = law
    parting = [(s, _parting(bodies, s, nx, ny)) for s in contact.strips]
    approaching = [s._replace(depth=s.depth - rate * v) for s, v in parting if v < 0.0]
    depth, place = _resultant(approaching, nx, ny)
    if depth <= 0.0:
        return pulse._replace(loading=False, settled=contact.patch.depth), []
    motion = relative_motion(bodies, place)
    stopping = contact_impulse(*bodies, place, restitution=0.0, friction=friction)
    most = motion.normal_part(stopping) if stopping is not None else 0.0
    push = min(most, stiffness * depth)
    pulse = pulse._replace(compression=pulse.compression + push, loading=push < most)
    if not pulse.loading:
        pulse = pulse._replace(settled=contact.patch.depth)
    return pulse, [Push(place.x, place.y, motion.limited(push, friction))]


def _restored(
    bodies: Bodies, pulse: Pulse, contact: FaceContact, stiffness: float, friction: float
) -> tuple[Pulse, list[Push]]:
    """The push that restores part of the compression impulse, along the whole contact."""
    nx, ny = pulse.along(bodies)
    depth, place = _resultant(contact.strips, nx, ny)
    left = pulse.restitution * pulse.compression - pulse.restored
    back = max(min(pulse.restitution * stiffness * depth, left), 0.0)
    if back == 0.0:
        return pulse, []
    motion = relative_motion(bodies, place)
    pulse = pulse._replace(restored=pulse.restored + back)
    return pulse, [Push(place.x, place.y, motion.limited(back, friction))]


def _progressive(contact: FaceContact, restitution: float) -> FaceContact:
    """A contact with effective depths, for which the linear stiffness gives the progressive force.

    Fully elastic contacts use the linear stiffness.
    """
    strips = []
    for s in contact.strips:
        share = min(SHALLOW + DEEPENING * s.depth, 1.0)
        strips.append(s._replace(depth=(share + restitution * (1.0 - share)) * s.depth))
    return contact._replace(strips=tuple(strips))


def _resultant(
    strips: tuple[Strip, ...] | list[Strip], nx: float, ny: float
) -> tuple[float, ContactManifold]:
    """Sum of the depths of strips [m], and their depth-weighted centre."""
    depth = sum(s.depth for s in strips)
    if depth <= 0.0:
        return 0.0, ContactManifold(0.0, 0.0, nx, ny, 0.0)
    x = sum(s.depth * s.x for s in strips) / depth
    y = sum(s.depth * s.y for s in strips) / depth
    return depth, ContactManifold(x, y, nx, ny, depth)


def _parting(bodies: Bodies, strip: Strip, nx: float, ny: float) -> float:
    """Separation speed of two bodies along the normal at a strip [m/s]."""
    first, second = bodies
    vx, vy = first[0].velocity_at(strip.x, strip.y)
    if second is not None:
        wx, wy = second[0].velocity_at(strip.x, strip.y)
        vx, vy = vx - wx, vy - wy
    return vx * nx + vy * ny


def _chord(shape: list[Corner], across: float) -> tuple[float, float]:
    """Interval of a convex shape along the normal, at a position across it [m].

    Corners are given as (along, across).
    """
    found = []
    a, s = shape[-1]
    for b, t in shape:
        if (s <= across) != (t <= across):
            found.append(a + (b - a) * (across - s) / (t - s))
        a, s = b, t
    return (min(found), max(found)) if found else (0.0, 0.0)


# --- Ongoing impacts -----------------------------------------------------------------------------

# Active contacts, the record of their impulses, and the permanent shortening of the bodies.
# :mod:`.contact` computes single exchanges.


def exchange(state: SolverState, a: str, b: str, manifold: ContactManifold, h: float) -> bool:
    """Exchange momentum for ``h`` seconds; return whether any was exchanged."""
    pulse = state.pulses.get((a, b)) or _begin_pulse(state, a, b, manifold)
    if pulse is None:
        return False
    bodies, contact = bodies_of(state, a, b), state.step.contact
    nx, ny = pulse.along(bodies)
    face = _face(state, a, b, nx, ny)
    patch = face.patch if face is not None else _patch(state, a, b, nx, ny)
    if patch is None:
        return False
    if contact.residual_crush and pulse.has_settled(patch):
        state.pulses[a, b] = pulse
        pair_impulse(state, (a, b), manifold, approach=0.0)
        return False
    if face is not None:
        pulse, pushes = advance_face_pulse(
            bodies,
            pulse,
            face,
            h,
            friction=contact.friction,
            progressive=contact.progressive and all(b is None or b[1].vehicle for b in bodies),
        )
    else:
        pulse, impulse = advance_pulse(bodies, pulse, patch, h, friction=contact.friction)
        pushes = [] if impulse is None else [Push(patch.x, patch.y, impulse)]
    if pulse.over and pulse.depth > pulse.kept:
        _shorten(state, a, b, pulse)
        left = _patch(state, a, b, nx, ny)
        settled = 0.0 if left is None else left.depth
        pulse = pulse._replace(kept=pulse.depth, settled=settled)
    state.pulses[a, b] = pulse
    exchanged = pair_impulse(state, (a, b), manifold, approach=0.0)
    for push in pushes:
        _push(state, a, b, push, exchanged)
    return bool(pushes)


def _push(state: SolverState, a: str, b: str, push: Push, exchanged: PairImpulse) -> None:
    bodies, impulse = bodies_of(state, a, b), push.impulse
    after, dissipated = pushed(bodies, (push.x, push.y), impulse)
    state.bodies[a] = after[0]
    if after[1] is not None:
        state.bodies[b] = after[1]
    exchanged.jx, exchanged.jy = exchanged.jx + impulse.jx, exchanged.jy + impulse.jy
    exchanged.energy, exchanged.masses = exchanged.energy + dissipated, masses_of(bodies)


def _begin_pulse(state: SolverState, a: str, b: str, manifold: ContactManifold) -> Pulse | None:
    """The pulse of a new contact; None if the bodies are already separating."""
    bodies, contact = bodies_of(state, a, b), state.step.contact
    whole = contact_impulse(
        *bodies, manifold, restitution=contact.restitution, friction=contact.friction
    )
    if whole is None:
        pair_impulse(state, (a, b), manifold, approach=0.0)
        return None
    nx, ny = manifold.nx, manifold.ny
    exchanged = pair_impulse(state, (a, b), manifold, approach=whole.approach)
    exchanged.whole, exchanged.masses = math.hypot(whole.jx, whole.jy), masses_of(bodies)
    exchanged.lost = pushed(bodies, (manifold.x, manifold.y), whole)[1]
    patch = _patch(state, a, b, nx, ny)
    width = contact_width(bodies, patch.width if patch is not None else 0.0, nx, ny)
    exchanged.stiffness = mutual_stiffness(bodies, nx, ny) * width
    if b == BACKGROUND and state.step.background is not None:
        exchanged.breadth = state.step.background.breadth(manifold.x, manifold.y, nx, ny)
    make_dynamic(state, {a, b} - {BACKGROUND} - state.dynamic)
    restitution = contact.restitution if whole.approach > SLOW else 0.0
    face = face_owner(bodies, nx, ny) if contact.distributed else 1
    owner = bodies[face]
    yaw = owner[0].yaw if owner is not None else 0.0
    return Pulse(math.atan2(ny, nx) - yaw, restitution, face=face)


def end_pulse(state: SolverState, a: str, b: str) -> None:
    """End the pulse of two separated bodies."""
    pulse = state.pulses.pop((a, b), None)
    if pulse is not None:
        _shorten(state, a, b, pulse)


def _shorten(state: SolverState, a: str, b: str, pulse: Pulse) -> None:
    """Shorten the ends of two bodies by their permanent crush."""
    bodies = bodies_of(state, a, b)
    nx, ny = pulse.along(bodies)
    stiffness = mutual_stiffness(bodies, nx, ny)
    for i, body, sign in ((a, bodies[0], -1.0), (b, bodies[1], 1.0)):
        if body is None:
            continue
        front, rear = shortened(body, pulse, sign * nx, sign * ny, stiffness)
        state.properties[i] = body[1].shortened(front, rear)
        if i == EGO:
            state.ego_crush = state.ego_crush[0] + front, state.ego_crush[1] + rear


def _face(state: SolverState, a: str, b: str, nx: float, ny: float) -> FaceContact | None:
    """The contact of two objects in strips; None for the background or without overlap."""
    first, second = bodies_of(state, a, b)
    if second is None or not state.step.contact.distributed:
        return None
    return face_contact(corners(*first), corners(*second), nx, ny)


def _patch(state: SolverState, a: str, b: str, nx: float, ny: float) -> Patch | None:
    """The overlap of two bodies along a normal."""
    first, second = bodies_of(state, a, b)
    if second is None:
        assert state.step.background is not None
        return state.step.background.patch(*first, nx, ny)
    shapes = corners(*first), corners(*second)
    contact = state.step.contact
    if contact.residual_crush and not contact.distributed:
        return yielding_patch(*shapes, nx, ny)
    found = overlap_patch(*shapes, nx, ny)
    return None if found is None else Patch(*found)
