"""Contacts and energies of a simulation, over stretches of solver and of rigid motion."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..geometry.rotation import Float
from ..physics.solver import ContactTotals
from .body import DeformableBody
from .result import ContactRecord


class ContactLog:
    """Impulses and energies since the start, by body and what touched it.

    Attributes:
        collider_work: of moving colliders on bodies [J].
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
        """A new solver counts from zero."""
        self._solver_totals = {}

    def add_solver_contacts(
        self, contacts: Iterable[ContactTotals], time: float, names: set[str]
    ) -> None:
        """Add what a solver's contacts have grown by since the last call.

        Args:
            contacts: of the present solver, since its start.
            time: [s].
            names: of all bodies; others are colliders.
        """
        for c in contacts:
            key = (c.body, c.other)
            impulse, friction_work, work = self._solver_totals.get(key, (np.zeros(3), 0.0, 0.0))
            self.add(*key, c.impulse - impulse, c.friction_work - friction_work, time)
            if c.other not in names:
                self.collider_work += c.work - work
            self._solver_totals[key] = (np.array(c.impulse), c.friction_work, c.work)

    def add(self, body: str, other: str, impulse: Float, friction_work: float, time: float) -> None:
        """Add an impulse [3] [N s] and the work of friction [J] at a time [s]."""
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

        What holds a sleeping body is recorded only in steps in which others rest beside it; all
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
        """Dissipated by friction so far [J]."""
        return sum(self._friction_work.values())

    def records(self, masses: dict[str, float], gravity: Float) -> tuple[ContactRecord, ...]:
        """All contacts, in the order they began.

        Args:
            masses: of bodies [kg].
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
        """Of the impulse beyond what the weight asks for from the first touch to the last, but for
        sleep in between; only the impulse's part against gravity can be that."""
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
    """Kinetic, elastic and gravity energy of all bodies now [J]."""
    kinetic = elastic = potential = 0.0
    for body in bodies:
        kinetic += body.kinetic_energy
        elastic += body.elastic_energy
        potential -= body.motion.mass * float(gravity @ body.motion.centre)
    return kinetic, elastic, potential
