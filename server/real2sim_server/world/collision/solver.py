"""A step of the clock with collisions: substeps, each with contact impulses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto.episode import ContactSpec, EgoSpec

from ...geometry.rotation import multiply_quaternions, quaternion_yaw, yaw_quaternion
from ..agents import Agents, rows_of
from ..driving import Command
from ..ego.box import REAR_OVERHANG
from ..ego.motion import Motion
from ..scoring.contact_side import side_of_contact
from ..scoring.instant import Side
from ..traffic.driver import AgentPose
from .bodies import (
    ImpactedObject,
    ego_body,
    ego_motion,
    ego_properties,
    is_rolling,
    object_properties,
)
from .crossing import between, crossing, drifted
from .impact import MUTUAL_STIFFNESS, Impact, ImpactParticipant
from .manifold import (
    SLOW,
    Bodies,
    ContactImpulse,
    ContactManifold,
    contact_impulse,
    contact_manifold,
    corners,
    overlap_patch,
)
from .obstacles import ObstacleGrid
from .pulse import Patch, Pulse, advance_pulse, contact_width, mutual_stiffness, shortened
from .rigid_body import BodyProperties, BodyState, integrate_sliding

SUBSTEP_US = 10_000
EGO = ""
"""Key of the ego among the bodies; no object has an empty id."""
BACKGROUND = "\0"

SLOP = 0.01
"""Overlap that is left between bodies in contact, so that they stay in contact [m]."""


@dataclass(frozen=True, eq=False)
class CollisionStep:
    """A step of the clock before its collisions are solved.

    Attributes:
        t_us, dt_us: the step [us].
        motion, sliding: the ego, and whether physics moves it rather than its controller.
        advance: ``advance(motion, since_us, us)`` moves the ego by its controller.
        command: of the controller, in a motion so many microseconds after the start.
        spec, ego_size, contact: parameters.
        before, after: objects as their drivers move them; impacted ones among them.
        impacted: objects that physics moves, by id.
        ignored_pairs: bodies that overlapped without an impact; they do not collide.
        background: obstacles of the background; None where they are left out.
        height: ground height [m] at x, y.
        pulses: impacts under way, by the names of the two.
        ego_crush: by how much the ego's front and rear are shorter than they were [m].
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


@dataclass(eq=False)
class _PairImpulse:
    """Impulse and energy that two bodies have exchanged in this step."""

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


class _PrescribedMotion(NamedTuple):
    """How its driver moves an object through the step: places at the start and the end [m], yaw at
    the start and its change [rad], velocity [m/s] and turn rate [rad/s]."""

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
class _SolverState:
    """Bodies by id while the substeps run; ``heights``: bottom and top of each box [m];
    ``earlier``: the bodies before the present substep, where what happens within it counts."""

    step: CollisionStep
    properties: dict[str, BodyProperties]
    bodies: dict[str, BodyState]
    prescribed: dict[str, _PrescribedMotion]
    dynamic: set[str]
    heights: dict[str, tuple[float, float]]
    reaches: dict[str, float]
    impulses: dict[tuple[str, str], _PairImpulse] = field(default_factory=dict)
    ignored_pairs: set[frozenset[str]] = field(default_factory=set)
    earlier: dict[str, BodyState] = field(default_factory=dict)
    now_us: int = 0
    pulses: dict[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)


def solve_collisions(step: CollisionStep) -> CollisionResult:
    """Move ego and objects through a step in substeps of 10 ms; bodies in contact exchange
    impulses.

    An object with an impact is moved by physics from then on; the ego goes by its controller
    again once its wheels roll. Contacts are handled in the order of ids, so that the outcome is
    the same whatever else runs.
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
        if _resolve_contacts(state, (end - begin) * 1e-6):
            sliding = True
        if sliding:
            motion = ego_motion(state.bodies[EGO], motion, step.spec)
            sliding = not is_rolling(motion, step.spec)
    return CollisionResult(
        motion,
        sliding,
        _impacted(state),
        _impacts(state),
        frozenset(state.ignored_pairs),
        state.pulses,
        state.ego_crush,
    )


def _begin(step: CollisionStep) -> _SolverState:
    own = ego_properties(step.spec, step.ego_size)
    properties, bodies, heights = {EGO: own.shortened(*step.ego_crush)}, {}, {}
    bodies[EGO] = ego_body(step.motion, step.spec)
    bottom = step.height(step.motion.x, step.motion.y)
    heights[EGO] = (bottom, bottom + step.ego_size[2])
    friction = step.spec.vehicle.friction
    start = rows_of(step.before)
    prescribed: dict[str, _PrescribedMotion] = {}
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
    return _SolverState(
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


def _prescribed_motion(step: CollisionStep, row: int | None, k: int) -> _PrescribedMotion:
    """Of the object that is in row ``k`` at the end and was in another at the start; an object
    that has just appeared stands where it is."""
    source, j = (step.after, k) if row is None else (step.before, row)
    yaw = float(quaternion_yaw(source.quaternions[j]))
    turn = math.remainder(float(quaternion_yaw(step.after.quaternions[k])) - yaw, math.tau)
    (ax, ay, _), (bx, by, _) = source.positions[j].tolist(), step.after.positions[k].tolist()
    vx, vy, _ = step.after.velocities[k].tolist()
    return _PrescribedMotion((ax, ay), (bx, by), yaw, turn, (vx, vy), turn / (step.dt_us * 1e-6))


def _move_ego(state: _SolverState, motion: Motion, sliding: bool, begin: int, end: int) -> Motion:
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


def _move_objects(state: _SolverState, begin: int, end: int) -> None:
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


def _resolve_contacts(state: _SolverState, h: float) -> bool:
    """Let all bodies in contact exchange impulses; whether the ego was pushed in the substep of
    ``h`` seconds."""
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
            _end_pulse(state, a, b)
            ego_pushed |= _resolve_crossing(state, a, b, h) and a == EGO
            continue
        if pair in state.ignored_pairs:
            continue
        ego_pushed |= _exchange(state, a, b, manifold, h) and a == EGO
    if state.step.background is not None:
        for i in sorted(state.dynamic):
            manifold = state.step.background.manifold(state.bodies[i], state.properties[i])
            if manifold is not None:
                ego_pushed |= _exchange(state, i, BACKGROUND, manifold, h) and i == EGO
            else:
                _end_pulse(state, i, BACKGROUND)
    return ego_pushed


def _exchange(state: _SolverState, a: str, b: str, manifold: ContactManifold, h: float) -> bool:
    """Exchange momentum for ``h`` seconds, or at once where impacts are sudden; whether there was
    any to exchange."""
    if not state.step.contact.pulse:
        return _apply_impulse(state, a, b, manifold)
    pulse = state.pulses.get((a, b)) or _begin_pulse(state, a, b, manifold)
    if pulse is None:
        return False
    bodies = _bodies(state, a, b)
    angle = pulse.normal + (bodies[1][0].yaw if bodies[1] is not None else 0.0)
    patch = _patch(state, a, b, math.cos(angle), math.sin(angle))
    if patch is None:
        return False
    friction = state.step.contact.friction
    pulse, impulse = advance_pulse(bodies, pulse, patch, h, friction=friction)
    if pulse.over and pulse.depth > pulse.kept:
        _shorten(state, a, b, pulse)
        pulse = pulse._replace(kept=pulse.depth)
    state.pulses[a, b] = pulse
    exchanged = _pair_impulse(state, (a, b), manifold, approach=0.0)
    if impulse is None:
        return False
    after, dissipated = _pushed(bodies, (patch.x, patch.y), impulse)
    state.bodies[a] = after[0]
    if after[1] is not None:
        state.bodies[b] = after[1]
    exchanged.jx, exchanged.jy = exchanged.jx + impulse.jx, exchanged.jy + impulse.jy
    exchanged.energy, exchanged.masses = exchanged.energy + dissipated, _masses(bodies)
    return True


def _begin_pulse(state: _SolverState, a: str, b: str, manifold: ContactManifold) -> Pulse | None:
    """The pulse of two bodies that have just met; None where they part already."""
    bodies, contact = _bodies(state, a, b), state.step.contact
    whole = contact_impulse(
        *bodies, manifold, restitution=contact.restitution, friction=contact.friction
    )
    if whole is None:
        _pair_impulse(state, (a, b), manifold, approach=0.0)
        return None
    nx, ny = manifold.nx, manifold.ny
    exchanged = _pair_impulse(state, (a, b), manifold, approach=whole.approach)
    exchanged.whole, exchanged.masses = math.hypot(whole.jx, whole.jy), _masses(bodies)
    exchanged.lost = _pushed(bodies, (manifold.x, manifold.y), whole)[1]
    patch = _patch(state, a, b, nx, ny)
    width = contact_width(bodies, patch.width if patch is not None else 0.0, nx, ny)
    exchanged.stiffness = mutual_stiffness(bodies, nx, ny) * width
    if b == BACKGROUND and state.step.background is not None:
        exchanged.breadth = state.step.background.breadth(manifold.x, manifold.y, nx, ny)
    _make_dynamic(state, {a, b} - {BACKGROUND} - state.dynamic)
    yaw = bodies[1][0].yaw if bodies[1] is not None else 0.0
    restitution = contact.restitution if whole.approach > SLOW else 0.0
    return Pulse(math.atan2(ny, nx) - yaw, restitution)


def _end_pulse(state: _SolverState, a: str, b: str) -> None:
    """Two bodies have parted."""
    pulse = state.pulses.pop((a, b), None)
    if pulse is not None:
        _shorten(state, a, b, pulse)


def _shorten(state: _SolverState, a: str, b: str, pulse: Pulse) -> None:
    """The ends of two bodies stay shorter by what was crushed for good."""
    bodies = _bodies(state, a, b)
    angle = pulse.normal + (bodies[1][0].yaw if bodies[1] is not None else 0.0)
    nx, ny = math.cos(angle), math.sin(angle)
    stiffness = mutual_stiffness(bodies, nx, ny)
    for i, body, sign in ((a, bodies[0], -1.0), (b, bodies[1], 1.0)):
        if body is None:
            continue
        front, rear = shortened(body, pulse, sign * nx, sign * ny, stiffness)
        state.properties[i] = body[1].shortened(front, rear)
        if i == EGO:
            state.ego_crush = state.ego_crush[0] + front, state.ego_crush[1] + rear


def _bodies(state: _SolverState, a: str, b: str) -> Bodies:
    second = None if b == BACKGROUND else (state.bodies[b], state.properties[b])
    return (state.bodies[a], state.properties[a]), second


def _patch(state: _SolverState, a: str, b: str, nx: float, ny: float) -> Patch | None:
    """Where two bodies reach into one another, seen along a normal."""
    first, second = _bodies(state, a, b)
    if second is None:
        assert state.step.background is not None
        return state.step.background.patch(*first, nx, ny)
    found = overlap_patch(corners(*first), corners(*second), nx, ny)
    return None if found is None else Patch(*found)


def _masses(bodies: Bodies) -> tuple[float, float]:
    first, second = bodies
    return first[1].mass, math.inf if second is None else second[1].mass


def _pushed(
    bodies: Bodies, at: tuple[float, float], impulse: ContactImpulse
) -> tuple[tuple[BodyState, BodyState | None], float]:
    """Two bodies after an impulse on the first at a place, and the energy that was lost [J]."""
    (first, properties), second = bodies
    after = first.pushed(properties, *at, impulse.jx, impulse.jy)
    lost = first.energy(properties) - after.energy(properties)
    if second is None:
        return (after, None), lost
    other = second[0].pushed(second[1], *at, -impulse.jx, -impulse.jy)
    lost += second[0].energy(second[1]) - other.energy(second[1])
    return (after, other), lost


def _resolve_crossing(state: _SolverState, a: str, b: str, h: float) -> bool:
    """Let bodies that overlapped only within the substep exchange an impulse where they first did;
    whether they have."""
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


def _near_pairs(state: _SolverState) -> list[tuple[str, str]]:
    """Pairs of a body that physics moves and another within reach; in the order of ids."""
    return [
        (a, b)
        for a, b in itertools.combinations(sorted(state.bodies), 2)
        if (a in state.dynamic or b in state.dynamic) and _within_reach(state, a, b)
    ]


def _within_reach(state: _SolverState, a: str, b: str) -> bool:
    (low_a, high_a), (low_b, high_b) = state.heights[a], state.heights[b]
    (ax, ay, *_), (bx, by, *_) = state.bodies[a], state.bodies[b]
    apart = math.hypot(ax - bx, ay - by)
    return apart < state.reaches[a] + state.reaches[b] and low_a < high_b and low_b < high_a


def _apply_impulse(state: _SolverState, a: str, b: str, manifold: ContactManifold) -> bool:
    """Exchange momentum; whether there was any to exchange."""
    contact, second = state.step.contact, None
    first = (state.bodies[a], state.properties[a])
    if b != BACKGROUND:
        second = (state.bodies[b], state.properties[b])
    impulse = contact_impulse(
        first, second, manifold, restitution=contact.restitution, friction=contact.friction
    )
    if impulse is None:
        _pair_impulse(state, (a, b), manifold, approach=0.0)
        return False
    exchanged = _pair_impulse(state, (a, b), manifold, approach=impulse.approach)
    after = first[0].pushed(first[1], manifold.x, manifold.y, impulse.jx, impulse.jy)
    dissipated = first[0].energy(first[1]) - after.energy(first[1])
    state.bodies[a] = _separated(after, manifold, 1.0 if second is None else 0.5)
    masses = (first[1].mass, math.inf)
    if second is not None:
        other = second[0].pushed(second[1], manifold.x, manifold.y, -impulse.jx, -impulse.jy)
        dissipated += second[0].energy(second[1]) - other.energy(second[1])
        state.bodies[b] = _separated(other, manifold, -0.5)
        masses = (first[1].mass, second[1].mass)
    _make_dynamic(state, {a, b} - {BACKGROUND} - state.dynamic)
    exchanged.jx, exchanged.jy = exchanged.jx + impulse.jx, exchanged.jy + impulse.jy
    exchanged.energy, exchanged.masses = exchanged.energy + dissipated, masses
    return True


def _pair_impulse(
    state: _SolverState, pair: tuple[str, str], manifold: ContactManifold, *, approach: float
) -> _PairImpulse:
    """What two bodies have exchanged so far; a new record where their contact begins."""
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
        exchanged = _PairImpulse(manifold, approach, relative, side, speeds, began_us, participants)
        state.impulses[pair] = exchanged
    return exchanged


def _participant(state: _SolverState, i: str) -> ImpactParticipant:
    return ImpactParticipant(state.properties[i], state.bodies[i], *state.heights[i])


def _make_dynamic(state: _SolverState, impacted_now: set[str]) -> None:
    """Let physics move bodies; those that they overlap already, other than in this contact, are
    ignored until they have parted."""
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


def _separated(body: BodyState, manifold: ContactManifold, fraction: float) -> BodyState:
    """The body moved out of the overlap, most of the way."""
    depth = fraction * max(manifold.depth - SLOP, 0.0) * 0.5
    return body._replace(x=body.x + depth * manifold.nx, y=body.y + depth * manifold.ny)


def _impacted(state: _SolverState) -> dict[str, ImpactedObject]:
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


def _impacts(state: _SolverState) -> tuple[Impact, ...]:
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
