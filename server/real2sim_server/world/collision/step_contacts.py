"""What the contacts of a step leave behind: events for the planner, notes for the scores."""

from __future__ import annotations

from typing import NamedTuple

from ..agents import Agents
from ..events import Event
from ..scoring import ContactNote
from .meeting import BACKGROUND, Met, notes_of
from .model import Impact


class StepContacts(NamedTuple):
    """Of one step.

    Attributes:
        events: collisions that began.
        notes: contacts of the ego.
        touching: names of what is in contact now.
        secondary: contacts between objects that began.
    """

    events: tuple[Event, ...] = ()
    notes: tuple[ContactNote, ...] = ()
    touching: frozenset[str] = frozenset()
    secondary: int = 0


def after_overlaps(found: Met, t_us: int) -> StepContacts:
    """Where bodies pass through each other."""
    events = (
        Event("collision", t_us, c.object_id, data={"relative_speed": c.relative_speed})
        for c in found.begun
    )
    return StepContacts(tuple(events), found.notes, found.touching)


def after_impacts(
    impacts: tuple[Impact, ...], t_us: int, *, touched: frozenset[str], before: Agents
) -> StepContacts:
    """Where bodies push each other.

    Args:
        impacts: of the step.
        t_us: at its end [us].
        touched: names of what was in contact one step before.
        before: objects at its start.
    """
    fresh = [i for i in impacts if _pair(i) not in touched]
    return StepContacts(
        tuple(Event("collision", t_us, i.object_id, i.other_id, i.figures()) for i in fresh),
        notes_of(impacts, touched=touched, agents=before),
        frozenset(_pair(i) for i in impacts),
        sum(i.other_id is not None for i in fresh),
    )


def _pair(impact: Impact) -> str:
    """Name of a pair in contact; of the ego's, that of the object."""
    name = impact.object_id or BACKGROUND
    return name if impact.other_id is None else f"{name}\n{impact.other_id}"
