"""Resting contact: persistent rigid contacts, and stability at rest.

On a grid, stacked bodies keep sinking into each other. Once they no longer deform, they become
rigid and contact forces separate them. These forces are repulsive, have Coulomb friction, and
prevent deeper penetration than at the start of the contact (sequential impulses; Catto 2005). Each
step is warm started from the previous one. An approach faster than GENTLE_THRESHOLD is an impact
and deforms the bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry import Float
from ..physics.colliders import Collider
from .body import BodyMode, DeformableBody
from .rigid import RigidMotion, clearance, rotation_of

# Stability at rest: contact forces against gravity.

GAP_CELLS = 0.15
"""Maximum gap between a particle's corner and a surface in contact [cells]."""
SINK_CELLS = 1.5
"""Maximum depth of a contact inside a collider [cells]; deeper particles were placed there."""
DIRECTIONS = 8
"""Directions of friction at a contact; the first opposes gravity's pull along the surface."""
CORNERS = 16
"""Directions in which the outermost contact points are selected; inner points are not needed."""
SHORTFALL = 2e-3
"""Maximum unbalanced fraction of the weight: a tenth of a degree of slope."""
FRICTION_MAX = 1e3
"""Coefficient that represents sticking."""
_CUBE = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(8, 3)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of a body with one other body or collider.

    Attributes:
        other: name of the collider or body.
        points: [K, 3] [m].
        normals: [K, 3] towards the body, unit.
        friction: maximum friction over normal force in a direction [3] along the surface.
    """

    other: str
    points: Float
    normals: Float
    friction: Callable[[Float], float]


def supports_of(
    body: DeformableBody,
    colliders: Sequence[Collider],
    road: Sequence[Collider],
    others: Iterable[DeformableBody],
    gravity: Float,
) -> tuple[str, ...] | None:
    """Names of the supports of a resting body, or None if it is not stable.

    Args:
        body: the body.
        colliders: colliders that touch its surface.
        road: colliders that support tyres.
        others: resting bodies that may support it.
        gravity: [3] [m/s^2]; without gravity, no support is needed.
    """
    if not np.any(gravity):
        return ()
    contacts = [*_wheel_contacts(body, road), *collider_contacts(body, colliders)]
    if not _balanced(body, contacts, gravity):
        contacts += body_contacts(body, others)
        if not _balanced(body, contacts, gravity):
            return None
    return tuple(sorted({c.other for c in contacts}))


def _wheel_contacts(body: DeformableBody, road: Sequence[Collider]) -> Iterable[Contacts]:
    """Contacts of loaded wheels; brakes limit the friction along the rolling direction."""
    if body.tyres is None or not road:
        return
    tyres, pose = body.tyres, body.T_world_object
    forward = pose[:3, 0]

    def friction(along: Float) -> float:
        return tyres.grip_along(along, forward)

    for collider, point, normal in tyres.carrying(pose, road):
        yield Contacts(collider.name, point[None], normal[None], friction)


def collider_contacts(body: DeformableBody, colliders: Sequence[Collider]) -> Iterable[Contacts]:
    """Contacts of a body's outermost particles with each collider."""
    shell = body.shell_points()
    turn = body.T_world_object[:3, :3]
    for collider in colliders:
        distance, _ = clearance(collider, shell)
        near = shell[distance < body.spacing]
        if not len(near):
            continue
        corners = (near[:, None] + body.spacing * _CUBE @ turn.T).reshape(-1, 3)
        distance, normals = clearance(collider, corners)
        touching = (distance < GAP_CELLS * body.cell) & (distance > -SINK_CELLS * body.cell)
        mu = body.friction if collider.friction is None else collider.friction
        yield from _by_normal(collider.name, corners[touching], normals[touching], mu)


def body_contacts(body: DeformableBody, others: Iterable[DeformableBody]) -> list[Contacts]:
    """Contacts with particles of other bodies; the normal is the mean direction from them."""
    from scipy.spatial import cKDTree

    contacts: list[Contacts] = []
    own = body.shell_points()
    for other in others:
        reach = (body.spacing + other.spacing) / 2 + GAP_CELLS * body.cell
        if other is body or body.gap_to(other) > reach:
            continue
        theirs = other.shell_points()
        found = cKDTree(theirs).query_ball_point(own, 1.2 * reach)
        touching = np.flatnonzero([len(f) > 0 for f in found])
        if not len(touching):
            continue
        away = np.stack([own[k] - theirs[found[k]].mean(axis=0) for k in touching])
        normals = away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
        mean = normals.mean(axis=0)
        mean /= max(float(np.linalg.norm(mean)), 1e-9)
        points = own[touching] - normals * body.spacing / 2
        mu = float(np.sqrt(body.friction * other.friction))
        contacts += _by_normal(other.name, points, np.tile(mean, (len(points), 1)), mu)
    return contacts


def _by_normal(name: str, points: Float, normals: Float, mu: float) -> Iterable[Contacts]:
    """Contacts grouped by similar normals, with the outermost points of each group."""
    if not len(points):
        return
    _, group = np.unique(np.round(4 * normals), axis=0, return_inverse=True)
    for g in range(int(group.max()) + 1):
        own = np.flatnonzero(group.ravel() == g)
        kept = own[_outermost(points[own], normals[own].mean(axis=0))]
        yield Contacts(name, points[kept], normals[kept], lambda along: mu)


def _outermost(points: Float, normal: Float) -> Float:
    first, second = tangents(normal, np.array([1.0, 0.3, 0.2]))
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    directions = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return np.unique((points @ directions.T).argmax(axis=0))


def tangents(normal: Float, pull: Float) -> tuple[Float, Float]:
    """Two unit tangents of the surface: against ``pull``, and perpendicular to it."""
    along = (pull @ normal) * normal - pull
    length = float(np.linalg.norm(along))
    if length < 1e-6 * float(np.linalg.norm(pull)):
        along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        length = float(np.linalg.norm(along))
    first = along / length
    return first, np.cross(normal, first)


def _balanced(body: DeformableBody, contacts: Sequence[Contacts], gravity: Float) -> bool:
    """Whether forces within the friction cones balance weight and moments."""
    from scipy.optimize import nnls

    if not contacts:
        return False
    arm = max(body.reach, 1e-6)
    columns = []
    for c in contacts:
        for point, normal in zip(c.points, c.normals, strict=True):
            first, second = tangents(normal, gravity)
            lever = (point - body.motion.centre) / arm
            for k in range(DIRECTIONS):
                angle = 2 * np.pi * k / DIRECTIONS
                along = np.cos(angle) * first + np.sin(angle) * second
                force = normal + min(c.friction(along), FRICTION_MAX) * along
                columns.append(np.concatenate([force, np.cross(lever, force)]))
    weight = np.concatenate([-gravity / np.linalg.norm(gravity), np.zeros(3)])
    _, left = nnls(np.array(columns).T, weight)
    return bool(left < SHORTFALL)


GENTLE_THRESHOLD = 0.3
"""Maximum closing speed of a contact that carries load without deforming or bouncing [m/s]."""
STEADY_THRESHOLD = 2.0
"""Maximum acceleration away from a collider for a body at rest on it [m/s^2]; above this, the body
is still bouncing."""
SWEEPS = 30
"""Passes over all contacts in a step."""
DRIFT = 0.1
"""Sliding or opening distance after which a pair's contact points are updated [spacings]."""
LAID_THRESHOLD = 0.1
"""Points higher than this above a collider carry no load yet [spacings]."""
PUSH, PUSH_SPEED = 0.2, 0.05
"""Fraction of the excess depth corrected in a step, and maximum correction speed [m/s]. Corrections
move bodies without changing their velocities; bodies therefore come to rest."""
SLOP = 1e-4
"""Tolerance of the rest gap [m]; correcting smaller errors would keep bodies in motion."""
PUSH_SWEEPS = 10
"""Passes over all contacts that are too deep, in a step."""

Pair = tuple[str, str]


@dataclass(eq=False)
class ContactPoint:
    """One contact point of a body.

    Attributes:
        body: the supported body.
        other: the supporting body or collider.
        local: [3] contact point, body frame [m].
        there, normal: [3] contact point and unit normal towards this body, in the frame of the
            other body [m]; computed on demand for colliders.
        rest: gap at which it carries load [m].
        friction: Coulomb coefficient.
        impulse: [3] impulse of the last step along the normal and two tangents [N s].
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
        """Position [m], normal, gap beyond ``rest`` [m] and sliding distance [m]."""
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
    """The effect of a contact in one step.

    Attributes:
        body, other: the affected body, and the other body or collider.
        impulse: [3] impulse on the body, world frame [N s].
        heat: energy dissipated by friction, half of it on each of two bodies [J].
    """

    body: str
    other: str
    impulse: Float
    heat: float


class RestingContacts:
    """Contacts of settled bodies, by body and support."""

    def __init__(self) -> None:
        self._touches: dict[Pair, list[ContactPoint]] = {}

    def holds(self, body: DeformableBody, other: str) -> bool:
        """Whether a body has a contact with another body or collider."""
        return (body.name, other) in self._touches or (other, body.name) in self._touches

    def partners(self, body: DeformableBody) -> set[str]:
        """All contact partners of a body."""
        return {name for pair in self._touches if body.name in pair for name in pair} - {body.name}

    def island(self, body: DeformableBody) -> set[str]:
        """The bodies connected by contacts with a body, including itself."""
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
        """Add a body if its contacts are gentle. Returns whether they are; None without contact.

        Args:
            body: rigid body.
            colliders: colliders at rest that touch its surface.
            others: bodies that it may touch.
        """
        found: list[tuple[Pair, list[ContactPoint]]] = []
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
        """Remove all contacts of a body."""
        self._touches = {p: t for p, t in self._touches.items() if body.name not in p}

    def solve(self, duration: float, starts: Mapping[str, Float]) -> list[Reaction]:
        """Apply contacts to bodies that have moved freely; returns their reactions.

        Args:
            duration: duration of the free motion [s].
            starts: [3] centres of mass before it, by name [m].
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
            # Substeps fall less far than the final velocity suggests.
            speed[:3] = (before[name].centre - starts[name]) / duration
        shifts = {name: np.zeros(6) for name in free}
        step = _Step(before, speeds, went, shifts, duration)
        rows = [_Row(touch, step) for touch in touches]
        for row in rows:
            row.push(row.touch.impulse)
        for _ in range(SWEEPS):
            for row in rows:
                row.relax()
        # Separating bodies are not shifted, because this would change the angular momentum.
        deep = [row for row in rows if row.is_deep and row.carries]
        for _ in range(PUSH_SWEEPS):
            for row in deep:
                row.lift()
        for name, body in free.items():
            moved = duration * (speeds[name] + shifts[name] - went[name])
            body.motion = _corrected(before[name], speeds[name], moved)
        return [reaction for row in rows for reaction in row.reactions()]

    def _look_again(self) -> None:
        """Update pairs whose points have slid or opened; remove separated pairs and impacts."""
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
            # A body that tips over strikes with its far edge, and this is an impact.
            if known and all(_closing(t) <= GENTLE_THRESHOLD for t in known):
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
) -> list[ContactPoint]:
    """Contact points with a collider, with the current gap as rest gap, or ``rest`` [m]."""
    touches = []
    for contacts in collider_contacts(body, [collider]):
        distance, _ = clearance(collider, contacts.points)
        for point, gap in zip(contacts.points, distance.tolist(), strict=True):
            laid = min(gap, 0.0) if gap > LAID_THRESHOLD * body.spacing else gap
            depth = laid if rest is None else min(max(rest, laid), 0.0)
            local, mu = _local(body, point), contacts.friction(contacts.normals[0])
            touches.append(ContactPoint(body, collider, local, local, local, depth, mu))
    return touches


def _on_body(body: DeformableBody, other: DeformableBody) -> list[ContactPoint]:
    """Contact points with another body, with the current gap as rest gap."""
    turn = other.T_world_object[:3, :3]
    touches = []
    for contacts in body_contacts(body, [other]):
        mu = contacts.friction(contacts.normals[0])
        for point, normal in zip(contacts.points, contacts.normals, strict=True):
            there = _local(other, point)
            touches.append(
                ContactPoint(body, other, _local(body, point), there, turn.T @ normal, 0.0, mu)
            )
    return touches


def _local(body: DeformableBody, point: Float) -> Float:
    pose = body.T_world_object
    local: Float = pose[:3, :3].T @ (point - pose[:3, 3])
    return local


def _closing(touch: ContactPoint) -> float:
    """Closing speed of the point and its support [m/s]."""
    own, normal, _, _ = touch.place()
    velocity = touch.body.motion.velocity_at(own)
    if isinstance(touch.other, DeformableBody):
        velocity = velocity - touch.other.motion.velocity_at(own)
    return -float(velocity @ normal)


def _strikes(touch: ContactPoint) -> bool:
    """Whether this is an impact: too fast for rigid contact, or still being stopped.

    The latter only applies to colliders, because stacked bodies jolt each other as they settle.
    """
    if _closing(touch) > GENTLE_THRESHOLD or isinstance(touch.other, DeformableBody):
        return _closing(touch) > GENTLE_THRESHOLD
    return float(touch.body.acceleration @ touch.place()[1]) > STEADY_THRESHOLD


@dataclass(frozen=True, eq=False)
class _Step:
    """One step in which contacts act.

    Attributes:
        before: motions after free motion, by name.
        speeds: [6] linear and angular velocities by name, updated [m/s], [rad/s].
        went: [6] mean velocities of the free motion.
        shifts: [6] additional position correction velocities, updated.
        duration: [s].
    """

    before: Mapping[str, RigidMotion]
    speeds: Mapping[str, Float]
    went: Mapping[str, Float]
    shifts: Mapping[str, Float]
    duration: float


class _Row:
    """A contact point in one step: effects of impulses along its normal and two tangents."""

    def __init__(self, touch: ContactPoint, step: _Step) -> None:
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
        """Whether the point transmits a repulsive force."""
        return float(self.touch.impulse[0]) > 0

    @property
    def is_deep(self) -> bool:
        """Whether the point is deeper than its rest gap."""
        return self._lift > 0

    def lift(self) -> None:
        """Shift bodies to resolve the penetration, without changing their velocities."""
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
        """Reactions of the point, after all contacts have converged."""
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
        """Update the impulse of this contact for the current velocities."""
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
    """The body moved by ``moved`` [6] [m], [rad], with velocities ``speed`` [6]."""
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
