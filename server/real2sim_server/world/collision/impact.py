"""Impacts: what two bodies exchanged in one step of the clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ..scoring.instant import Side
from .rigid_body import BodyProperties, BodyState

MUTUAL_STIFFNESS = 405e3
"""Of two cars in series, where impacts are sudden: 405 +- 139 kN/m (Bonugli et al. 2017) [N/m]."""


class ImpactParticipant(NamedTuple):
    """A body as it was when an impact began; ``low``, ``high``: of its box [m]."""

    properties: BodyProperties
    body: BodyState
    low: float
    high: float


@dataclass(frozen=True)
class Impact:
    """Impulse, energy and change of velocity of two bodies in one step of the clock.

    Attributes:
        object_id: of the object; None for the background.
        other_id: second object, where the ego had no part in it; else None.
        t_us: of the step in which it was [us].
        point: middle of the contact when it began, world [m].
        normal: out of the object into the other body.
        approach_speed: along the normal when it began [m/s].
        relative_speed: of the two centres [m/s].
        impulse: on the ego, or on ``other_id``, summed over the step [N s].
        delta_v, object_delta_v: length of the change of velocity of the ego (or ``other_id``) and
            of the object [m/s].
        energy: kinetic energy lost [J].
        whole: length of the impulse of the whole impact [N s], and ``delta_v``,
            ``object_delta_v`` and ``energy`` those of it, as the mechanics of a sudden impulse
            have them; None where the impact was sudden, or had begun before.
        stiffness: of what was crushed [N/m].
        breadth: how far the background reaches to both sides of the point, across the normal [m];
            None where it had no part.
        side: of the ego on which the contact began.
        speeds: of the first body and of the object when it began [m/s].
        began_us: when it began in this step [us].
        since: the same as a fraction of the step.
        participants: the ego (or ``other_id``) and the object when it began; None for the
            background.
    """

    object_id: str | None
    other_id: str | None
    t_us: int
    point: tuple[float, float]
    normal: tuple[float, float]
    approach_speed: float
    relative_speed: float
    impulse: tuple[float, float]
    delta_v: float
    object_delta_v: float
    energy: float
    side: Side = "lateral"
    speeds: tuple[float, float] = (0.0, 0.0)
    began_us: int = 0
    since: float = 1.0
    participants: tuple[ImpactParticipant, ImpactParticipant | None] | None = None
    whole: float | None = None
    stiffness: float = MUTUAL_STIFFNESS
    breadth: tuple[float, float] | None = None

    @property
    def crush(self) -> float:
        """Depth of both deformations together [m], if all energy lost went into a linear spring."""
        return math.sqrt(2 * max(self.energy, 0.0) / self.stiffness)

    def event_data(self) -> dict[str, float]:
        """Data of its event on the wire."""
        return {
            "relative_speed": self.relative_speed,
            "approach_speed": self.approach_speed,
            "impulse": math.hypot(*self.impulse) if self.whole is None else self.whole,
            "delta_v": self.delta_v,
            "object_delta_v": self.object_delta_v,
            "energy": self.energy,
            "crush": self.crush,
            "contact_us": float(self.began_us),
            "x": self.point[0],
            "y": self.point[1],
        }
