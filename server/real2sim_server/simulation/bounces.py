"""The end of an impact of bodies that were given a restitution: they part as fast as requested.

Surfaces on a grid meet node by node, without rebound, and what they lose hangs on where nodes lie.
So an impact is followed from its first to its last impulse, and what is missing from Newton's
restitution at the contact, or beyond it, is one impulse more when bodies part: along the normal,
through the centre of what acted before, and on both sides, so that momentum and angular momentum
stay. With a restitution of at most 1 it never gives more energy than the impact has taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Box, Collider
from ..physics.solver import ContactTotals
from .body import BodyMode, DeformableBody
from .rigid import RigidMotion
from .surroundings import clearance

QUIET = 2
"""An impact is over after so many steps without an impulse."""
NOTHING = 1e-3
"""Impulses below this fraction of what there was are none."""
EXACT = 0.01
"""What parts within this fraction of the approach of what was requested is left as it is."""
SLOWEST = 0.3
"""Impacts that begin more slowly are no bounces [m/s]."""


@dataclass(frozen=True)
class Bounce:
    """One impact of a body that was given a restitution.

    Attributes:
        body, other: who, on what.
        time_s: when they parted.
        speed: of approach along the normal [m/s].
        grid: separation over approach speed as the grid left it.
        achieved: as it is now.
    """

    body: str
    other: str
    time_s: float
    speed: float
    grid: float
    achieved: float


@dataclass(frozen=True, eq=False)
class Correction:
    """What the end of an impact adds to one body.

    Attributes:
        body: that gets it.
        other: name of what gave it.
        impulse: [3] [N s].
        after: motion of the body with it.
    """

    body: DeformableBody
    other: str
    impulse: Float
    after: RigidMotion


@dataclass(eq=False)
class _Impact:
    """An impact under way: motions before it, and impulse and moment on the body so far."""

    before: tuple[RigidMotion, ...]
    impulse: Float = field(default_factory=lambda: np.zeros(3))
    moment: Float = field(default_factory=lambda: np.zeros(3))
    quiet: int = 0


class Bounces:
    """Impacts of bodies with a wanted restitution, from step to step.

    Attributes:
        log: those that are over.
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
        """A new solver counts impulses from zero."""
        self._totals = {}

    def forget(self, body: DeformableBody) -> None:
        """A body has settled on what it hit."""
        self._impacts = {p: i for p, i in self._impacts.items() if body.name not in p}

    def follow(
        self,
        contacts: Iterable[ContactTotals],
        bodies: Sequence[DeformableBody],
        colliders: Sequence[Collider],
        before: Mapping[str, RigidMotion],
        step: tuple[float, float, Float],
    ) -> Iterator[Correction]:
        """Go on by one step of the solver; what impacts that are over add to bodies.

        Each is to take effect before the next is asked for.

        Args:
            contacts: of the solver, since its start.
            bodies: in the solver, as they are now.
            colliders: as they are now.
            before: motions of the bodies before the step.
            step: time now and length of the step [s], and gravity [m/s^2].
        """
        wanted = {b.name: b for b in bodies if b.rebound is not None}
        walls = {c.name: c for c in colliders}
        seen = set()
        for c in contacts:
            pair = (c.body, c.other)
            both = c.other in wanted and c.body < c.other
            if c.body in wanted and (both or c.other in walls):
                seen.add(pair)
                members = (c.body, c.other) if both else (c.body,)
                self._add(pair, c, tuple(before[name] for name in members))
        for pair in list(self._impacts):
            if pair not in seen:
                self._impacts[pair].quiet += 1
            if self._impacts[pair].quiet >= QUIET:
                impact = self._impacts.pop(pair)
                if pair[0] in wanted and (pair[1] in wanted or pair[1] in walls):
                    other = wanted.get(pair[1]) or walls[pair[1]]
                    yield from self._part(wanted[pair[0]], other, impact, step)

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
        body: DeformableBody,
        other: DeformableBody | Collider,
        impact: _Impact,
        step: tuple[float, float, Float],
    ) -> list[Correction]:
        """The impulse with which a body and what it hit part as requested."""
        time, duration, gravity = step
        sides = [body, other] if isinstance(other, DeformableBody) else [body]
        if any(side.mode != BodyMode.DEFORMING for side in sides):
            return []
        point = _centre(impact, body.motion.centre)
        normal = impact.impulse / float(np.linalg.norm(impact.impulse))
        requested = min(side.rebound.requested for side in sides if side.rebound is not None)
        drift = np.zeros(3)
        if not isinstance(other, DeformableBody):
            shell = body.shell_points()
            distance, normals = clearance(other, shell)
            normal = normals[int(distance.argmin())]
            # A wall does not fall with the body while nothing acts.
            drift = QUIET * duration * gravity + _velocity(other, point)
        levers = [point - side.motion.centre for side in sides]
        start = _apart(impact.before, levers, normal) - float(_velocity_of(other, point) @ normal)
        end = _apart([s.motion for s in sides], levers, normal) - float(drift @ normal)
        if -start < SLOWEST or end <= 0:
            return []
        give = requested * -start - end
        if abs(give) < EXACT * -start:
            give = 0.0
        ease = sum(_ease(s.motion, lever, normal) for s, lever in zip(sides, levers, strict=True))
        impulse = give / ease * normal
        self.log.append(
            Bounce(body.name, other.name, time, -start, end / -start, (end + give) / -start)
        )
        if give == 0:
            return []
        made = [Correction(body, other.name, impulse, body.motion.with_impulse(impulse, point))]
        if isinstance(other, DeformableBody):
            after = other.motion.with_impulse(-impulse, point)
            made.append(Correction(other, body.name, -impulse, after))
        return made


def _centre(impact: _Impact, near: Float) -> Float:
    """The point on the line of an impulse that is nearest to ``near`` [m]."""
    impulse, moment = impact.impulse, impact.moment
    square = float(impulse @ impulse)
    on_line = np.cross(impulse, moment) / square
    point: Float = on_line + float((near - on_line) @ impulse) / square * impulse
    return point


def _apart(motions: Sequence[RigidMotion], levers: Sequence[Float], normal: Float) -> float:
    """Speed at which the first departs from the second, or from what stands still [m/s]."""
    speeds = [
        float((m.velocity + np.cross(m.angular_velocity, lever)) @ normal)
        for m, lever in zip(motions, levers, strict=True)
    ]
    return speeds[0] - sum(speeds[1:])


def _ease(motion: RigidMotion, lever: Float, normal: Float) -> float:
    """Change of speed along the normal by one N s along it at a lever [1/kg]."""
    turn = np.cross(lever, normal)
    return 1.0 / motion.mass + float(turn @ np.linalg.solve(motion.world_inertia, turn))


def _velocity_of(other: DeformableBody | Collider, point: Float) -> Float:
    return np.zeros(3) if isinstance(other, DeformableBody) else _velocity(other, point)


def _velocity(collider: Collider, point: Float) -> Float:
    """Of a collider at a point [m/s]."""
    if not isinstance(collider, Box):
        return np.zeros(3)
    centre = np.asarray(collider.T_world_box)[:3, 3]
    turning = np.cross(np.asarray(collider.angular_velocity), point - centre)
    velocity: Float = np.asarray(collider.velocity) + turning
    return velocity


def _rounded(value: Any) -> Any:
    return round(value, 6) if isinstance(value, float) else value
