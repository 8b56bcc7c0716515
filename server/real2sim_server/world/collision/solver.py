"""A clock step with collisions: substeps with contact impulses."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from ...geometry import Float, multiply_quaternions, quaternion_yaw, yaw_quaternion
from ..agents import rows_of
from ..boxes import first_contacts
from ..ego_motion import Motion
from ..traffic.driver import AgentPose
from .bodies import (
    BodyProperties,
    BodyState,
    Impact,
    ImpactedObject,
    ego_body,
    ego_motion,
    ego_properties,
    integrate_sliding,
    is_rolling,
    object_properties,
)
from .contact import ContactManifold, Pulse, contact_impulse, contact_manifold, corners
from .solver_state import (
    BACKGROUND,
    EGO,
    CollisionStep,
    PrescribedMotion,
    SolverState,
    end_pulse,
    exchange,
    make_dynamic,
    pair_impulse,
)

# Bodies that cross each other's corner between two substeps.

# Bodies that pass through each other's corner between two substeps.

MIN_MOTION = 0.05
"""Minimum relative motion in a substep that needs this check [m]."""

HEIGHT = 1.0
"""Height of both bodies for this check, because height ranges are compared elsewhere."""

Way = tuple[BodyState, BodyState]
"""A body before and after a substep."""


def crossing(first: Way, second: Way, shapes: tuple[BodyProperties, BodyProperties]) -> float:
    """Fraction of a substep at which two bodies, separate at its end, first overlap.

    inf if they never do or hardly move relative to each other.
    """
    (a, b), (c, d) = first, second
    if math.hypot((b.x - a.x) - (d.x - c.x), (b.y - a.y) - (d.y - c.y)) < MIN_MOTION:
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
    """A body ``seconds`` later at constant velocity."""
    return body._replace(
        x=body.x + seconds * body.vx,
        y=body.y + seconds * body.vy,
        yaw=body.yaw + seconds * body.turn,
    )


def _centre(body: BodyState, shape: BodyProperties) -> tuple[float, float]:
    ahead = shape.box_ahead
    return body.x + ahead * math.cos(body.yaw), body.y + ahead * math.sin(body.yaw)


SUBSTEP_US = 10_000
SLOP = 0.01
"""Overlap that remains between bodies in contact, so that they stay in contact [m]."""


@dataclass(frozen=True, eq=False)
class CollisionResult:
    """A step after its collisions, see :class:`CollisionStep`; ``impacts`` in order."""

    motion: Motion
    sliding: bool
    impacted: dict[str, ImpactedObject]
    impacts: tuple[Impact, ...]
    ignored_pairs: frozenset[frozenset[str]]
    pulses: dict[tuple[str, str], Pulse]
    ego_crush: tuple[float, float]


def solve_collisions(step: CollisionStep) -> CollisionResult:
    """Advance ego and objects by a step in substeps of 10 ms, with contact impulses.

    An impacted object stays under physics control. The ego returns to its controller once its
    wheels roll. Contacts are processed in the order of ids, so results are deterministic.
    """
    state = _begin(step)
    motion, sliding = step.motion, step.sliding
    substeps = -(-step.dt_us // SUBSTEP_US)
    for k in range(substeps):
        begin, end = step.dt_us * k // substeps, step.dt_us * (k + 1) // substeps
        if step.contact.swept:
            state.earlier = dict(state.bodies)
        motion = _move_ego(state, motion, sliding, begin, end)
        _move_objects(state, begin, end)
        state.now_us = end
        pushed = _resolve_contacts(state, (end - begin) * 1e-6)
        if pushed or sliding:
            motion = ego_motion(state.bodies[EGO], motion, step.spec)
            # Lasting contacts push a little in each substep, which the wheels must not undo.
            going_on = pushed and step.contact.progressive
            sliding = going_on or not is_rolling(motion, step.spec)
    return CollisionResult(
        motion,
        sliding,
        _impacted(state),
        _impacts(state),
        frozenset(state.ignored_pairs),
        state.pulses,
        state.ego_crush,
    )


def _begin(step: CollisionStep) -> SolverState:
    own = ego_properties(step.spec, step.ego_size)
    properties, bodies, heights = {EGO: own.shortened(*step.ego_crush)}, {}, {}
    bodies[EGO] = ego_body(step.motion, step.spec)
    bottom = step.height(step.motion.x, step.motion.y)
    heights[EGO] = (bottom, bottom + step.ego_size[2])
    friction = step.spec.vehicle.friction
    start = rows_of(step.before)
    prescribed: dict[str, PrescribedMotion] = {}
    for k, subject in enumerate(step.after.objects):
        i, size = subject.object_id, tuple(step.after.sizes[k].tolist())
        z = float(step.after.positions[k, 2])
        heights[i] = (z - size[2] / 2, z + size[2] / 2)
        if i in step.impacted:
            properties[i], bodies[i] = step.impacted[i].properties, step.impacted[i].body
            continue
        properties[i] = object_properties(subject, step.contact, friction=friction, size=size)
        motion = _prescribed_motion(step, start.get(i), k)
        bodies[i] = motion.after(0.0)._replace(turn=0.0)
        if i in start:
            prescribed[i] = motion
    reaches = {i: math.hypot(s.length, s.width) / 2 + 1 for i, s in properties.items()}
    dynamic = {EGO, *step.impacted}
    return SolverState(
        step,
        properties,
        bodies,
        prescribed,
        dynamic,
        heights,
        reaches,
        ignored_pairs=set(step.ignored_pairs),
        pulses=dict(step.pulses),
        ego_crush=step.ego_crush,
    )


def _prescribed_motion(step: CollisionStep, row: int | None, k: int) -> PrescribedMotion:
    """Prescribed motion of an object from ``row`` at the start to row ``k`` at the end.

    A new object is stationary.
    """
    source, j = (step.after, k) if row is None else (step.before, row)
    yaw = float(quaternion_yaw(source.quaternions[j]))
    turn = math.remainder(float(quaternion_yaw(step.after.quaternions[k])) - yaw, math.tau)
    (ax, ay, _), (bx, by, _) = source.positions[j].tolist(), step.after.positions[k].tolist()
    vx, vy, _ = step.after.velocities[k].tolist()
    return PrescribedMotion((ax, ay), (bx, by), yaw, turn, (vx, vy), turn / (step.dt_us * 1e-6))


def _move_ego(state: SolverState, motion: Motion, sliding: bool, begin: int, end: int) -> Motion:
    step = state.step
    if not sliding:
        motion = step.advance(motion, begin, end - begin)
        state.bodies[EGO] = ego_body(motion, step.spec)
        return motion
    command = step.command(motion, begin)
    spec = step.spec
    acceleration = min(max(command.acceleration, -spec.max_braking), spec.max_acceleration)
    state.bodies[EGO] = integrate_sliding(
        state.bodies[EGO],
        state.properties[EGO],
        (end - begin) * 1e-6,
        acceleration=acceleration,
        steering=motion.steering,
    )
    return ego_motion(state.bodies[EGO], motion, spec)


def _move_objects(state: SolverState, begin: int, end: int) -> None:
    fraction = end / state.step.dt_us
    for i in state.bodies:
        if i == EGO:
            continue
        if i in state.dynamic:
            state.bodies[i] = integrate_sliding(
                state.bodies[i], state.properties[i], (end - begin) * 1e-6
            )
        elif i in state.prescribed:
            state.bodies[i] = state.prescribed[i].after(fraction)


def _resolve_contacts(state: SolverState, h: float) -> bool:
    """Apply impulses to all bodies in contact; return whether the ego was pushed.

    ``h``: length of the substep [s].
    """
    ego_pushed = False
    for a, b in _near_pairs(state):
        pair = frozenset((a, b))
        manifold = contact_manifold(
            corners(state.bodies[a], state.properties[a]),
            corners(state.bodies[b], state.properties[b]),
        )
        if manifold is None and pair in state.ignored_pairs:
            state.ignored_pairs.discard(pair)
            continue
        if manifold is None:
            end_pulse(state, a, b)
            ego_pushed |= _resolve_crossing(state, a, b, h) and a == EGO
            continue
        if pair in state.ignored_pairs:
            continue
        ego_pushed |= _touch(state, a, b, manifold, h) and a == EGO
    if state.step.background is not None:
        for i in sorted(state.dynamic):
            manifold = state.step.background.manifold(state.bodies[i], state.properties[i])
            if manifold is not None:
                ego_pushed |= _touch(state, i, BACKGROUND, manifold, h) and i == EGO
            else:
                end_pulse(state, i, BACKGROUND)
    return ego_pushed


def _touch(state: SolverState, a: str, b: str, manifold: ContactManifold, h: float) -> bool:
    """Exchange momentum for ``h`` seconds, or instantaneously; return whether any was exchanged."""
    if state.step.contact.pulse:
        return exchange(state, a, b, manifold, h)
    return _apply_impulse(state, a, b, manifold)


def _resolve_crossing(state: SolverState, a: str, b: str, h: float) -> bool:
    """Apply an impulse to bodies that overlap only within the substep, at their first contact.

    Returns whether there was one.
    """
    if not (a in state.earlier and b in state.earlier):
        return False
    ends = {i: state.bodies[i] for i in (a, b)}
    first, second = ((state.earlier[i], state.bodies[i]) for i in (a, b))
    shapes = (state.properties[a], state.properties[b])
    fraction = crossing(first, second, shapes)
    if not math.isfinite(fraction):
        return False
    at = between(first, fraction), between(second, fraction)
    manifold = contact_manifold(corners(at[0], shapes[0]), corners(at[1], shapes[1]))
    if manifold is None:
        return False
    state.bodies[a], state.bodies[b] = at
    if not _apply_impulse(state, a, b, manifold):
        state.bodies.update(ends)
        return False
    for i in (a, b):
        state.bodies[i] = drifted(state.bodies[i], (1 - fraction) * h)
    return True


def _near_pairs(state: SolverState) -> list[tuple[str, str]]:
    """Pairs of a body under physics control and another one within reach, in the order of ids."""
    return [
        (a, b)
        for a, b in itertools.combinations(sorted(state.bodies), 2)
        if (a in state.dynamic or b in state.dynamic) and _within_reach(state, a, b)
    ]


def _within_reach(state: SolverState, a: str, b: str) -> bool:
    (low_a, high_a), (low_b, high_b) = state.heights[a], state.heights[b]
    (ax, ay, *_), (bx, by, *_) = state.bodies[a], state.bodies[b]
    apart = math.hypot(ax - bx, ay - by)
    return apart < state.reaches[a] + state.reaches[b] and low_a < high_b and low_b < high_a


def _apply_impulse(state: SolverState, a: str, b: str, manifold: ContactManifold) -> bool:
    """Exchange momentum; return whether any was exchanged."""
    contact, second = state.step.contact, None
    first = (state.bodies[a], state.properties[a])
    if b != BACKGROUND:
        second = (state.bodies[b], state.properties[b])
    impulse = contact_impulse(
        first, second, manifold, restitution=contact.restitution, friction=contact.friction
    )
    if impulse is None:
        pair_impulse(state, (a, b), manifold, approach=0.0)
        return False
    exchanged = pair_impulse(state, (a, b), manifold, approach=impulse.approach)
    after = first[0].pushed(first[1], manifold.x, manifold.y, impulse.jx, impulse.jy)
    dissipated = first[0].energy(first[1]) - after.energy(first[1])
    state.bodies[a] = _separated(after, manifold, 1.0 if second is None else 0.5)
    masses = (first[1].mass, math.inf)
    if second is not None:
        other = second[0].pushed(second[1], manifold.x, manifold.y, -impulse.jx, -impulse.jy)
        dissipated += second[0].energy(second[1]) - other.energy(second[1])
        state.bodies[b] = _separated(other, manifold, -0.5)
        masses = (first[1].mass, second[1].mass)
    make_dynamic(state, {a, b} - {BACKGROUND} - state.dynamic)
    exchanged.jx, exchanged.jy = exchanged.jx + impulse.jx, exchanged.jy + impulse.jy
    exchanged.energy, exchanged.masses = exchanged.energy + dissipated, masses
    return True


def _separated(body: BodyState, manifold: ContactManifold, fraction: float) -> BodyState:
    """The body moved out of the overlap, most of the way."""
    depth = fraction * max(manifold.depth - SLOP, 0.0) * 0.5
    return body._replace(x=body.x + depth * manifold.nx, y=body.y + depth * manifold.ny)


def _impacted(state: SolverState) -> dict[str, ImpactedObject]:
    impacted = {}
    for k, subject in enumerate(state.step.after.objects):
        i = subject.object_id
        if i not in state.dynamic:
            continue
        body = state.bodies[i]
        old = state.step.impacted.get(i)
        x, y, z = state.step.after.positions[k].tolist()
        height = old.height if old else z - state.step.height(x, y)
        quaternion = state.step.after.quaternions[k]
        turned = body.yaw - float(quaternion_yaw(quaternion))
        w, qx, qy, qz = multiply_quaternions(yaw_quaternion(turned), quaternion).tolist()
        pose = AgentPose(
            (body.x, body.y, state.step.height(body.x, body.y) + height),
            (w, qx, qy, qz),
            body.yaw,
            (body.vx, body.vy, 0.0),
        )
        impacted[i] = (
            old.at(body, pose, state.properties[i])
            if old
            else ImpactedObject(subject, state.properties[i], body, height, pose)
        )
    return impacted


def _impacts(state: SolverState) -> tuple[Impact, ...]:
    impacts = []
    for (a, b), exchanged in state.impulses.items():
        strength = math.hypot(exchanged.jx, exchanged.jy)
        energy = exchanged.energy
        if exchanged.whole is not None:
            strength, energy = exchanged.whole, exchanged.lost
        impacts.append(
            Impact(
                object_id=None if b == BACKGROUND else b,
                other_id=None if a == EGO else a,
                t_us=state.step.t_us + state.step.dt_us,
                point=(exchanged.manifold.x, exchanged.manifold.y),
                normal=(exchanged.manifold.nx, exchanged.manifold.ny),
                approach_speed=exchanged.approach,
                relative_speed=exchanged.relative,
                impulse=(exchanged.jx, exchanged.jy),
                delta_v=strength / exchanged.masses[0],
                object_delta_v=strength / exchanged.masses[1],
                energy=energy,
                side=exchanged.side,
                speeds=exchanged.speeds,
                began_us=exchanged.began_us,
                since=(exchanged.began_us - state.step.t_us) / state.step.dt_us,
                participants=exchanged.participants,
                whole=exchanged.whole,
                stiffness=exchanged.stiffness,
                breadth=exchanged.breadth,
            )
        )
    return tuple(impacts)
