"""Bodies and colliders in motion: who is rigid, who deforms, who rests."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..physics.colliders import Collider
from ..physics.solver import Solver, SolverOptions
from .body import DEFORMING, RIGID, SLEEPING, DeformableBody
from .contacts import ContactLog
from .spawn import STANDS_WITHIN

STEP = 0.005
"""Longest time between two looks at what is near whom [s]."""
RIGID_STEP = 0.0025
NEAR_CELLS = 3.0
"""Bodies loosen when something comes this near."""
CALM = 0.06
"""A body at unrest below this [m/s], or below CALM_SHARE of its speed, may become rigid again."""
CALM_SHARE = 0.03
CALM_TIME = 0.05
STILL_TIME = 0.08
REST_SPEED = 0.06
"""And when it hardly moves at all, it is laid to rest [m/s]."""


class HybridSimulator:
    """Bodies and colliders in motion.

    Args:
        actors: bodies.
        colliders: that do not yield.
        road: names of those that carry tyres.
        gravity: [3] [m/s^2].
        backend: of the solver.
        brake_after_hit: share of the wheels' grip that is braked once a vehicle was hit.
    """

    def __init__(
        self,
        actors: Sequence[DeformableBody],
        colliders: Sequence[Collider],
        *,
        road: Sequence[str],
        gravity: ArrayLike,
        backend: str,
        brake_after_hit: float,
    ) -> None:
        self.actors = list(actors)
        self.colliders = list(colliders)
        self.gravity = np.array(gravity, dtype=np.float64)
        self.brake_after_hit = brake_after_hit
        self._road = frozenset(road)
        self._backend = backend
        self.ledger = ContactLog()
        self.time = 0.0
        self.substeps = self.rollbacks = 0
        self._names = {a.name for a in actors}
        self._solver: Solver | None = None
        self._inside: list[str] = []
        for actor in self.actors:
            if self._stands(actor):
                actor.lay_down()

    @property
    def road(self) -> list[Collider]:
        """Colliders that carry tyres."""
        return [c for c in self.colliders if c.name in self._road]

    def _stands(self, actor: DeformableBody) -> bool:
        """Whether a body that does not move is held by something, or by nothing drawn down."""
        m = actor.motion
        if np.any(m.velocity) or np.any(m.angular_velocity):
            return False
        return not np.any(self.gravity) or actor.gap_to_colliders(self.colliders)[0] < STANDS_WITHIN

    def advance(self, duration: float) -> None:
        """Go on by ``duration`` [s], at most STEP."""
        self._loosen(duration)
        deforming = [a for a in self.actors if a.mode == DEFORMING]
        if deforming:
            self._deform(deforming, duration)
        for actor in self.actors:
            if actor.mode == RIGID:
                self._move(actor, duration)
        if self._solver is None:
            self.colliders = [c.after(duration) for c in self.colliders]
        self.time += duration
        self._settle(deforming, duration)

    def _loosen(self, duration: float) -> None:
        """Rigid bodies that something comes near to become matter."""
        changed = True
        while changed:
            changed = False
            for actor in self.actors:
                if actor.mode != DEFORMING and self._is_near_anything(actor, duration):
                    actor.loosen()
                    self._solver = None
                    changed = True

    def _is_near_anything(self, actor: DeformableBody, duration: float) -> bool:
        near = NEAR_CELLS * actor.cell
        for other in self.actors:
            if other is actor or (actor.mode == SLEEPING and other.mode == SLEEPING):
                continue
            if not self._approach(actor, other):
                continue
            closing = float(np.linalg.norm(actor.motion.velocity - other.motion.velocity))
            if actor.gap_to(other) < near + closing * duration:
                return True
        if actor.mode == SLEEPING:
            return False
        gap, approach = actor.gap_to_colliders(self._walls(actor))
        if approach > 0 and gap < near + approach * duration:
            return True
        if actor.tyres is None:
            return False
        # On its wheels a body is near the road all the time; it touches when springs are through.
        gap, approach = actor.gap_to_colliders(self.road)
        return gap < 0.4 * actor.cell + max(approach, 0) * duration

    def _walls(self, actor: DeformableBody) -> list[Collider]:
        return (
            self.colliders
            if actor.tyres is None
            else [c for c in self.colliders if c.name not in self._road]
        )

    @staticmethod
    def _approach(a: DeformableBody, b: DeformableBody) -> bool:
        along = b.motion.centre - a.motion.centre
        return bool((a.motion.velocity - b.motion.velocity) @ along > 1e-3)

    def _move(self, actor: DeformableBody, duration: float) -> None:
        """Rigid: fall, roll, slide."""
        steps = math.ceil(duration / RIGID_STEP - 1e-6)
        dt = duration / steps
        for _ in range(steps):
            m = actor.motion.falling(dt, self.gravity)
            if actor.tyres is not None:
                m, impulse, heat = actor.tyres.act(m, actor.T_world_object, self.road, dt)
                self.ledger.add(actor.name, "tyres", impulse, heat, self.time)
            actor.motion = m.moved(dt)
        m = actor.motion
        slow = np.linalg.norm(m.velocity) + np.linalg.norm(m.angular_velocity) < REST_SPEED / 2
        actor.calm_for = actor.calm_for + duration if slow and actor.tyres is not None else 0.0
        if actor.calm_for > 0.2:
            actor.lay_down()

    def _deform(self, deforming: list[DeformableBody], duration: float) -> None:
        names = [a.name for a in deforming]
        if self._solver is None or self._inside != names:
            self._start_solver(deforming)
        assert self._solver is not None
        report = self._solver.step(duration)
        self.substeps += report.substeps
        self.rollbacks += report.rollbacks
        self.colliders = list(self._solver.colliders)
        self.ledger.add_contacts(self._solver.contacts, self.time, self._names)
        for actor, state in zip(deforming, self._solver.states(), strict=True):
            actor.take(state)
            actor.deforming_for += duration
            if actor.tyres is not None:
                self._roll_on(actor, duration)

    def _start_solver(self, deforming: list[DeformableBody]) -> None:
        self._solver = Solver(
            [a.body() for a in deforming],
            self.colliders,
            SolverOptions(dx=deforming[0].cell, gravity=tuple(self.gravity), backend=self._backend),
        )
        self._inside = [a.name for a in deforming]
        self.ledger.start_solver()

    def _roll_on(self, actor: DeformableBody, duration: float) -> None:
        """The road acts on deforming vehicles' wheels too, as on a rigid body."""
        assert actor.tyres is not None
        moved, impulse, heat = actor.tyres.act(
            actor.motion, actor.T_world_object, self.road, duration
        )
        if not np.any(impulse):
            return
        self.ledger.add(actor.name, "tyres", impulse, heat, self.time)
        actor.kick(moved)
        self._solver = None

    def _settle(self, deforming: list[DeformableBody], duration: float) -> None:
        """Matter that has calmed down becomes rigid, or is laid to rest."""
        for actor in deforming:
            self._note_hit(actor)
            speed = float(np.linalg.norm(actor.motion.velocity))
            turning = float(np.linalg.norm(actor.motion.angular_velocity))
            calm = actor.unrest() < max(CALM, CALM_SHARE * speed)
            actor.calm_for = actor.calm_for + duration if calm else 0.0
            # At the top of a bounce everything is slow for a moment, too.
            still = speed + turning < REST_SPEED
            actor.still_for = actor.still_for + duration if still else 0.0
            if actor.calm_for < CALM_TIME or actor.deforming_for < 2 * CALM_TIME:
                continue
            if actor.still_for > STILL_TIME:
                actor.stiffen(SLEEPING)
            elif self._is_free(actor):
                actor.stiffen(RIGID)
            else:
                continue
            self._solver = None

    def _is_free(self, actor: DeformableBody) -> bool:
        for other in self.actors:
            if other is not actor and self._approach(actor, other):
                closing = float(np.linalg.norm(actor.motion.velocity - other.motion.velocity))
                if actor.gap_to(other) < NEAR_CELLS * actor.cell + closing * STEP:
                    return False
        gap, approach = actor.gap_to_colliders(self._walls(actor))
        if gap < NEAR_CELLS * actor.cell and (approach > 0 or actor.tyres is None):
            return False
        if actor.tyres is None:
            return True
        gap, approach = actor.gap_to_colliders(self.road)
        return gap > 0.4 * actor.cell + max(approach, 0) * STEP

    def _note_hit(self, actor: DeformableBody) -> None:
        """Once a vehicle was hit, its wheels lock as far as options say."""
        if actor.hit or actor.tyres is None:
            return
        for (body, other), impulse in self.ledger.totals().items():
            hard = float(np.linalg.norm(impulse)) > 0.3 * actor.motion.mass
            if body == actor.name and other != "tyres" and other not in self._road and hard:
                actor.hit = True
                actor.tyres = actor.tyres.braked(self.brake_after_hit)
                return
