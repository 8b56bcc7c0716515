"""Things that happen in a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

EventType = Literal["collision", "left_log", "horizon", "edited"]


@dataclass(frozen=True)
class Event:
    """Something that happened; the fields of the wire's Event.

    Data of a ``collision``: ``relative_speed`` [m/s]. Of ``left_log``: ``distance`` from the
    recorded path [m]. Of ``edited``: ``revision``.
    """

    type: EventType
    t_us: int
    object_id: str | None = None
    data: Mapping[str, float] = field(default_factory=dict)

    def fields(self) -> dict[str, Any]:
        """As a plain map for the wire."""
        return {
            "type": self.type,
            "t_us": self.t_us,
            "object_id": self.object_id,
            "data": dict(self.data),
        }
