"""Books of a simulation: contacts and energies over stretches of solver and of rigid motion."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..geometry.rotation import Float
from ..physics.solver import Contact
from .body import DeformableBody
from .result import ContactRecord

TOUCH = 1e-3
"""Impulses that change by less than this, per mass, are over [m/s]."""


class ContactLog:
    """What was given and taken since the start."""

    def __init__(self) -> None:
        self._impulses: dict[tuple[str, str], Float] = {}
        self._heat: dict[tuple[str, str], float] = {}
        self._times: dict[tuple[str, str], list[float]] = {}
        self._seen: dict[tuple[str, str], tuple[Float, float, float]] = {}
        self.collider_work = 0.0

    def start_solver(self) -> None:
        """A new solver counts from zero."""
        self._seen = {}

    def add_contacts(self, contacts: Iterable[Contact], time: float, names: set[str]) -> None:
        """Book what a solver's contacts have grown by since they were last looked at."""
        for c in contacts:
            key = (c.body, c.other)
            impulse, heat, work = self._seen.get(key, (np.zeros(3), 0.0, 0.0))
            self.add(*key, c.impulse - impulse, c.heat - heat, time)
            if c.other not in names:
                self.collider_work += c.work - work
            self._seen[key] = (np.array(c.impulse), c.heat, c.work)

    def add(self, body: str, other: str, impulse: Float, heat: float, time: float) -> None:
        """Book an impulse [N s] and rubbing [J] at a time [s]."""
        key = (body, other)
        if not np.any(impulse):
            return
        self._impulses[key] = self._impulses.get(key, np.zeros(3)) + impulse
        self._heat[key] = self._heat.get(key, 0.0) + heat
        times = self._times.setdefault(key, [time, time])
        times[1] = time

    def totals(self) -> dict[tuple[str, str], Float]:
        """Impulses so far, by (body, other) [N s]."""
        return {key: value.copy() for key, value in self._impulses.items()}

    @property
    def heat(self) -> float:
        """Rubbed away so far [J]."""
        return sum(self._heat.values())

    def records(self, masses: dict[str, float]) -> tuple[ContactRecord, ...]:
        """All contacts, in the order they began."""
        order = sorted(self._impulses, key=lambda key: (self._times[key][0], key))
        return tuple(
            ContactRecord(
                object_id=key[0],
                other=key[1],
                impulse=tuple(self._impulses[key].tolist()),  # type: ignore[arg-type]
                delta_v=float(np.linalg.norm(self._impulses[key])) / masses[key[0]],
                first_s=self._times[key][0],
                last_s=self._times[key][1],
                heat=self._heat[key],
            )
            for key in order
        )


def energies(actors: Iterable[DeformableBody], gravity: Float) -> tuple[float, float, float]:
    """Kinetic, elastic and gravity energy of all bodies now [J]."""
    kinetic = elastic = potential = 0.0
    for actor in actors:
        m = actor.motion
        kinetic += m.kinetic if actor.state is None else actor.state.kinetic
        elastic += actor.stored if actor.state is None else actor.state.elastic
        potential -= m.mass * float(gravity @ m.centre)
    return kinetic, elastic, potential
