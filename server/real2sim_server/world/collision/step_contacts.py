"""Contacts of a step: events for the planner, records for the scores."""

from __future__ import annotations

from typing import NamedTuple

from ..agents import Agents, Event
from ..scoring.instant import ContactRecord
from .impact import Impact
from .overlaps import BACKGROUND, EgoContacts


class StepContacts(NamedTuple):
    """Of one step.

    Attributes:
        events: collisions that began.
        records: contacts of the ego.
        touching: names of what is in contact now.
        secondary: contacts between objects that began.
    """

    events: tuple[Event, ...] = ()
    records: tuple[ContactRecord, ...] = ()
    touching: frozenset[str] = frozenset()
    secondary: int = 0


def contacts_of_overlaps(found: EgoContacts, t_us: int) -> StepContacts:
    """Where bodies pass through each other."""
    events = (Event("collision", t_us, c.object_id, data=c.event_data()) for c in found.begun)
    return StepContacts(tuple(events), found.records, found.touching)


def contacts_of_impacts(
    impacts: tuple[Impact, ...], t_us: int, *, touching: frozenset[str], before: Agents
) -> StepContacts:
    """Where bodies push each other.

    Args:
        impacts: of the step.
        t_us: at its end [us].
        touching: names of what was in contact one step before.
        before: objects at its start.
    """
    begun = [i for i in impacts if _pair_name(i) not in touching]
    return StepContacts(
        tuple(Event("collision", t_us, i.object_id, i.other_id, i.event_data()) for i in begun),
        _ego_records(impacts, touching=touching, agents=before),
        frozenset(_pair_name(i) for i in impacts),
        sum(i.other_id is not None for i in begun),
    )


def _ego_records(
    impacts: tuple[Impact, ...], *, touching: frozenset[str], agents: Agents
) -> tuple[ContactRecord, ...]:
    """Impacts of the ego for the scores."""
    categories = {o.object_id: o.category for o in agents.objects}
    return tuple(
        ContactRecord(
            object_id=impact.object_id,
            category=categories.get(impact.object_id or "", BACKGROUND),
            side=impact.side,
            relative_speed=impact.relative_speed,
            ego_speed=impact.speeds[0],
            object_speed=impact.speeds[1],
            impulse=impact.impulse,
            begun=(impact.object_id or BACKGROUND) not in touching,
            since=impact.since,
        )
        for impact in impacts
        if impact.other_id is None
    )


def _pair_name(impact: Impact) -> str:
    """Name of a pair in contact; of the ego's, that of the object."""
    name = impact.object_id or BACKGROUND
    return name if impact.other_id is None else f"{name}\n{impact.other_id}"
