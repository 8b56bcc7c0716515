"""A step of the clock in which bodies meet: in substeps, with impulses."""

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
from ..ego.vehicle import Motion
from ..scoring.boxes import side_of_contact
from ..scoring.instant import Side
from ..traffic.driver import AgentPose
from .body import Body, Solid, integrate_sliding
from .manifold import Touch, corners, exchange, touch
from .model import (
    Impact,
    ImpactedObject,
    Party,
    ego_body,
    ego_motion,
    ego_solid,
    rolls_again,
    solid_of,
)

SUBSTEP_US = 10_000
EGO = ""
"""Key of the ego among the bodies; no object has an empty id."""
BACKGROUND = "\0"

SLOP = 0.01
"""Overlap that is left between bodies in contact, so that they stay in contact [m]."""


@dataclass(frozen=True, eq=False)
class Bout:
    """What a step with possible contact begins from.

    Attributes:
        t_us, dt_us: the step [us].
        motion, sliding: the ego, and whether physics moves it rather than its controller.
        roll: ``roll(motion, since_us, us)`` moves the ego by its controller.
        command: what the driver does in a motion so many microseconds after the start.
        spec, ego_size, contact: parameters.
        before, after: objects as their drivers move them; wrecks among them.
        wrecks: objects that physics moves, by id.
        exempt: pairs that overlapped before anybody hit anybody; they do not collide.
        background: what a body touches of the background; None where it is left out.
        height: ground height [m] at x, y.
    """

    t_us: int
    dt_us: int
    motion: Motion
    sliding: bool
    roll: Callable[[Motion, int, int], Motion]
    command: Callable[[Motion, int], Command]
    spec: EgoSpec
    ego_size: tuple[float, float, float]
    contact: ContactSpec
    before: Agents
    after: Agents
    wrecks: Mapping[str, ImpactedObject]
    exempt: frozenset[frozenset[str]]
    background: Callable[[Body, Solid], Touch | None] | None
    height: Callable[[float, float], float]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a step with contact ends with: see :class:`Bout`; ``impacts`` in order."""

    motion: Motion
    sliding: bool
    wrecks: dict[str, ImpactedObject]
    impacts: tuple[Impact, ...]
    exempt: frozenset[frozenset[str]]


@dataclass(eq=False)
class _Account:
    """What two bodies have done to each other in this step."""

    where: Touch
    approach: float
    relative: float
    side: Side
    speeds: tuple[float, float]
    began_us: int
    parties: tuple[Party, Party | None]
    jx: float = 0.0
    jy: float = 0.0
    energy: float = 0.0
    masses: tuple[float, float] = (math.inf, math.inf)


class _Way(NamedTuple):
    """How its driver moves an object through the step: places at the start and the end [m], yaw at
    the start and its change [rad], velocity [m/s] and turn rate [rad/s]."""

    start: tuple[float, float]
    end: tuple[float, float]
    yaw: float
    turn: float
    velocity: tuple[float, float]
    rate: float

    def after(self, share: float) -> Body:
        """The object after a share of the step."""
        (ax, ay), (bx, by), rest = self.start, self.end, 1 - share
        x, y = rest * ax + share * bx, rest * ay + share * by
        return Body(x, y, self.yaw + share * self.turn, *self.velocity, self.rate)


@dataclass(eq=False)
class _Run:
    bout: Bout
    solids: dict[str, Solid]
    bodies: dict[str, Body]
    ways: dict[str, _Way]
    free: set[str]
    boxes: dict[str, tuple[float, float]]
    reaches: dict[str, float]
    accounts: dict[tuple[str, str], _Account] = field(default_factory=dict)
    exempt: set[frozenset[str]] = field(default_factory=set)
    now_us: int = 0


def resolve(bout: Bout) -> Outcome:
    """Move ego and objects through a step in substeps of 10 ms; bodies that meet push each other.

    An object that is struck is moved by physics from then on; the ego goes by its controller
    again once its wheels roll. Contacts are handled in the order of ids, so that the outcome is
    the same whatever else runs.
    """
    run = _begin(bout)
    motion, sliding = bout.motion, bout.sliding
    substeps = -(-bout.dt_us // SUBSTEP_US)
    for k in range(substeps):
        begin, end = bout.dt_us * k // substeps, bout.dt_us * (k + 1) // substeps
        motion = _move_ego(run, motion, sliding, begin, end)
        _move_objects(run, begin, end)
        run.now_us = end
        if _collide(run):
            sliding = True
        if sliding:
            motion = ego_motion(run.bodies[EGO], motion, bout.spec)
            sliding = not rolls_again(motion, bout.spec)
    return Outcome(motion, sliding, _wrecks(run), _impacts(run), frozenset(run.exempt))


def _begin(bout: Bout) -> _Run:
    solids, bodies, boxes = {EGO: ego_solid(bout.spec, bout.ego_size)}, {}, {}
    bodies[EGO] = ego_body(bout.motion, bout.spec)
    bottom = bout.height(bout.motion.x, bout.motion.y)
    boxes[EGO] = (bottom, bottom + bout.ego_size[2])
    friction = bout.spec.vehicle.friction
    start = rows_of(bout.before)
    ways: dict[str, _Way] = {}
    for k, subject in enumerate(bout.after.objects):
        i, size = subject.object_id, tuple(bout.after.sizes[k].tolist())
        z = float(bout.after.positions[k, 2])
        boxes[i] = (z - size[2] / 2, z + size[2] / 2)
        if i in bout.wrecks:
            solids[i], bodies[i] = bout.wrecks[i].solid, bout.wrecks[i].body
            continue
        solids[i] = solid_of(subject, bout.contact, friction=friction, size=size)
        way = _way(bout, start.get(i), k)
        bodies[i] = way.after(0.0)._replace(turn=0.0)
        if i in start:
            ways[i] = way
    reaches = {i: math.hypot(s.length, s.width) / 2 + 1 for i, s in solids.items()}
    free = {EGO, *bout.wrecks}
    return _Run(bout, solids, bodies, ways, free, boxes, reaches, exempt=set(bout.exempt))


def _way(bout: Bout, row: int | None, k: int) -> _Way:
    """Of the object that is in row ``k`` at the end and was in another at the start; an object
    that has just appeared stands where it is."""
    source, j = (bout.after, k) if row is None else (bout.before, row)
    yaw = float(quaternion_yaw(source.quaternions[j]))
    turn = math.remainder(float(quaternion_yaw(bout.after.quaternions[k])) - yaw, math.tau)
    (ax, ay, _), (bx, by, _) = source.positions[j].tolist(), bout.after.positions[k].tolist()
    vx, vy, _ = bout.after.velocities[k].tolist()
    return _Way((ax, ay), (bx, by), yaw, turn, (vx, vy), turn / (bout.dt_us * 1e-6))


def _move_ego(run: _Run, motion: Motion, sliding: bool, begin: int, end: int) -> Motion:
    bout = run.bout
    if not sliding:
        motion = bout.roll(motion, begin, end - begin)
        run.bodies[EGO] = ego_body(motion, bout.spec)
        return motion
    command = bout.command(motion, begin)
    spec = bout.spec
    asked = min(max(command.acceleration, -spec.max_braking), spec.max_acceleration)
    run.bodies[EGO] = integrate_sliding(
        run.bodies[EGO],
        run.solids[EGO],
        (end - begin) * 1e-6,
        acceleration=asked,
        steering=motion.steering,
    )
    return ego_motion(run.bodies[EGO], motion, spec)


def _move_objects(run: _Run, begin: int, end: int) -> None:
    share = end / run.bout.dt_us
    for i in run.bodies:
        if i == EGO:
            continue
        if i in run.free:
            run.bodies[i] = integrate_sliding(run.bodies[i], run.solids[i], (end - begin) * 1e-6)
        elif i in run.ways:
            run.bodies[i] = run.ways[i].after(share)


def _collide(run: _Run) -> bool:
    """Let all bodies that touch push each other; whether the ego was pushed."""
    pushed = False
    for a, b in _near_pairs(run):
        pair = frozenset((a, b))
        where = touch(corners(run.bodies[a], run.solids[a]), corners(run.bodies[b], run.solids[b]))
        if where is None:
            run.exempt.discard(pair)
            continue
        if pair in run.exempt:
            continue
        pushed |= _push(run, a, b, where) and a == EGO
    if run.bout.background is not None:
        for i in sorted(run.free):
            where = run.bout.background(run.bodies[i], run.solids[i])
            if where is not None:
                pushed |= _push(run, i, BACKGROUND, where) and i == EGO
    return pushed


def _near_pairs(run: _Run) -> list[tuple[str, str]]:
    """Pairs of a body that physics moves and another within reach; in the order of ids."""
    return [
        (a, b)
        for a, b in itertools.combinations(sorted(run.bodies), 2)
        if (a in run.free or b in run.free) and _may_touch(run, a, b)
    ]


def _may_touch(run: _Run, a: str, b: str) -> bool:
    (low_a, high_a), (low_b, high_b) = run.boxes[a], run.boxes[b]
    (ax, ay, *_), (bx, by, *_) = run.bodies[a], run.bodies[b]
    apart = math.hypot(ax - bx, ay - by)
    return apart < run.reaches[a] + run.reaches[b] and low_a < high_b and low_b < high_a


def _push(run: _Run, a: str, b: str, where: Touch) -> bool:
    """Exchange momentum; whether there was any to exchange."""
    contact, second = run.bout.contact, None
    first = (run.bodies[a], run.solids[a])
    if b != BACKGROUND:
        second = (run.bodies[b], run.solids[b])
    given = exchange(
        first, second, where, restitution=contact.restitution, friction=contact.friction
    )
    if given is None:
        _note(run, (a, b), where, approach=0.0)
        return False
    account = _note(run, (a, b), where, approach=given.approach)
    after = first[0].pushed(first[1], where.x, where.y, given.jx, given.jy)
    lost = first[0].energy(first[1]) - after.energy(first[1])
    run.bodies[a] = _shifted(after, where, 1.0 if second is None else 0.5)
    masses = (first[1].mass, math.inf)
    if second is not None:
        other = second[0].pushed(second[1], where.x, where.y, -given.jx, -given.jy)
        lost += second[0].energy(second[1]) - other.energy(second[1])
        run.bodies[b] = _shifted(other, where, -0.5)
        masses = (first[1].mass, second[1].mass)
    _free(run, {a, b} - {BACKGROUND} - run.free)
    account.jx, account.jy = account.jx + given.jx, account.jy + given.jy
    account.energy, account.masses = account.energy + lost, masses
    return True


def _note(run: _Run, pair: tuple[str, str], where: Touch, *, approach: float) -> _Account:
    """The account of two bodies; a new one where they have just met."""
    account = run.accounts.get(pair)
    if account is None:
        first = (run.bodies[pair[0]], run.solids[pair[0]])
        vx, vy = first[0].vx, first[0].vy
        speeds: tuple[float, float] = (math.hypot(vx, vy), 0.0)
        side: Side = "stopped_track"
        if pair[1] != BACKGROUND:
            second = (run.bodies[pair[1]], run.solids[pair[1]])
            speeds = (speeds[0], math.hypot(second[0].vx, second[0].vy))
            vx, vy = vx - second[0].vx, vy - second[0].vy
            side = _side(first, second, speeds)
        parties = _party(run, pair[0]), None if pair[1] == BACKGROUND else _party(run, pair[1])
        began_us = run.bout.t_us + run.now_us
        relative = math.hypot(vx, vy)
        account = _Account(where, approach, relative, side, speeds, began_us, parties)
        run.accounts[pair] = account
    return account


def _party(run: _Run, i: str) -> Party:
    return Party(run.solids[i], run.bodies[i], *run.boxes[i])


def _free(run: _Run, struck: set[str]) -> None:
    """Let physics move bodies; what they overlap already (other than in this contact) they do not
    hit until they have parted."""
    for i in sorted(struck):
        shape = corners(run.bodies[i], run.solids[i])
        for j in sorted(run.bodies.keys() - struck - run.free):
            reach = run.solids[i].length + run.solids[j].length
            near = math.dist(run.bodies[i][:2], run.bodies[j][:2]) < reach
            if near and touch(shape, corners(run.bodies[j], run.solids[j])) is not None:
                run.exempt.add(frozenset((i, j)))
    run.free |= struck


def _side(
    first: tuple[Body, Solid], second: tuple[Body, Solid], speeds: tuple[float, float]
) -> Side:
    boxes = []
    for body, solid in (first, second):
        x = body.x + solid.box_ahead * math.cos(body.yaw)
        y = body.y + solid.box_ahead * math.sin(body.yaw)
        boxes.append((x, y, body.yaw, solid.length, solid.width))
    return side_of_contact(boxes[0], speeds[0], boxes[1], speeds[1])


def _shifted(body: Body, where: Touch, share: float) -> Body:
    """The body moved out of the overlap, most of the way."""
    depth = share * max(where.depth - SLOP, 0.0) * 0.5
    return body._replace(x=body.x + depth * where.nx, y=body.y + depth * where.ny)


def _wrecks(run: _Run) -> dict[str, ImpactedObject]:
    wrecks = {}
    for k, subject in enumerate(run.bout.after.objects):
        i = subject.object_id
        if i not in run.free:
            continue
        body = run.bodies[i]
        old = run.bout.wrecks.get(i)
        x, y, z = run.bout.after.positions[k].tolist()
        height = old.height if old else z - run.bout.height(x, y)
        quaternion = run.bout.after.quaternions[k]
        turned = body.yaw - float(quaternion_yaw(quaternion))
        w, qx, qy, qz = multiply_quaternions(yaw_quaternion(turned), quaternion).tolist()
        pose = AgentPose(
            (body.x, body.y, run.bout.height(body.x, body.y) + height),
            (w, qx, qy, qz),
            body.yaw,
            (body.vx, body.vy, 0.0),
        )
        wrecks[i] = (
            old.at(body, pose)
            if old
            else ImpactedObject(subject, run.solids[i], body, height, pose)
        )
    return wrecks


def _impacts(run: _Run) -> tuple[Impact, ...]:
    impacts = []
    for (a, b), account in run.accounts.items():
        strength = math.hypot(account.jx, account.jy)
        impacts.append(
            Impact(
                object_id=None if b == BACKGROUND else b,
                other_id=None if a == EGO else a,
                t_us=run.bout.t_us + run.bout.dt_us,
                point=(account.where.x, account.where.y),
                normal=(account.where.nx, account.where.ny),
                approach_speed=account.approach,
                relative_speed=account.relative,
                impulse=(account.jx, account.jy),
                delta_v=strength / account.masses[0],
                object_delta_v=strength / account.masses[1],
                energy=account.energy,
                side=account.side,
                speeds=account.speeds,
                began_us=account.began_us,
                parties=account.parties,
            )
        )
    return tuple(impacts)
