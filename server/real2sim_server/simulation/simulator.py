"""The hybrid simulator, which decides which bodies deform and which are rigid."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float
from ..physics.colliders import Box, Collider
from ..physics.solver import ContactTotals, Solver, SolverOptions
from .body import SLEEP_SPEED, BodyMode, DeformableBody
from .rebound import Bounces
from .resting import GENTLE_THRESHOLD, RestingContacts, supports_of, touches_any
from .result import ContactRecord
from .tyres import TyreReaction

# Contacts and energies, over deforming and rigid motion.


class ContactLog:
    """Impulses and energies since the start, by body and contact partner.

    Attributes:
        collider_work: work of moving colliders on bodies [J].
    """

    def __init__(self) -> None:
        self._impulses: dict[tuple[str, str], Float] = {}
        self._friction_work: dict[tuple[str, str], float] = {}
        self._times: dict[tuple[str, str], list[float]] = {}
        self._dozing: dict[tuple[str, str], float] = {}
        self._asleep: dict[tuple[str, str], float] = {}
        self._solver_totals: dict[tuple[str, str], tuple[Float, float, float]] = {}
        self.collider_work = 0.0

    def start_solver(self) -> None:
        """Reset the counters for a new solver."""
        self._solver_totals = {}

    def add_solver_contacts(
        self, contacts: Iterable[ContactTotals], time: float, names: set[str]
    ) -> None:
        """Add the growth of a solver's contacts since the last call.

        Args:
            contacts: contacts of the current solver since its start.
            time: [s].
            names: names of all bodies; all others are colliders.
        """
        for c in contacts:
            key = (c.body, c.other)
            impulse, friction_work, work = self._solver_totals.get(key, (np.zeros(3), 0.0, 0.0))
            self.add(*key, c.impulse - impulse, c.friction_work - friction_work, time)
            if c.other not in names:
                self.collider_work += c.work - work
            self._solver_totals[key] = (np.array(c.impulse), c.friction_work, c.work)

    def add(self, body: str, other: str, impulse: Float, friction_work: float, time: float) -> None:
        """Add an impulse [3] [N s] and friction work [J] at a time [s]."""
        key = (body, other)
        if not np.any(impulse):
            return
        self._impulses[key] = self._impulses.get(key, np.zeros(3)) + impulse
        self._friction_work[key] = self._friction_work.get(key, 0.0) + friction_work
        times = self._times.setdefault(key, [time, time])
        times[1] = time
        self._asleep[key] = self._asleep.get(key, 0.0) + self._dozing.pop(key, 0.0)

    def add_sleep(self, bodies: set[str], time: float, duration: float) -> None:
        """Count a step of sleep at a time [s].

        Support forces of a sleeping body are only recorded in steps with resting neighbours. All
        other steps count as sleep once another impulse follows.
        """
        for key, (_, last) in self._times.items():
            if key[0] in bodies and last != time:
                self._dozing[key] = self._dozing.get(key, 0.0) + duration

    def totals(self) -> dict[tuple[str, str], Float]:
        """Impulses so far, by (body, other) [N s]."""
        return {key: value.copy() for key, value in self._impulses.items()}

    @property
    def friction_work(self) -> float:
        """Energy dissipated by friction so far [J]."""
        return sum(self._friction_work.values())

    def records(self, masses: dict[str, float], gravity: Float) -> tuple[ContactRecord, ...]:
        """All contacts, in the order they began.

        Args:
            masses: masses of bodies [kg].
            gravity: [3] acceleration [m/s^2].
        """
        order = sorted(self._impulses, key=lambda key: (self._times[key][0], key))
        return tuple(
            ContactRecord(
                object_id=key[0],
                other=key[1],
                impulse=_three(self._impulses[key]),
                delta_v=float(np.linalg.norm(self._impulses[key])) / masses[key[0]],
                first_s=self._times[key][0],
                last_s=self._times[key][1],
                heat=self._friction_work[key],
                impact_delta_v=self._impact_delta_v(key, masses[key[0]], gravity),
            )
            for key in order
        )

    def _impact_delta_v(self, key: tuple[str, str], mass: float, gravity: Float) -> float:
        """Delta-v of the impulse without the support of the weight between first and last touch.

        Time asleep is excluded; only the component against gravity is reduced.
        """
        impulse, (first, last) = self._impulses[key] / mass, self._times[key]
        awake = last - first - self._asleep[key]
        strength = float(np.linalg.norm(gravity))
        if strength == 0:
            return float(np.linalg.norm(impulse))
        up = -gravity / strength
        carried = float(np.clip(impulse @ up, 0.0, strength * awake))
        return float(np.linalg.norm(impulse - carried * up))


def _three(vector: Float) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def energies(bodies: Iterable[DeformableBody], gravity: Float) -> tuple[float, float, float]:
    """Current kinetic, elastic and gravity energy of all bodies [J]."""
    kinetic = elastic = potential = 0.0
    for body in bodies:
        kinetic += body.kinetic_energy
        elastic += body.elastic_energy
        potential -= body.motion.mass * float(gravity @ body.motion.centre)
    return kinetic, elastic, potential


# Unyielding bodies stay rigid and act as colliders for other bodies: a cone does not dent a truck.
# If the total energy of an impact cannot dent a body by more than its particles resolve, only the
# lighter body deforms. The other body is represented by a few boxes on its nearby surface and
# receives the exchanged impulse and moment.

LIGHTER = 10.0
"""Minimum mass ratio at which the heavier body may stay rigid."""
DENT = 0.5
"""Smallest dent that particles resolve [spacings]."""
PATCH_CELLS = 4.0
"""Margin around the other body within which boxes cover a body's surface [cells]."""
ALIKE = 1.5
"""Layers whose sides differ by less than this become one box [spacings]."""


def withstands(body: DeformableBody, other: DeformableBody, gravity: Float) -> bool:
    """Whether a body keeps its shape in an impact with another one at their current speeds.

    The yield force is the lowest nearby yield stress times the smallest face of the other body.
    Purely elastic bodies deform at any force and never withstand.

    Args:
        body: the body.
        other: a body that touches it or is about to.
        gravity: [3] [m/s^2].
    """
    a, b = body.motion, other.motion
    if LIGHTER * b.mass > a.mass:
        return False
    near = np.unique(body.regions[_patch(body, other)]).tolist()
    if not near:
        return True
    strength = min(body.materials[region].strength for region in near)
    if not math.isfinite(strength):
        return False
    speed = float(np.linalg.norm(a.velocity - b.velocity))
    speed += body.reach * float(np.linalg.norm(a.angular_velocity))
    speed += other.reach * float(np.linalg.norm(b.angular_velocity))
    energy = a.mass * b.mass / (a.mass + b.mass) * speed * speed / 2
    edges = np.sort(other.box()[1])
    force = strength * float(edges[0] * edges[1]) - b.mass * float(np.linalg.norm(gravity))
    return bool(energy < force * DENT * body.spacing)


def as_boxes(body: DeformableBody, other: DeformableBody) -> list[Box]:
    """The part of a body within reach of another, as stacked boxes that move with the body."""
    pose, m, s = body.T_world_object, body.motion, body.spacing
    local = body.local_positions()[_patch(body, other)]
    boxes: list[Box] = []
    for low, high in _layers(local, body.cell, s):
        middle = np.eye(4)
        middle[:3, 3] = (low + high) / 2
        place = pose @ middle
        boxes.append(
            Box(
                name=f"{body.name}:{other.name}:{len(boxes)}",
                T_world_box=place,
                size=high - low,
                velocity=m.velocity_at(place[:3, 3]),
                angular_velocity=m.angular_velocity,
                friction=math.sqrt(body.friction * other.friction),
            )
        )
    return boxes


def by_owner(
    contacts: Iterable[ContactTotals], owners: Mapping[str, DeformableBody]
) -> list[ContactTotals]:
    """Contacts, with those of a body's boxes summed under the body's name."""
    found: dict[tuple[str, str], ContactTotals] = {}
    for c in contacts:
        other = owners[c.other].name if c.other in owners else c.other
        known = found.get((c.body, other))
        if known is None:
            found[c.body, other] = replace(c, other=other)
            continue
        found[c.body, other] = replace(
            known,
            impulse=known.impulse + c.impulse,
            moment=known.moment + c.moment,
            friction_work=known.friction_work + c.friction_work,
            work=known.work + c.work,
        )
    return list(found.values())


def _patch(body: DeformableBody, other: DeformableBody) -> NDArray[np.bool_]:
    """[N] whether particles of a body are in a cube around another body, aligned with the first."""
    pose = body.T_world_object
    centre = pose[:3, :3].T @ (other.motion.centre - pose[:3, 3])
    half = other.reach + PATCH_CELLS * body.cell
    inside: NDArray[np.bool_] = np.all(np.abs(body.local_positions() - centre) < half, axis=1)
    return inside


def _layers(local: Float, cell: float, spacing: float) -> list[tuple[Float, Float]]:
    """Corners (low, high) of stacked boxes around particles [N, 3]."""
    level = np.floor(local[:, 2] / cell)
    layers: list[tuple[Float, Float]] = []
    for k in np.unique(level).tolist():
        own = local[level == k]
        low, high = own.min(axis=0) - spacing / 2, own.max(axis=0) + spacing / 2
        if layers:
            below_low, below_high = layers[-1]
            apart = np.abs(np.concatenate([low - below_low, high - below_high])[[0, 1, 3, 4]])
            if apart.max() < ALIKE * spacing:
                low, high = np.minimum(low, below_low), np.maximum(high, below_high)
                layers.pop()
        layers.append((low, high))
    return layers


STEP = 0.005
"""Maximum time between two proximity checks [s]."""
NEAR_CELLS = 3.0
"""Bodies closer than this share grid nodes [cells]."""
TOUCH_CELLS = 0.25
"""Gap within a step at which bodies are activated [cells]. Free motion until then is exact and
cheap. The front of a body moves less than this in a step relative to its centre."""
ROAD_CELLS = 0.4
"""The same gap for the road under a body on wheels, which is always near the road [cells]."""
LAG = 0.01
"""Maximum speed at the surface by which particles may lag behind the rotation of their body [m/s].
"""
APPROACH_MIN = 1e-3
"""Minimum speed times distance at which bodies approach each other [m^2/s], or minimum speed [m/s].
"""
HIT_DELTA_V = 0.3
"""Minimum delta-v of a contact that counts as a hit of a vehicle [m/s]."""
TYRES = "tyres"
"""Name of the road in the contact log for forces through tyres."""


class HybridSimulator:
    """Simulator of bodies and colliders that switches bodies between rigid and deforming.

    A body is rigid until something is near, deforms in a solver while in contact, and becomes rigid
    or falls asleep once it has settled. Bodies track their state; the simulator triggers the
    transitions.

    Args:
        bodies: simulated bodies.
        colliders: rigid colliders.
        road: names of colliders that support tyres.
        gravity: [3] [m/s^2].
        backend: solver backend.
        brake_after_hit: braked fraction of the wheels' grip after a vehicle is hit.
        cfl: fraction of a cell that waves may cross in a substep of the solver.

    Attributes:
        bodies, colliders: current bodies and colliders.
        contact_log: impulses and energies since the start.
        bounces: impacts of bodies with a requested restitution.
        time: time since the start [s].
        substeps, rollbacks: totals of all solvers so far.
    """

    def __init__(
        self,
        bodies: Sequence[DeformableBody],
        colliders: Sequence[Collider],
        *,
        road: Sequence[str],
        gravity: ArrayLike,
        backend: str,
        brake_after_hit: float,
        cfl: float = SolverOptions.cfl,
    ) -> None:
        self.bodies = list(bodies)
        self.colliders = list(colliders)
        self.gravity = np.array(gravity, dtype=np.float64)
        self.contact_log = ContactLog()
        self.bounces = Bounces()
        self.time = 0.0
        self.substeps = self.rollbacks = 0
        self._road = frozenset(road)
        self._backend = backend
        self._brake_after_hit = brake_after_hit
        self._cfl = cfl
        self._names = {b.name for b in bodies}
        self._solver: Solver | None = None
        self._solved: list[str] = []
        self._resting = RestingContacts()
        self._floors: dict[str, float] = {}
        for body in self.bodies:
            if not (np.any(body.motion.velocity) or np.any(body.motion.angular_velocity)):
                self._put_to_sleep(body)

    @property
    def road(self) -> list[Collider]:
        """Colliders that support tyres."""
        return [c for c in self.colliders if c.name in self._road]

    def advance(self, duration: float) -> None:
        """Advance by ``duration`` [s], at most STEP."""
        self._wake()
        self._activate(duration)
        deforming = [b for b in self.bodies if b.mode == BodyMode.DEFORMING]
        if deforming:
            self._solve(deforming, duration)
        starts = {b.name: b.motion.centre for b in self.bodies}
        for body in self.bodies:
            if body.mode == BodyMode.RIGID:
                reaction = body.advance_rigid(duration, self.gravity, self.road)
                if reaction is not None:
                    self._log_tyres(body, [reaction])
        self._touch_more()
        for r in self._resting.solve(duration, starts):
            self.contact_log.add(r.body, r.other, r.impulse, r.heat, self.time)
        self._lay_to_rest(duration)
        asleep = {b.name for b in self.bodies if b.mode == BodyMode.SLEEPING}
        self.contact_log.add_sleep(asleep, self.time, duration)
        if not deforming:
            self.colliders = [c.after(duration) for c in self.colliders]
        self.time += duration
        for body in deforming:
            self._brake_if_hit(body)
            body.update_timers(duration)
        for body in deforming:
            self._settle(body)

    def _activate(self, duration: float) -> None:
        """Activate all bodies within reach of others, and those within reach of these."""
        changed = True
        while changed:
            changed = False
            for body in self.bodies:
                if body.mode != BodyMode.DEFORMING and self._is_near_anything(body, duration):
                    body.activate()
                    self._resting.end(body)
                    self._solver = None
                    changed = True

    def _solve(self, deforming: list[DeformableBody], duration: float) -> None:
        rigid = self._rigid_beside(deforming)
        solver = self._solver_of(deforming, [box for box, _ in rigid])
        before = {b.name: b.motion for b in deforming}
        report = solver.step(duration)
        self.substeps += report.substeps
        self.rollbacks += report.rollbacks
        self.colliders = list(solver.colliders)[: len(self.colliders)]
        contacts = by_owner(solver.contacts, {box.name: body for box, body in rigid})
        self.contact_log.add_solver_contacts(contacts, self.time, self._names)
        self._push_back(contacts, {body.name: body for _, body in rigid})
        for body, state in zip(deforming, solver.states(), strict=True):
            body.update_from_solver(state)
            reaction = body.apply_road(self.road, duration)
            if reaction is not None:
                self._log_tyres(body, [reaction])
                self._solver = None
            if body.reach * float(np.linalg.norm(body.lag)) > LAG:
                body.catch_up()
                self._solver = None
        step = (self.time + duration, duration, self.gravity)
        for c in self.bounces.follow(contacts, deforming, self.colliders, before, step):
            c.body.apply_impulse(c.after)
            self.contact_log.add(c.body.name, c.other, c.impulse, 0.0, self.time)
            self._solver = None

    def _rigid_beside(self, deforming: list[DeformableBody]) -> list[tuple[Box, DeformableBody]]:
        """Boxes that represent rigid bodies near deforming ones."""
        return [
            (box, other)
            for body in deforming
            for other in self.bodies
            if other.mode != BodyMode.DEFORMING
            and _near(body, other)
            and withstands(other, body, self.gravity)
            for box in as_boxes(other, body)
        ]

    def _solver_of(self, deforming: list[DeformableBody], boxes: list[Box]) -> Solver:
        """The solver of these bodies; a new one if bodies change or boxes are needed.

        Boxes cover the current surroundings of a body and change in every step.
        """
        names = [b.name for b in deforming]
        if self._solver is not None and self._solved == names and not boxes:
            return self._solver
        self._solver = Solver(
            [b.solver_body() for b in deforming],
            [*self.colliders, *boxes],
            SolverOptions(
                dx=deforming[0].cell,
                gravity=tuple(self.gravity),
                backend=self._backend,
                cfl=self._cfl,
            ),
        )
        self._solved = names + [box.name for box in boxes]
        self.contact_log.start_solver()
        self.bounces.start_solver()
        return self._solver

    def _push_back(
        self, contacts: Iterable[ContactTotals], rigid: dict[str, DeformableBody]
    ) -> None:
        """Apply to rigid bodies the reactions of deforming ones in a step."""
        for c in contacts:
            if c.other in rigid:
                rigid[c.other].push(-c.impulse, -c.moment)
                self.contact_log.add(c.other, c.body, -c.impulse, 0.0, self.time)

    def _log_tyres(self, body: DeformableBody, reactions: Iterable[TyreReaction]) -> None:
        for r in reactions:
            self.contact_log.add(body.name, TYRES, r.impulse, r.friction_work, self.time)

    def _settle(self, body: DeformableBody) -> None:
        """Make a settled body rigid, or put it to sleep."""
        if body.may_rigidify and self._may_be_rigid(body):
            body.rigidify()
        elif body.may_sleep and not self._is_loaded(body) and self._put_to_sleep(body):
            pass
        else:
            return
        self.bounces.forget(body)
        self._solver = None

    def _brake_if_hit(self, body: DeformableBody) -> None:
        """Brake the wheels of a vehicle after a hit, as configured."""
        if body.hit or body.tyres is None:
            return
        for (name, other), impulse in self.contact_log.totals().items():
            hard = float(np.linalg.norm(impulse)) > HIT_DELTA_V * body.motion.mass
            if name == body.name and other != TYRES and other not in self._road and hard:
                body.brake_after_hit(self._brake_after_hit)
                return

    def _put_to_sleep(self, body: DeformableBody) -> bool:
        """Put a body to sleep if its supports are still; return whether they are."""
        others = [b for b in self.bodies if b is not body and not _moves(b)]
        supports = supports_of(body, self.colliders, self.road, others, self.gravity)
        if supports is None or {c.name for c in self.colliders if c.moving}.intersection(supports):
            return False
        body.put_to_sleep(supports)
        return True

    def _wake(self) -> None:
        """Wake bodies with moving supports, and bodies that rest on them."""
        asleep = [b for b in self.bodies if b.mode == BodyMode.SLEEPING]
        if not asleep:
            return
        moved = {c.name for c in self.colliders if c.moving}
        moved |= {b.name for b in self.bodies if _moves(b)}
        for body in asleep:
            if not moved.isdisjoint(body.supports):
                body.wake()

    def _is_near_anything(self, body: DeformableBody, duration: float) -> bool:
        """Whether something will be near within ``duration`` [s]."""
        asleep = body.mode == BodyMode.SLEEPING
        held = self._resting.partners(body)
        if held:
            return self._is_struck(body, held, duration)
        others = [
            b for b in self.bodies if not (asleep and b.mode == BodyMode.SLEEPING) and b is not body
        ]
        if self._is_near_bodies(body, others, duration):
            return True
        walls = self._walls(body)
        if asleep:
            walls = [c for c in walls if c.moving]
        if body.meets(walls, within=_touch_distance(body), ahead=duration):
            return True
        return not asleep and self._strikes_through(body, duration)

    def _is_struck(self, body: DeformableBody, held: Set[str], duration: float) -> bool:
        """Whether a supported body deforms again.

        It does if its contact partners deform, or if something approaches faster than rigid
        contacts allow.
        """
        others = [b for b in self.bodies if b is not body]
        if any(b.name in held and b.mode == BodyMode.DEFORMING for b in others):
            return True
        beside = self._resting.island(body)
        fast = [b for b in others if b.name not in beside and _closing(body, b) > GENTLE_THRESHOLD]
        if self._is_near_bodies(body, fast, duration):
            return True
        asleep = body.mode == BodyMode.SLEEPING
        for collider in self._walls(body):
            if not collider.moving and (asleep or collider.name in held):
                continue
            gap, approach = body.gap_to_colliders([collider])
            # Rigid contacts do not support moving colliders, even slow ones.
            least = APPROACH_MIN if collider.moving else GENTLE_THRESHOLD
            if approach > least and gap < _touch_distance(body) + approach * duration:
                return True
        return not asleep and self._strikes_through(body, duration)

    def _strikes_through(self, body: DeformableBody, duration: float) -> bool:
        """Whether the floor of a body on wheels strikes the road because its springs are too weak.

        Springs and rigid contacts absorb gentle landings without deformation.
        """
        if body.tyres is None:
            return False
        gap, approach = body.gap_to_colliders(self.road)
        self._floors[body.name] = gap
        return approach > GENTLE_THRESHOLD and gap < ROAD_CELLS * body.cell + approach * duration

    def _may_be_rigid(self, body: DeformableBody) -> bool:
        """Whether a settled body is free or rests on non-deforming supports.

        Rigid contacts then support it.
        """
        fixed = [c for c in self._walls(body) if not c.moving]
        if body.tyres is not None and body.gap_to_colliders(self.road)[0] < body.spacing / 2:
            fixed += [c for c in self.road if not c.moving]
        others = [b for b in self.bodies if b is not body and _near(body, b)]
        moving = [c for c in self._walls(body) if c.moving]
        if body.meets(moving, within=NEAR_CELLS * body.cell, ahead=STEP):
            return False
        if not all(b.may_rigidify for b in self._deforming_with(body)):
            return not touches_any(body, [], others) and self._is_free(body)
        found = self._resting.begin(body, fixed, others)
        return self._is_free(body) if found is None else found

    def _deforming_with(self, body: DeformableBody) -> list[DeformableBody]:
        """Deforming bodies near a body, transitively."""
        left = [b for b in self.bodies if b.mode == BodyMode.DEFORMING and b is not body]
        found = [body]
        for at in found:
            beside = [b for b in left if _near(at, b)]
            found += beside
            left = [b for b in left if b not in beside]
        return found[1:]

    def _touch_more(self) -> None:
        """Add new contacts to the supports of resting bodies."""
        for body in self.bodies:
            held, near = self._resting.partners(body), body.spacing / 2
            if body.mode == BodyMode.RIGID and self._floors.get(body.name, np.inf) < near:
                road = [c for c in self.road if not c.moving and c.name not in held]
                self._resting.begin(body, road, [])
            if body.mode != BodyMode.RIGID or not held:
                continue
            walls = [
                c
                for c in self._walls(body)
                if not c.moving and c.name not in held and body.gap_to_colliders([c])[0] < near
            ]
            others = [
                b
                for b in self.bodies
                if b is not body
                and b.mode != BodyMode.DEFORMING
                and b.name not in held
                and body.gap_to(b) < near
            ]
            if walls or others:
                self._resting.begin(body, walls, others)

    def _is_loaded(self, body: DeformableBody) -> bool:
        """Whether a deforming body may touch the body."""
        return any(
            b is not body and b.mode == BodyMode.DEFORMING and _near(body, b) for b in self.bodies
        )

    def _lay_to_rest(self, duration: float) -> None:
        """Put still rigid bodies to sleep, one contact island at a time."""
        for body in self.bodies:
            if body.mode == BodyMode.RIGID and self._resting.partners(body):
                body.note_standing(duration)
        for body in self.bodies:
            if body.mode == BodyMode.RIGID and body.has_parked:
                beside = [b for b in self.bodies if b.name in self._resting.partners(body)]
                if all(b.mode == BodyMode.SLEEPING or b.has_parked for b in beside):
                    self._put_to_sleep(body)

    def _is_free(self, body: DeformableBody) -> bool:
        """Whether a deforming body may continue as a rigid one."""
        if self._is_near_bodies(body, [b for b in self.bodies if b is not body], STEP):
            return False
        gap, approach = body.gap_to_colliders(self._walls(body))
        if gap < _touch_distance(body) and (approach > 0 or body.tyres is None):
            return False
        return not self._strikes_through(body, STEP)

    def _is_near_bodies(
        self, body: DeformableBody, others: Iterable[DeformableBody], duration: float
    ) -> bool:
        for other in others:
            turning = _turning(body) + _turning(other)
            if not _approach(body, other) and turning <= GENTLE_THRESHOLD:
                continue
            closing = float(np.linalg.norm(body.motion.velocity - other.motion.velocity))
            near = TOUCH_CELLS * body.cell + (closing + turning) * duration
            if body.gap_to(other) < near and not withstands(body, other, self.gravity):
                return True
        return False

    def _walls(self, body: DeformableBody) -> list[Collider]:
        """Colliders in contact with the body's own surface, not with its tyres."""
        if body.tyres is None:
            return self.colliders
        return [c for c in self.colliders if c.name not in self._road]


def _moves(body: DeformableBody) -> bool:
    """Whether a body moves or turns faster than the limit for sleep."""
    m = body.motion
    speed = float(np.linalg.norm(m.velocity)) + float(np.linalg.norm(m.angular_velocity))
    return body.mode != BodyMode.SLEEPING and speed > SLEEP_SPEED


def _touch_distance(body: DeformableBody) -> float:
    """Minimum distance of a collider to the outermost particles of a rigid body [m]."""
    return TOUCH_CELLS * body.cell + body.spacing / 2


def _turning(body: DeformableBody) -> float:
    """Upper bound of the speed of a body's points due to rotation [m/s]."""
    return body.reach * float(np.linalg.norm(body.motion.angular_velocity))


def _near(a: DeformableBody, b: DeformableBody) -> bool:
    """Whether two bodies may touch."""
    return a.gap_to(b) < NEAR_CELLS * a.cell


def _closing(a: DeformableBody, b: DeformableBody) -> float:
    """Closing speed of two bodies [m/s]."""
    along = b.motion.centre - a.motion.centre
    away = float(np.linalg.norm(along))
    return float((a.motion.velocity - b.motion.velocity) @ along) / max(away, 1e-9)


def _approach(a: DeformableBody, b: DeformableBody) -> bool:
    along = b.motion.centre - a.motion.centre
    return bool((a.motion.velocity - b.motion.velocity) @ along > APPROACH_MIN)
