"""Objects that a storyboard moves, as drivers of other road users."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, Self

from ...edit import ObjectState
from .driver import AgentPose, Surroundings


@dataclass(frozen=True, eq=False)
class ScriptedEntity:
    """Where a storyboard has an object. It is moved with the others of its storyboard, and not by
    itself.

    Attributes:
        subject, pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    def advance(self, surroundings: Surroundings) -> Self:
        """Itself: its storyboard makes the next one."""
        return self


class Script(Protocol):
    """Moves several objects together. Immutable, as drivers are."""

    @property
    def drivers(self) -> Mapping[str, ScriptedEntity]:
        """Of the objects, by id."""

    def advance(self, surroundings: Surroundings) -> Script:
        """The script one step later."""
