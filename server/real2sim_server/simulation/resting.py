"""Bodies that lie on each other and on colliders: rigid contacts that are kept from step to step.

On a grid, bodies that lie on each other sink a little with every step and never stop. Once nothing
of them deforms any more they are rigid, and what holds them apart are forces at the points where
they touch: not towards each other, with Coulomb friction, and such that no point goes deeper than
it lay when the contact began (sequential impulses; Catto 2005). Forces of the last step are where
the next begins. What approaches faster than GENTLE is an impact and deforms.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Collider
from .body import BodyMode, DeformableBody
from .rigid import RigidMotion, rotation_of
from .support import body_contacts, collider_contacts, tangents
from .surroundings import clearance

GENTLE = 0.3
"""Contacts in which nothing approaches faster carry without deforming, nor bounce [m/s]."""
STEADY = 2.0
"""What is pushed away faster has not come to rest against it but is about to bounce [m/s^2]."""
SWEEPS = 30
"""Passes over all contacts in a step."""
DRIFT = 0.1
"""Once points have slid or opened by so much their pair is looked at anew [spacings]."""
LAID = 0.1
"""Points that lie higher than this above a collider do not carry yet [spacings]."""
PUSH, PUSH_SPEED = 0.2, 0.05
"""Fraction of what is too deep that a step takes back, and at most how fast [m/s]. Bodies are moved
by it and keep none of it as velocity: what rests would never come to a stop."""
SLOP = 1e-4
"""Within so much of where they carry points are held where they are [m]: chasing less than that
keeps in motion what should rest."""
PUSH_SWEEPS = 10
"""Passes over all contacts that are too deep."""

Pair = tuple[str, str]


@dataclass(eq=False)
class Touch:
    """One point at which a body touches something.

    Attributes:
        body: that is carried.
        other: what carries it.
        local: [3] the point, body frame [m].
        there, normal: [3] where it touches another body and the unit normal towards this one, in
            the frame of the other [m]; of colliders they are looked up.
        rest: gap at which it carries [m].
        friction: Coulomb coefficient.
        impulse: [3] of the last step: along the normal and two tangents [N s].
    """

    body: DeformableBody
    other: DeformableBody | Collider
    local: Float
    there: Float
    normal: Float
    rest: float
    friction: float
    impulse: Float = field(default_factory=lambda: np.zeros(3))

    def place(self) -> tuple[Float, Float, float, float]:
        """Where it is [m], the normal, the gap beyond ``rest`` and how far it has slid [m]."""
        own = _into(self.body.T_world_object, self.local)
        if not isinstance(self.other, DeformableBody):
            distance, normals = clearance(self.other, own[None])
            return own, normals[0], float(distance[0]) - self.rest, 0.0
        under = self.other.T_world_object
        normal = under[:3, :3] @ self.normal
        apart = own - _into(under, self.there)
        gap = float(apart @ normal)
        return own, normal, gap - self.rest, float(np.linalg.norm(apart - gap * normal))


@dataclass(frozen=True, eq=False)
class Reaction:
    """What a contact did in a step.

    Attributes:
        body, other: on whom, by whom.
        impulse: [3] on the body, world [N s].
        heat: dissipated by friction, half of it on each side of two bodies [J].
    """

    body: str
    other: str
    impulse: Float
    heat: float


class Resting:
    """The contacts of bodies that have settled, by body and what carries it."""

    def __init__(self) -> None:
        self._touches: dict[Pair, list[Touch]] = {}

    def holds(self, body: DeformableBody, other: str) -> bool:
        """Whether a body and another, or a collider, touch here."""
        return (body.name, other) in self._touches or (other, body.name) in self._touches

    def partners(self, body: DeformableBody) -> set[str]:
        """All that a body touches here."""
        return {name for pair in self._touches if body.name in pair for name in pair} - {body.name}

    def island(self, body: DeformableBody) -> set[str]:
        """Bodies that are connected with a body by contacts, itself among them."""
        first = [touches[0] for touches in self._touches.values()]
        bodies = {t.body.name for t in first}
        bodies |= {t.other.name for t in first if isinstance(t.other, DeformableBody)}
        found, more = {body.name}, [body.name]
        while more:
            at = more.pop()
            for pair in self._touches:
                if at in pair:
                    fresh = {name for name in pair if name in bodies} - found
                    found |= fresh
                    more += fresh
        return found

    def begin(
        self,
        body: DeformableBody,
        colliders: Sequence[Collider],
        others: Iterable[DeformableBody],
    ) -> bool | None:
        """Take a body in that touches something gently; whether it does, None for nothing at all.

        Args:
            body: that keeps its shape.
            colliders: at rest, that touch its surface.
            others: bodies that it may touch.
        """
        found: list[tuple[Pair, list[Touch]]] = []
        for collider in colliders:
            found.append(((body.name, collider.name), _on_collider(body, collider)))
        for other in others:
            if not self.holds(body, other.name):
                found.append(((body.name, other.name), _on_body(body, other)))
        touching = {pair: touches for pair, touches in found if touches}
        if any(_strikes(t) for touches in touching.values() for t in touches):
            return False
        self._touches |= touching
        return True if self.partners(body) else None

    def end(self, body: DeformableBody) -> None:
        """Forget all contacts of a body: from now on the grid or nothing holds it."""
        self._touches = {p: t for p, t in self._touches.items() if body.name not in p}

    def solve(self, duration: float, starts: Mapping[str, Float]) -> list[Reaction]:
        """Let contacts act on bodies that have moved freely; what they did.

        Args:
            duration: for how long they have [s].
            starts: [3] by name, where centres of mass were before that [m].
        """
        self._look_again()
        touches = [t for own in self._touches.values() for t in own]
        bodies = [b for t in touches for b in (t.body, t.other) if isinstance(b, DeformableBody)]
        free = {b.name: b for b in bodies if b.mode == BodyMode.RIGID}
        if not free:
            return []
        before = {name: body.motion for name, body in free.items()}
        speeds = {n: np.concatenate([m.velocity, m.angular_velocity]) for n, m in before.items()}
        went = {n: speed.copy() for n, speed in speeds.items()}
        for name, speed in went.items():
            # Steps within a step fall less far than the speed at their end says.
            speed[:3] = (before[name].centre - starts[name]) / duration
        shifts = {name: np.zeros(6) for name in free}
        step = _Step(before, speeds, went, shifts, duration)
        rows = [_Row(touch, step) for touch in touches]
        for row in rows:
            row.push(row.touch.impulse)
        for _ in range(SWEEPS):
            for row in rows:
                row.relax()
        # Bodies that part are not shifted: angular momentum goes with where velocities are.
        deep = [row for row in rows if row.is_deep and row.carries]
        for _ in range(PUSH_SWEEPS):
            for row in deep:
                row.lift()
        for name, body in free.items():
            moved = duration * (speeds[name] + shifts[name] - went[name])
            body.motion = _corrected(before[name], speeds[name], moved)
        return [reaction for row in rows for reaction in row.reactions()]

    def _look_again(self) -> None:
        """Find pairs anew whose points have slid or opened; forget those that are apart, and those
        that strike."""
        for pair, touches in list(self._touches.items()):
            body, other = touches[0].body, touches[0].other
            reach = DRIFT * body.spacing
            places = [t.place() for t in touches]
            if all(gap < reach and slid < reach for _, _, gap, slid in places):
                continue
            if isinstance(other, DeformableBody):
                known = _on_body(body, other)
            else:
                known = _on_collider(body, other, rest=min(t.rest for t in touches))
            for touch in known:
                nearest = min(touches, key=lambda t: float(np.abs(t.local - touch.local).sum()))
                touch.impulse = nearest.impulse * (len(touches) / len(known))
            # What falls over strikes with its far edge: that is an impact.
            if known and all(_closing(t) <= GENTLE for t in known):
                self._touches[pair] = known
            else:
                del self._touches[pair]


def touches_any(
    body: DeformableBody, colliders: Sequence[Collider], others: Iterable[DeformableBody]
) -> bool:
    """Whether a body touches a collider or another body."""
    return any(True for _ in collider_contacts(body, colliders)) or bool(
        body_contacts(body, others)
    )


def _on_collider(
    body: DeformableBody, collider: Collider, *, rest: float | None = None
) -> list[Touch]:
    """Where a body touches a collider; it carries as deep as it lies, or at ``rest`` [m]."""
    touches = []
    for contacts in collider_contacts(body, [collider]):
        distance, _ = clearance(collider, contacts.points)
        for point, gap in zip(contacts.points, distance.tolist(), strict=True):
            laid = min(gap, 0.0) if gap > LAID * body.spacing else gap
            depth = laid if rest is None else min(max(rest, laid), 0.0)
            local, mu = _local(body, point), contacts.friction(contacts.normals[0])
            touches.append(Touch(body, collider, local, local, local, depth, mu))
    return touches


def _on_body(body: DeformableBody, other: DeformableBody) -> list[Touch]:
    """Where a body touches another; it carries as they lie."""
    turn = other.T_world_object[:3, :3]
    touches = []
    for contacts in body_contacts(body, [other]):
        mu = contacts.friction(contacts.normals[0])
        for point, normal in zip(contacts.points, contacts.normals, strict=True):
            there = _local(other, point)
            touches.append(Touch(body, other, _local(body, point), there, turn.T @ normal, 0.0, mu))
    return touches


def _local(body: DeformableBody, point: Float) -> Float:
    pose = body.T_world_object
    local: Float = pose[:3, :3].T @ (point - pose[:3, 3])
    return local


def _closing(touch: Touch) -> float:
    """Speed at which the point and what carries it approach each other [m/s]."""
    own, normal, _, _ = touch.place()
    velocity = touch.body.motion.velocity_at(own)
    if isinstance(touch.other, DeformableBody):
        velocity = velocity - touch.other.motion.velocity_at(own)
    return -float(velocity @ normal)


def _strikes(touch: Touch) -> bool:
    """Whether this is an impact: too fast for rigid contact, or in the midst of being stopped.

    Bodies that carry each other jolt each other as they settle, so that only colliders stop.
    """
    if _closing(touch) > GENTLE or isinstance(touch.other, DeformableBody):
        return _closing(touch) > GENTLE
    return float(touch.body.acceleration @ touch.place()[1]) > STEADY


@dataclass(frozen=True, eq=False)
class _Step:
    """A step that contacts act on.

    Attributes:
        before: motions by name, as bodies have moved freely.
        speeds: [6] linear and angular by name, to be changed [m/s], [rad/s].
        went: [6] at which they have moved on the whole.
        shifts: [6] at which they are shifted beyond that, to be changed.
        duration: [s].
    """

    before: Mapping[str, RigidMotion]
    speeds: Mapping[str, Float]
    went: Mapping[str, Float]
    shifts: Mapping[str, Float]
    duration: float


class _Row:
    """A touch in one step: what impulses along its normal and two tangents do."""

    def __init__(self, touch: Touch, step: _Step) -> None:
        self.touch = touch
        own, normal, gap, _ = touch.place()
        axes = np.stack([normal, *tangents(normal, np.array([1.0, 0.3, 0.2]))])
        self._axes = axes
        self._sides: list[tuple[Float, Float, Float]] = []
        self._shifts: list[Float] = []
        stiffness, gone = np.zeros(3), 0.0
        for body, sign in ((touch.body, 1.0), (touch.other, -1.0)):
            motion = step.before.get(body.name)
            if motion is None:
                continue
            levers = np.cross(own - motion.centre, axes)
            jacobian = sign * np.concatenate([axes, levers], axis=1)
            change = jacobian.copy()
            change[:, :3] /= motion.mass
            change[:, 3:] = np.linalg.solve(motion.world_inertia, jacobian[:, 3:].T).T
            stiffness += (jacobian * change).sum(axis=1)
            gone += float(jacobian[0] @ step.went[body.name])
            self._sides.append((step.speeds[body.name], jacobian, change))
            self._shifts.append(step.shifts[body.name])
        self._masses = 1.0 / np.maximum(stiffness, 1e-12)
        start = gap - gone * step.duration
        self._least = -start / step.duration if start > SLOP else 0.0
        self._lift = min(-PUSH * (start + SLOP) / step.duration, PUSH_SPEED)
        self._lifted = 0.0

    @property
    def carries(self) -> bool:
        """Whether the point presses."""
        return float(self.touch.impulse[0]) > 0

    @property
    def is_deep(self) -> bool:
        """Whether the point lies deeper than it carries."""
        return self._lift > 0

    def lift(self) -> None:
        """Shift bodies, at a speed that is not kept, so that the point comes out."""
        rising = sum(
            float(jacobian[0] @ shift)
            for (_, jacobian, _), shift in zip(self._sides, self._shifts, strict=True)
        )
        wanted = max(self._lifted + (self._lift - rising) * self._masses[0], 0.0)
        for (_, _, change), shift in zip(self._sides, self._shifts, strict=True):
            np.add(shift, (wanted - self._lifted) * change[0], out=shift)
        self._lifted = wanted

    def push(self, impulse: Float) -> None:
        """Add an impulse along the three axes [N s]."""
        for speed, _, change in self._sides:
            np.add(speed, impulse @ change, out=speed)

    def reactions(self) -> list[Reaction]:
        """What it did, once all contacts agree."""
        touch, slip = self.touch, np.zeros(3)
        for own, jacobian, _ in self._sides:
            slip += jacobian @ own
        impulse = touch.impulse @ self._axes
        heat = max(-float(touch.impulse[1:] @ slip[1:]), 0.0)
        if not isinstance(touch.other, DeformableBody):
            return [Reaction(touch.body.name, touch.other.name, impulse, heat)]
        return [
            Reaction(touch.body.name, touch.other.name, impulse, heat / 2),
            Reaction(touch.other.name, touch.body.name, -impulse, heat / 2),
        ]

    def relax(self) -> None:
        """The impulse that this contact needs as things are now."""
        speed = np.zeros(3)
        for own, jacobian, _ in self._sides:
            speed += jacobian @ own
        known = self.touch.impulse
        normal = max(known[0] + (self._least - speed[0]) * self._masses[0], 0.0)
        across = known[1:] - speed[1:] * self._masses[1:]
        length, most = float(np.hypot(*across)), self.touch.friction * normal
        if length > most:
            across = across * (most / length)
        wanted = np.array([normal, *across])
        self.push(wanted - known)
        self.touch.impulse = wanted


def _corrected(motion: RigidMotion, speed: Float, moved: Float) -> RigidMotion:
    """The body moved and turned by ``moved`` [6] [m], [rad], and going on at ``speed`` [6]."""
    return replace(
        motion,
        rotation=rotation_of(moved[3:]) @ motion.rotation,
        centre=motion.centre + moved[:3],
        velocity=speed[:3].copy(),
        angular_velocity=speed[3:].copy(),
    )


def _into(pose: Float, point: Float) -> Float:
    moved: Float = pose[:3, :3] @ point + pose[:3, 3]
    return moved
