"""Controllers that make the vehicle follow a planned trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from real2sim_proto.episode import EgoSpec

from ..._records import made_quickly
from ..driving import KINDS, LQR, MOVING, Command
from ..path import LoopTransform
from .gear import advance_in_gear, backwards_spec, can_reverse, command_in_gear, mirrored
from .legs import Leg, legs_of
from .motion import Motion, advance_motion, commanded, teleported
from .reference import PlannedTrajectory, ReferenceTrajectory, SinglePose


@made_quickly
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

    def put_back(self, seam: LoopTransform) -> Self:
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
            back = vx * math.cos(yaw) + vy * math.sin(yaw) < 0 and can_reverse(self.spec)
            yaw = math.atan2(-vy, -vx) if back else math.atan2(vy, vx)
        return teleported(motion, (x, y, yaw), self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """What an LQR would do; for vehicles that were pushed."""
        return commanded(motion, self.reference.control_law(LQR), self.spec, since=t)

    def put_back(self, seam: LoopTransform) -> Self:
        """The tracker of a vehicle that was put back over the seam."""
        return replace(self, reference=self.reference.put_back(seam))


@dataclass(frozen=True, eq=False)
class GearedLeg:
    """A leg of a plan as it is followed.

    Attributes:
        backwards: whether in reverse gear; the reference is then the mirror image's.
        begin_us, end_us: from the beginning of the plan [us].
        reference: what is followed.
    """

    backwards: bool
    begin_us: int
    end_us: int
    reference: ReferenceTrajectory


@dataclass(frozen=True, eq=False)
class GearedTracker:
    """A controller that changes gear where its plan turns back.

    Attributes:
        kind: number of the tracker, see :mod:`.driving.trackers`.
        legs: of the plan, one after the other.
        spec: of the vehicle.
    """

    kind: int
    legs: tuple[GearedLeg, ...]
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later, ``since`` seconds after the plan began."""
        at_us = round(since * 1e6)
        end_us = at_us + dt_us
        while at_us < end_us:
            leg = self._leg_at(at_us)
            until_us = end_us if leg is self.legs[-1] else min(end_us, leg.end_us)
            motion = advance_in_gear(
                motion,
                leg.reference.control_law(self.kind),
                self.spec,
                until_us - at_us,
                since=(at_us - leg.begin_us) * 1e-6,
                backwards=leg.backwards,
            )
            at_us = until_us
        return motion

    def command(self, motion: Motion, t: float) -> Command:
        """What to do in a motion, ``t`` seconds after the plan began."""
        leg = self._leg_at(round(t * 1e6))
        law = leg.reference.control_law(self.kind)
        since = t - leg.begin_us * 1e-6
        return command_in_gear(motion, law, self.spec, since=since, backwards=leg.backwards)

    def put_back(self, seam: LoopTransform) -> Self:
        """The tracker of a vehicle that was put back over the seam."""
        legs = [replace(leg, reference=leg.reference.put_back(seam)) for leg in self.legs]
        return replace(self, legs=tuple(legs))

    def _leg_at(self, at_us: int) -> GearedLeg:
        return next((leg for leg in self.legs if at_us < leg.end_us), self.legs[-1])


def tracker_of(
    motion: Motion,
    start_us: int,
    trajectory: PlannedTrajectory,
    spec: EgoSpec,
    before: SinglePose | None = None,
) -> ControlledTracker | GearedTracker | PerfectTracker:
    """The tracker that the spec names, of a vehicle that is in ``motion`` at ``start_us``;
    ``before``: what a trajectory of a single pose goes on from."""
    if spec.tracker != "perfect" and can_reverse(spec):
        legs = legs_of(trajectory, motion, before)
        if len(legs) > 1 or legs[0].backwards or motion.reversing or motion.speed < 0:
            geared = [_geared(leg, motion, start_us, spec, before) for leg in legs]
            return GearedTracker(KINDS[spec.tracker], tuple(geared), spec)
    ahead = ReferenceTrajectory(
        motion, start_us=start_us, trajectory=trajectory, spec=spec, before=before
    )
    return make_tracker(ahead, spec)


def _geared(
    leg: Leg, motion: Motion, start_us: int, spec: EgoSpec, before: SinglePose | None
) -> GearedLeg:
    begin_us = start_us if leg.begin_us is None else leg.begin_us
    trajectory = leg.trajectory
    if leg.cusp is not None:
        x, y, yaw = leg.cusp
        motion = Motion(x, y, yaw)
    if leg.backwards:
        motion, spec = mirrored(motion), backwards_spec(spec)
        turned = trajectory.poses + np.array([0.0, 0.0, math.pi])
        trajectory = PlannedTrajectory(trajectory.times_us, turned)
        before = before and before._replace(yaw=before.yaw + math.pi)
    reference = ReferenceTrajectory(
        motion, start_us=begin_us, trajectory=trajectory, spec=spec, before=before
    )
    end_us = int(trajectory.times_us[-1]) - start_us
    return GearedLeg(leg.backwards, begin_us - start_us, end_us, reference)


def make_tracker(
    reference: ReferenceTrajectory, spec: EgoSpec
) -> ControlledTracker | PerfectTracker:
    """The tracker that the spec names, of a plan that leads forwards."""
    if spec.tracker == "perfect":
        return PerfectTracker(reference, spec)
    return ControlledTracker(KINDS[spec.tracker], reference, spec)
