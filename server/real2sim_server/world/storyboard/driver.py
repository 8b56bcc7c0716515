"""An object that a storyboard moves, as one of the drivers of other road users."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from ...edit import ObjectState
from ..traffic.driver import AgentPose, Surroundings


@dataclass(frozen=True, eq=False)
class ScriptedEntity:
    """Where the storyboard has an object. It is moved with the others of its storyboard, by
    :meth:`.run.StoryboardRun.advance`, and not by itself.

    Attributes:
        subject, pose, present: see :class:`~..traffic.driver.AgentDriver`.
    """

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    def advance(self, surroundings: Surroundings) -> Self:
        """Itself: its storyboard makes the next one."""
        return self
