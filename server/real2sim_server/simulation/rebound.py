"""Restitution of simulated bodies: fitted before an impact, enforced at separation.

The rebound of a body on a grid depends on the position and orientation of the surface relative to
the nodes: an elastic block keeps 0.6 to 0.9 of its speed. The fit therefore follows the body to its
first contact with a collider and determines the viscosity by test impacts at that place.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ..geometry import Float
from ..physics.colliders import Collider, Plane, Solid
from ..physics.fitting import fit_restitution
from ..physics.solver import ContactTotals, SolverOptions
from .body import BodyMode, DeformableBody
from .result import Rebound
from .rigid import RigidMotion, clearance

# The end of an impact between bodies with a given restitution.
#
# Surfaces on a grid collide node by node, without rebound, and the loss depends on node positions.
# Each impact is therefore tracked from its first to its last impulse. The deficit to Newton's
# restitution is applied as one more impulse at separation: along the normal, through the centre of
# the earlier impulses, and on both sides, so that momentum and angular momentum are conserved. With
# a restitution of at most 1, it never returns more energy than the impact took.
#
# Simultaneous impacts that share a body form a chain, for example when the first of three touching
# bodies is struck. They are resolved one after the other, fastest approach first, so the last of
# equal bodies leaves with the momentum of the first. A wave passes through touching elastic bodies
# as through one piece, so vibration losses occur once, not at every face.

QUIET = 2
"""Steps without an impulse after which an impact is over."""
NOTHING = 1e-3
"""Impulses below this fraction of the previous one count as zero."""
EXACT = 0.01
"""Tolerance of the separation speed, as a fraction of the approach; no correction within it."""
MIN_APPROACH = 0.3
"""Minimum initial approach of a bounce [m/s]."""
ELASTIC = 0.8
"""Minimum restitution between undamped bodies without a requested one: that of elastic cubes with a
Poisson's ratio of 0.3 by finite elements; vibration takes the rest. Grids lose more, because nodes
shared by two bodies take on one velocity."""
MAX_IMPACT_TIME = 0.1
"""Maximum time for which other impacts of a chain wait for one [s]."""
ROUNDS = 100
"""Maximum number of successive impacts in a chain; few matter if the restitution is below 1."""


@dataclass(frozen=True)
class Bounce:
    """One impact of a body with a given restitution.

    Attributes:
        body, other: the body, and the body or collider that it hit.
        time_s: time of separation [s].
        speed: approach speed along the normal [m/s].
        grid: restitution on the grid, before the correction.
        achieved: restitution after the correction.
    """

    body: str
    other: str
    time_s: float
    speed: float
    grid: float
    achieved: float


@dataclass(frozen=True, eq=False)
class Correction:
    """The correction to one body at the end of an impact.

    Attributes:
        body: body that receives the impulse.
        other: name of the body or collider on the other side.
        impulse: [3] [N s].
        after: motion of the body after it.
    """

    body: DeformableBody
    other: str
    impulse: Float
    after: RigidMotion


@dataclass(eq=False)
class _Impact:
    """An ongoing impact.

    Motions before it, impulse and moment on the body so far, its duration, and the number of steps
    without impulse.
    """

    before: tuple[RigidMotion, ...]
    impulse: Float = field(default_factory=lambda: np.zeros(3))
    moment: Float = field(default_factory=lambda: np.zeros(3))
    quiet: int = 0
    age: float = 0.0


@dataclass(frozen=True, eq=False)
class _Meeting:
    """One impact of a finished chain.

    Attributes:
        sides: the body, and the other body, if any.
        other: name of the body or collider that was hit.
        point, normal: contact point [m], and unit normal towards the body.
        requested: requested restitution.
        still: speed of a collider along the normal, at the start and now [m/s].
        lossless: whether no side has a requested restitution; waves then pass without loss between
            sides that touched before the chain began.
    """

    sides: tuple[DeformableBody, ...]
    other: DeformableBody | Collider
    point: Float
    normal: Float
    requested: float
    still: tuple[float, float]
    lossless: bool

    def apart(self, motions: Mapping[str, RigidMotion]) -> float:
        """Separation speed of the sides, or of the body from a collider [m/s]."""
        speeds = [float(self._velocity(motions[s.name], s) @ self.normal) for s in self.sides]
        return speeds[0] - sum(speeds[1:])

    def _velocity(self, motion: RigidMotion, side: DeformableBody) -> Float:
        lever = self.point - side.motion.centre
        velocity: Float = motion.velocity + np.cross(motion.angular_velocity, lever)
        return velocity

    @property
    def ease(self) -> float:
        """Change of the separation speed per impulse between the sides [1/kg]."""
        return sum(_ease(s.motion, self.point - s.motion.centre, self.normal) for s in self.sides)

    def pushed(self, motions: dict[str, RigidMotion], impulse: float) -> None:
        """Change motions by an impulse [N s] between the sides at the contact point."""
        for sign, side in zip((1.0, -1.0), self.sides, strict=False):
            now = motions[side.name]
            lever = self.point - side.motion.centre
            given = sign * impulse * self.normal
            turn = np.linalg.solve(side.motion.world_inertia, np.cross(lever, given))
            motions[side.name] = replace(
                now,
                velocity=now.velocity + given / now.mass,
                angular_velocity=now.angular_velocity + turn,
            )


class Bounces:
    """Impacts of bodies with a requested restitution or without damping, step by step.

    Attributes:
        log: finished impacts.
    """

    def __init__(self) -> None:
        self.log: list[Bounce] = []
        self._impacts: dict[tuple[str, str], _Impact] = {}
        self._totals: dict[tuple[str, str], tuple[Float, Float]] = {}

    def figures(self, body: str) -> list[dict[str, Any]]:
        """Bounces of a body as JSON values."""
        members = (asdict(b) for b in self.log if b.body == body)
        return [{k: _rounded(v) for k, v in m.items() if k != "body"} for m in members]

    def start_solver(self) -> None:
        """Reset the impulse counters for a new solver."""
        self._totals = {}

    def forget(self, body: DeformableBody) -> None:
        """Drop the impacts of a body that has settled."""
        self._impacts = {p: i for p, i in self._impacts.items() if body.name not in p}

    def follow(
        self,
        contacts: Iterable[ContactTotals],
        bodies: Sequence[DeformableBody],
        colliders: Sequence[Collider],
        before: Mapping[str, RigidMotion],
        step: tuple[float, float, Float],
    ) -> Iterator[Correction]:
        """Advance by one solver step; returns the corrections of finished impacts.

        Apply each correction before requesting the next.

        Args:
            contacts: contacts of the solver since its start.
            bodies: current bodies in the solver.
            colliders: current colliders.
            before: motions of the bodies before the step.
            step: current time and length of the step [s], and gravity [m/s^2].
        """
        wanted = {b.name: b for b in bodies if _restitution(b) is not None}
        walls = {c.name: c for c in colliders}
        seen = set()
        for c in contacts:
            pair = (c.body, c.other)
            both = c.other in wanted and c.body < c.other
            on_wall = c.other in walls and c.body in wanted and wanted[c.body].rebound is not None
            if c.body in wanted and (both or on_wall):
                seen.add(pair)
                members = (c.body, c.other) if both else (c.body,)
                self._add(pair, c, tuple(before[name] for name in members))
        for pair, impact in self._impacts.items():
            impact.age += step[1]
            if pair not in seen:
                impact.quiet += 1
        for chain in self._chains(wanted):
            impacts = {pair: self._impacts[pair] for pair in chain}
            over = {p: i for p, i in impacts.items() if i.quiet >= QUIET}
            if all(i.quiet >= QUIET or i.age > MAX_IMPACT_TIME for i in impacts.values()):
                for pair in over:
                    del self._impacts[pair]
                yield from self._part(over, wanted, walls, step)

    def _chains(self, wanted: Mapping[str, DeformableBody]) -> list[list[tuple[str, str]]]:
        """Active impacts, grouped by shared bodies, in the order they began."""
        chains: list[list[tuple[str, str]]] = []
        for pair in self._impacts:
            own = {name for name in pair if name in wanted}
            linked = [c for c in chains if any(own.intersection(p) for p in c)]
            chains = [c for c in chains if c not in linked]
            chains.append([p for c in linked for p in c] + [pair])
        return chains

    def _add(
        self, pair: tuple[str, str], now: ContactTotals, before: tuple[RigidMotion, ...]
    ) -> None:
        impulse, moment = self._totals.get(pair, (np.zeros(3), np.zeros(3)))
        self._totals[pair] = (np.array(now.impulse), np.array(now.moment))
        impulse, moment = now.impulse - impulse, now.moment - moment
        impact = self._impacts.get(pair)
        size = float(np.linalg.norm(impulse))
        if impact is None:
            if size > 0:
                self._impacts[pair] = _Impact(before, impulse, moment)
            return
        if size <= NOTHING * float(np.linalg.norm(impact.impulse)):
            impact.quiet += 1
            return
        impact.quiet = 0
        impact.impulse = impact.impulse + impulse
        impact.moment = impact.moment + moment

    def _part(
        self,
        chain: Mapping[tuple[str, str], _Impact],
        wanted: Mapping[str, DeformableBody],
        walls: Mapping[str, Collider],
        step: tuple[float, float, Float],
    ) -> Iterator[Correction]:
        """The impulses that give a finished chain its requested restitutions."""
        meetings: list[_Meeting] = []
        before: dict[str, RigidMotion] = {}
        for pair, impact in chain.items():
            other = wanted.get(pair[1]) or walls.get(pair[1])
            if pair[0] in wanted and other is not None:
                meeting = _meeting(wanted[pair[0]], other, impact, step)
                if all(side.mode == BodyMode.DEFORMING for side in meeting.sides):
                    meetings.append(meeting)
                    for side, motion in zip(meeting.sides, impact.before, strict=True):
                        before.setdefault(side.name, motion)
        if not meetings:
            return
        approaches, after = _one_after_the_other(meetings, before)
        now = {side.name: side.motion for m in meetings for side in m.sides}
        speeds = np.array([m.apart(now) - m.still[1] for m in meetings])
        if max(approaches) < MIN_APPROACH or (len(meetings) == 1 and speeds[0] <= 0):
            return
        give = np.array([m.apart(after) - m.still[0] for m in meetings]) - speeds
        # Impacts that are already elastic enough on the grid remain unchanged.
        given = [not m.lossless for m in meetings]
        if any(given):
            give = np.where(given, give, np.maximum(give, 0.0))
        elif np.all(give <= 0.0) or _kinetic(after) <= _kinetic(now):
            give = np.zeros(len(meetings))
        if np.all(np.abs(give) < EXACT * np.maximum(approaches, MIN_APPROACH)):
            give = np.zeros(len(meetings))
        for m, approach, speed, more in zip(meetings, approaches, speeds, give, strict=True):
            if approach >= MIN_APPROACH:
                self.log.append(
                    Bounce(
                        m.sides[0].name,
                        m.other.name,
                        step[0],
                        approach,
                        float(speed) / approach,
                        float(speed + more) / approach,
                    )
                )
        if np.any(give):
            yield from _corrections(meetings, now, give)


def _meeting(
    body: DeformableBody,
    other: DeformableBody | Collider,
    impact: _Impact,
    step: tuple[float, float, Float],
) -> _Meeting:
    _, duration, gravity = step
    point = _centre(impact, body.motion.centre)
    if isinstance(other, DeformableBody):
        normal = impact.impulse / float(np.linalg.norm(impact.impulse))
        known = [e for e in map(_restitution, (body, other)) if e is not None]
        elastic = body.rebound is None and other.rebound is None
        return _Meeting((body, other), other, point, normal, min(known), (0.0, 0.0), elastic)
    assert body.rebound is not None
    distance, normals = clearance(other, body.shell_points())
    normal = normals[int(distance.argmin())]
    moving = _velocity(other, point)
    # A wall does not fall with the body while no forces act.
    drift = QUIET * duration * gravity + moving
    still = float(moving @ normal), float(drift @ normal)
    return _Meeting((body,), other, point, normal, body.rebound.requested, still, False)


def _restitution(body: DeformableBody) -> float | None:
    """The requested restitution of a body, or that of an undamped body; else None."""
    if body.rebound is not None:
        return body.rebound.requested
    return ELASTIC if body.is_undamped else None


def _one_after_the_other(
    meetings: Sequence[_Meeting], before: Mapping[str, RigidMotion]
) -> tuple[list[float], dict[str, RigidMotion]]:
    """Fastest approach of each impact of a chain [m/s], and the final motions.

    Applies Newton's restitution to the fastest approach until no sides approach. Elastic bodies
    that were not approaching when the chain began were touching.
    """
    motions = dict(before)
    fastest = [0.0] * len(meetings)
    first = [m.still[0] - m.apart(motions) for m in meetings]
    touching = [
        m.lossless and a <= EXACT * max(first) for m, a in zip(meetings, first, strict=True)
    ]
    for _ in range(ROUNDS):
        approaches = [m.still[0] - m.apart(motions) for m in meetings]
        fastest = [max(f, a) for f, a in zip(fastest, approaches, strict=True)]
        k = int(np.argmax(approaches))
        if approaches[k] <= EXACT * max(*fastest, MIN_APPROACH):
            break
        m = meetings[k]
        restitution = 1.0 if touching[k] else m.requested
        m.pushed(motions, (1 + restitution) * approaches[k] / m.ease)
    return fastest, motions


def _kinetic(motions: Mapping[str, RigidMotion]) -> float:
    """Kinetic energy [J]."""
    return sum(m.kinetic for m in motions.values())


def _corrections(
    meetings: Sequence[_Meeting], now: Mapping[str, RigidMotion], give: Float
) -> Iterator[Correction]:
    """Impulses that change the separation speeds by ``give`` [m/s]."""
    response = np.zeros((len(meetings), len(meetings)))
    for k, m in enumerate(meetings):
        pushed = dict(now)
        m.pushed(pushed, 1.0)
        response[:, k] = [other.apart(pushed) - other.apart(now) for other in meetings]
    impulses = np.linalg.lstsq(response, give, rcond=1e-9)[0]
    after = dict(now)
    for m, impulse in zip(meetings, impulses.tolist(), strict=True):
        m.pushed(after, impulse)
        for sign, side, other in zip((1.0, -1.0), m.sides, (m.other, m.sides[0]), strict=False):
            yield Correction(side, other.name, sign * impulse * m.normal, after[side.name])


def _centre(impact: _Impact, near: Float) -> Float:
    """The point on an impulse's line nearest to ``near`` [m]."""
    impulse, moment = impact.impulse, impact.moment
    square = float(impulse @ impulse)
    on_line = np.cross(impulse, moment) / square
    point: Float = on_line + float((near - on_line) @ impulse) / square * impulse
    return point


def _ease(motion: RigidMotion, lever: Float, normal: Float) -> float:
    """Change of the normal speed per normal impulse at a lever arm [1/kg]."""
    turn = np.cross(lever, normal)
    return 1.0 / motion.mass + float(turn @ np.linalg.solve(motion.world_inertia, turn))


def _velocity(collider: Collider, point: Float) -> Float:
    """Velocity of a collider at a point [m/s]."""
    return collider.velocity_at(point) if isinstance(collider, Solid) else np.zeros(3)


def _rounded(value: Any) -> Any:
    return round(value, 6) if isinstance(value, float) else value


HORIZON = 10.0
"""Maximum time for which a body is tracked [s]."""
STEPS_MAX = 4_000
STRIDE = 0.5
"""Maximum distance between two checks along the path [cells]."""
SLOW = 0.1
"""Minimum approach speed of an impact [m/s]."""
DEFAULT_SPEED = 2.0
"""Approach speed for fitting the restitution of stationary objects [m/s]."""


@dataclass(frozen=True, eq=False)
class FirstTouch:
    """A body's first contact with a collider on its path.

    Attributes:
        motion: motion of the body at that time.
        collider: the collider at that time, brought to rest.
        point: point on its surface [m].
        normal: outward normal there.
        speed: approach speed along the normal [m/s].
    """

    motion: RigidMotion
    collider: Collider
    point: Float
    normal: Float
    speed: float


def fit_rebound(
    body: DeformableBody, requested: float, colliders: Sequence[Collider], gravity: Float
) -> Rebound:
    """Add the viscosity with which a body rebounds from its first collider as ``requested``.

    Args:
        body: body at its start; its materials are modified.
        requested: coefficient of restitution.
        colliders: colliders that it may hit.
        gravity: [3] gravity on its path to the collider [m/s^2].
    """
    touch = first_touch(body, colliders, gravity)
    trial = copy.copy(body)
    options = SolverOptions(dx=body.cell, gravity=(0.0, 0.0, 0.0))
    if touch is None:
        speed = float(np.linalg.norm(body.motion.velocity))
        along = body.motion.velocity / speed if speed > SLOW else body.motion.rotation[:, 0]
        normal, speed = -along, speed if speed > SLOW else DEFAULT_SPEED
        fit = fit_restitution(_still(trial), requested, speed=speed, normal=normal, options=options)
    else:
        trial.motion = touch.motion
        wall = Plane(name="wall", point=touch.point, normal=touch.normal)
        speed = touch.speed
        fit = fit_restitution(
            _still(trial),
            requested,
            speed=speed,
            wall=wall,
            collider=touch.collider,
            options=options,
        )
    body.materials = fit.body.materials
    return Rebound(
        requested,
        fit.achieved,
        fit.elastic,
        None if touch is None else touch.collider.name,
        speed,
        fit.viscosity,
    )


def first_touch(
    body: DeformableBody, colliders: Sequence[Collider], gravity: Float
) -> FirstTouch | None:
    """The first collider on a body's path, flying or rolling straight; None without one.

    Args:
        body: body at its start.
        colliders: colliders at that time.
        gravity: [3] [m/s^2].
    """
    motion, now = body.motion, list(colliders)
    trial = copy.copy(body)
    surface = body.spacing / 2
    time = 0.0
    for _ in range(STEPS_MAX):
        fastest = max((c.fastest_point for c in now), default=0.0)
        turning = body.reach * float(np.linalg.norm(motion.angular_velocity))
        speed = float(np.linalg.norm(motion.velocity)) + turning + fastest
        if time > HORIZON or (speed < SLOW and not np.any(gravity)):
            return None
        trial.motion = motion
        shell = trial.shell_points()
        for collider in now:
            if isinstance(collider, Solid) and _is_far(collider, motion.centre, body.reach):
                continue
            distance, normals = clearance(collider, shell)
            k = int(distance.argmin())
            normal = normals[k]
            approach = _approach(motion, collider, shell[k], normal)
            if distance[k] < surface and approach > SLOW:
                point = shell[k] - distance[k] * normal
                return FirstTouch(motion, _at_rest(collider), point, normal, approach)
        step = min(STRIDE * body.cell / max(speed, SLOW), 0.02)
        motion = motion.with_gravity(step, gravity).advanced(step)
        now = [c.after(step) for c in now]
        time += step
    return None


def _is_far(solid: Solid, centre: Float, reach: float) -> bool:
    """Whether a solid is further than twice ``reach`` [m] from a point."""
    low, high = solid.bounds
    extent = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    away = float(np.linalg.norm(solid.pose[:3, 3] - centre))
    return away - extent > 2 * reach


def _still(body: DeformableBody) -> Any:
    """The body for the solver, at the contact; the test impact sets the velocities."""
    return replace(body.solver_body(), particle_velocities=None, particle_gradients=None)


def _approach(motion: RigidMotion, collider: Collider, point: Float, normal: Float) -> float:
    velocity = motion.velocity
    if isinstance(collider, Solid):
        velocity = velocity - collider.velocity_at(point)
    return -float(velocity @ normal)


def _at_rest(collider: Collider) -> Collider:
    return collider.at_rest() if isinstance(collider, Solid) else collider
