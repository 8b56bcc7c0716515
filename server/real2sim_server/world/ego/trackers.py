"""Controllers that make the vehicle follow a planned trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from real2sim_proto.episode import EgoSpec

from ..driving import KINDS, LQR, MOVING, Command
from ..seam import Seam
from .motion import Motion, advance_motion, commanded, teleported
from .reference import ReferenceTrajectory


@dataclass(frozen=True, eq=False)
class ControlledTracker:
    """A controller in the vehicle, bound by the vehicle's limits; knows nothing of the past, so
    that a copied world goes on alike.

    Attributes:
        kind: number of the tracker, see :mod:`.driving.trackers`.
        reference: what is followed.
        spec: of the vehicle.
    """

    kind: int
    reference: ReferenceTrajectory
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later.

        Args:
            motion: now.
            since: time since the reference began [s].
            dt_us: how far to go [us].
        """
        return advance_motion(
            motion, self.reference.control_law(self.kind), self.spec, dt_us, since=since
        )

    def command(self, motion: Motion, t: float) -> Command:
        """What to do in a motion, ``t`` seconds after the reference began."""
        return commanded(motion, self.reference.control_law(self.kind), self.spec, since=t)

    def put_back(self, seam: Seam) -> Self:
        """The tracker of a vehicle that was put back over the seam."""
        return replace(self, reference=self.reference.put_back(seam))


@dataclass(frozen=True, eq=False)
class PerfectTracker:
    """No controller at all: the vehicle is put where the plan is. For open-loop comparisons; obeys
    no limit of any vehicle.

    Attributes:
        reference: what is followed.
        spec: of the vehicle.
    """

    reference: ReferenceTrajectory
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later: the plan's place, or its last one once it is over."""
        t = since + dt_us * 1e-6
        if t >= self.reference.end:
            return teleported(motion, self.reference.last_pose, self.spec, dt_us)
        x, y, vx, vy, yaw = self.reference.at(t)
        if math.hypot(vx, vy) > MOVING:
            yaw = math.atan2(vy, vx)
        return teleported(motion, (x, y, yaw), self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """What an LQR would do; for vehicles that were pushed."""
        return commanded(motion, self.reference.control_law(LQR), self.spec, since=t)

    def put_back(self, seam: Seam) -> Self:
        """The tracker of a vehicle that was put back over the seam."""
        return replace(self, reference=self.reference.put_back(seam))


def make_tracker(
    reference: ReferenceTrajectory, spec: EgoSpec
) -> ControlledTracker | PerfectTracker:
    """The tracker that the spec names."""
    if spec.tracker == "perfect":
        return PerfectTracker(reference, spec)
    return ControlledTracker(KINDS[spec.tracker], reference, spec)
