"""No controller at all: the vehicle is put where the plan is."""

from __future__ import annotations

import math
from dataclasses import dataclass

from real2sim_proto.episode import EgoSpec

from ..actuators import Command
from ..ego import Motion, placed
from ..reference import MOVING, Reference
from .lqr import Lqr


@dataclass(frozen=True, eq=False)
class Perfect:
    """Perfect tracking, for open-loop comparisons; obeys no limit of any vehicle.

    Attributes:
        reference: what is followed.
        spec: of the vehicle; only its wheelbase is used.
    """

    reference: Reference
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later: the plan's place, or its last one once it is over."""
        t = since + dt_us * 1e-6
        if t >= self.reference.end:
            return placed(motion, self.reference.last_pose, self.spec, dt_us)
        x, y, vx, vy = self.reference.at(t)
        moving = math.hypot(vx, vy) > MOVING
        yaw = math.atan2(vy, vx) if moving else self.reference.heading(t)
        return placed(motion, (x, y, yaw), self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """What an LQR would do; for vehicles that were pushed."""
        return Lqr(self.reference, self.spec).command(motion, t)
