"""Events of a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from real2sim_proto.drive import EventType


@dataclass(frozen=True)
class Event:
    """Something that happened; the fields of the wire's Event.

    Data of a ``collision``: when it began (``contact_us``, simulation time, within the step before
    ``t_us``), where (``x``, ``y`` [m], world) and ``relative_speed`` there [m/s]; where momentum is
    exchanged also the rest of :meth:`.collision.impact.Impact.event_data`. ``object_id`` is None
    for the background, ``other_id`` the second object where the ego had no part. Of ``left_log``
    and ``agents_react``: ``distance`` from the recording [m]. Of ``edited``: ``revision``.
    Of ``storyboard``: ``element``, ``element_type`` and ``change``, see
    :class:`.storyboard.progress.ElementChange`.
    Of ``looped``: ``lap``, and ``x``, ``y`` [m], ``turn`` [rad] of the :class:`.seam.Seam`.
    """

    type: EventType
    t_us: int
    object_id: str | None = None
    other_id: str | None = None
    data: Mapping[str, float] = field(default_factory=dict)
    element: str | None = None
    element_type: str | None = None
    change: str | None = None

    def fields(self) -> dict[str, Any]:
        """As a plain map for the wire."""
        fields = {
            "type": self.type,
            "t_us": self.t_us,
            "object_id": self.object_id,
            "other_id": self.other_id,
            "data": dict(self.data),
        }
        if self.element is None:
            return fields
        told = {"element": self.element, "element_type": self.element_type, "change": self.change}
        return fields | told
