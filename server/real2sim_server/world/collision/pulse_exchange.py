"""Impacts that take time, among all bodies of a step: when they begin, go on and end.

What two bodies exchange in an instant is in ``pulse``; here are the contacts that have begun, the
record of what was exchanged, and how much shorter the bodies are afterwards.
"""

from __future__ import annotations

import math

from .face_pulse import FaceContact, Push, advance_face_pulse, face_contact
from .manifold import SLOW, ContactManifold, contact_impulse, corners, overlap_patch
from .pulse import (
    Patch,
    Pulse,
    advance_pulse,
    contact_width,
    face_owner,
    mutual_stiffness,
    shortened,
    yielding_patch,
)
from .solver_state import (
    BACKGROUND,
    EGO,
    PairImpulse,
    SolverState,
    bodies_of,
    make_dynamic,
    masses_of,
    pair_impulse,
    pushed,
)


def exchange(state: SolverState, a: str, b: str, manifold: ContactManifold, h: float) -> bool:
    """Exchange momentum for ``h`` seconds; whether there was any to exchange."""
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
    """The pulse of two bodies that have just met; None where they part already."""
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
    """Two bodies have parted."""
    pulse = state.pulses.pop((a, b), None)
    if pulse is not None:
        _shorten(state, a, b, pulse)


def _shorten(state: SolverState, a: str, b: str, pulse: Pulse) -> None:
    """The ends of two bodies stay shorter by what was crushed for good."""
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
    """Where two vehicles or objects meet, in strips; None for the background, and for nowhere."""
    first, second = bodies_of(state, a, b)
    if second is None or not state.step.contact.distributed:
        return None
    return face_contact(corners(*first), corners(*second), nx, ny)


def _patch(state: SolverState, a: str, b: str, nx: float, ny: float) -> Patch | None:
    """Where two bodies reach into one another, seen along a normal."""
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
