"""Bodies and colliders in motion: the simulator decides who deforms and who is rigid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..physics.colliders import Collider
from ..physics.solver import Solver, SolverOptions
from .body import SLEEP_SPEED, BodyMode, DeformableBody
from .contacts import ContactLog
from .support import supports_of
from .tyres import TyreReaction

STEP = 0.005
"""Longest time between two checks of what is near what [s]."""
NEAR_CELLS = 3.0
"""Bodies are activated when something comes this near."""
ROAD_CELLS = 0.4
"""On its wheels a body is near the road all the time; contact begins when springs are through."""
APPROACH_MIN = 1e-3
"""Bodies approach each other when speed times distance is beyond this [m^2/s]."""
HIT_DELTA_V = 0.3
"""A vehicle was hit when something has changed its velocity by more [m/s]."""
TYRES = "tyres"
"""Name under which the contact log keeps what the road does through tyres."""


class HybridSimulator:
    """Bodies and colliders in motion.

    Each body is rigid until something comes near, deforms in a solver while it touches, and is
    rigid again or asleep once it has settled. Bodies keep track of that themselves; the simulator
    gives the orders.

    Args:
        bodies: that take part.
        colliders: that do not yield.
        road: names of those that carry tyres.
        gravity: [3] [m/s^2].
        backend: of the solver.
        brake_after_hit: fraction of the wheels' grip that is braked once a vehicle was hit.

    Attributes:
        bodies, colliders: as they are now.
        contact_log: impulses and energies since the start.
        time: since the start [s].
        substeps, rollbacks: of all solvers so far.
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
    ) -> None:
        self.bodies = list(bodies)
        self.colliders = list(colliders)
        self.gravity = np.array(gravity, dtype=np.float64)
        self.contact_log = ContactLog()
        self.time = 0.0
        self.substeps = self.rollbacks = 0
        self._road = frozenset(road)
        self._backend = backend
        self._brake_after_hit = brake_after_hit
        self._names = {b.name for b in bodies}
        self._solver: Solver | None = None
        self._solved: list[str] = []
        for body in self.bodies:
            if not (np.any(body.motion.velocity) or np.any(body.motion.angular_velocity)):
                self._put_to_sleep(body)

    @property
    def road(self) -> list[Collider]:
        """Colliders that carry tyres."""
        return [c for c in self.colliders if c.name in self._road]

    def advance(self, duration: float) -> None:
        """Go on by ``duration`` [s], at most STEP."""
        self._wake()
        self._activate(duration)
        deforming = [b for b in self.bodies if b.mode == BodyMode.DEFORMING]
        if deforming:
            self._solve(deforming, duration)
        for body in self.bodies:
            if body.mode == BodyMode.RIGID:
                reaction = body.advance_rigid(duration, self.gravity, self.road)
                if reaction is not None:
                    self._log_tyres(body, [reaction])
                if body.has_parked:
                    self._put_to_sleep(body)
        if self._solver is None:
            self.colliders = [c.after(duration) for c in self.colliders]
        self.time += duration
        for body in deforming:
            self._brake_if_hit(body)
            self._settle(body, duration)

    def _activate(self, duration: float) -> None:
        """Let all bodies deform that something comes near to, and those that these come near to."""
        changed = True
        while changed:
            changed = False
            for body in self.bodies:
                if body.mode != BodyMode.DEFORMING and self._is_near_anything(body, duration):
                    body.activate()
                    self._solver = None
                    changed = True

    def _solve(self, deforming: list[DeformableBody], duration: float) -> None:
        names = [b.name for b in deforming]
        if self._solver is None or self._solved != names:
            self._start_solver(deforming)
        assert self._solver is not None
        report = self._solver.step(duration)
        self.substeps += report.substeps
        self.rollbacks += report.rollbacks
        self.colliders = list(self._solver.colliders)
        self.contact_log.add_solver_contacts(self._solver.contacts, self.time, self._names)
        for body, state in zip(deforming, self._solver.states(), strict=True):
            body.update_from_solver(state)
            reaction = body.apply_road(self.road, duration)
            if reaction is not None:
                self._log_tyres(body, [reaction])
                self._solver = None

    def _start_solver(self, deforming: list[DeformableBody]) -> None:
        self._solver = Solver(
            [b.solver_body() for b in deforming],
            self.colliders,
            SolverOptions(dx=deforming[0].cell, gravity=tuple(self.gravity), backend=self._backend),
        )
        self._solved = [b.name for b in deforming]
        self.contact_log.start_solver()

    def _log_tyres(self, body: DeformableBody, reactions: Iterable[TyreReaction]) -> None:
        for r in reactions:
            self.contact_log.add(body.name, TYRES, r.impulse, r.friction_work, self.time)

    def _settle(self, body: DeformableBody, duration: float) -> None:
        """A body that has settled becomes rigid, or falls asleep."""
        body.update_timers(duration)
        if body.may_sleep and self._put_to_sleep(body):
            pass
        elif body.may_rigidify and self._is_free(body):
            body.rigidify()
        else:
            return
        self._solver = None

    def _brake_if_hit(self, body: DeformableBody) -> None:
        """Once a vehicle was hit, its wheels lock as far as options say."""
        if body.hit or body.tyres is None:
            return
        for (name, other), impulse in self.contact_log.totals().items():
            hard = float(np.linalg.norm(impulse)) > HIT_DELTA_V * body.motion.mass
            if name == body.name and other != TYRES and other not in self._road and hard:
                body.brake_after_hit(self._brake_after_hit)
                return

    def _put_to_sleep(self, body: DeformableBody) -> bool:
        """Let a body sleep that is held by what itself does not move; whether it is."""
        others = [b for b in self.bodies if b is not body and not _moves(b)]
        supports = supports_of(body, self.colliders, self.road, others, self.gravity)
        if supports is None or {c.name for c in self.colliders if c.moving}.intersection(supports):
            return False
        body.put_to_sleep(supports)
        return True

    def _wake(self) -> None:
        """Wake those whose supports have begun to move, and those that rest on these."""
        moved = {c.name for c in self.colliders if c.moving}
        moved |= {b.name for b in self.bodies if _moves(b)}
        for body in self.bodies:
            if body.mode == BodyMode.SLEEPING and not moved.isdisjoint(body.supports):
                body.wake()

    def _is_near_anything(self, body: DeformableBody, duration: float) -> bool:
        """Whether something will be near within ``duration`` [s]."""
        asleep = body.mode == BodyMode.SLEEPING
        others = [
            b for b in self.bodies if not (asleep and b.mode == BodyMode.SLEEPING) and b is not body
        ]
        if self._is_near_bodies(body, others, duration):
            return True
        walls = self._walls(body)
        if asleep:
            walls = [c for c in walls if c.moving]
        if body.meets(walls, within=NEAR_CELLS * body.cell, ahead=duration):
            return True
        if asleep or body.tyres is None:
            return False
        gap, approach = body.gap_to_colliders(self.road)
        return gap < ROAD_CELLS * body.cell + max(approach, 0) * duration

    def _is_free(self, body: DeformableBody) -> bool:
        """Whether a deforming body may go its way as a rigid one."""
        if self._is_near_bodies(body, [b for b in self.bodies if b is not body], STEP):
            return False
        gap, approach = body.gap_to_colliders(self._walls(body))
        if gap < NEAR_CELLS * body.cell and (approach > 0 or body.tyres is None):
            return False
        if body.tyres is None:
            return True
        gap, approach = body.gap_to_colliders(self.road)
        return gap > ROAD_CELLS * body.cell + max(approach, 0) * STEP

    def _is_near_bodies(
        self, body: DeformableBody, others: Iterable[DeformableBody], duration: float
    ) -> bool:
        for other in others:
            if not _approach(body, other):
                continue
            closing = float(np.linalg.norm(body.motion.velocity - other.motion.velocity))
            if body.gap_to(other) < NEAR_CELLS * body.cell + closing * duration:
                return True
        return False

    def _walls(self, body: DeformableBody) -> list[Collider]:
        """Colliders that it touches with its own surface, not by its tyres."""
        if body.tyres is None:
            return self.colliders
        return [c for c in self.colliders if c.name not in self._road]


def _moves(body: DeformableBody) -> bool:
    """Whether a body moves or turns faster than what sleeps may."""
    m = body.motion
    speed = float(np.linalg.norm(m.velocity)) + float(np.linalg.norm(m.angular_velocity))
    return body.mode != BodyMode.SLEEPING and speed > SLEEP_SPEED


def _approach(a: DeformableBody, b: DeformableBody) -> bool:
    along = b.motion.centre - a.motion.centre
    return bool((a.motion.velocity - b.motion.velocity) @ along > APPROACH_MIN)
