"""Controllers of the ego: they follow the plan in effect, or the log before any plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, Self, assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import EgoSpec, ResetSpec
from real2sim_proto.plans import Control, Gear, PoseCommand, TrajectoryPlan

from ..._records import made_quickly
from ...edit.tracks import sample
from ...scene import Trajectory
from ..common import WorldError, copy_with
from ..driving import KINDS, LQR, MOVING, Command
from ..path import LoopTransform
from .motion import Motion, advance_motion, commanded, constant_law, teleported
from .plan import (
    Leg,
    PlannedTrajectory,
    Pose,
    ReferenceTrajectory,
    SinglePose,
    advance_in_gear,
    backwards_spec,
    can_reverse,
    command_in_gear,
    legs_of,
    mirrored,
)

# --- Trackers ------------------------------------------------------------------------------------


@made_quickly
@dataclass(frozen=True, eq=False)
class ControlledTracker:
    """A controller in the vehicle, bound by the vehicle's limits; knows nothing of the past, so
    that a copied world goes on alike.

    Attributes:
        kind: number of the tracker, see :mod:`..driving.trackers`.
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
        kind: number of the tracker, see :mod:`..driving.trackers`.
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


Plan = TrajectoryPlan | Control | PoseCommand
WorldPlan = PlannedTrajectory | Control | PoseCommand

LOG_SPACING_US = 100_000
"""Where there is no plan, the log is followed by poses this far apart at most [us]."""

EMERGENCY_BRAKING = 6.0
"""Deceleration of the fallback ``brake``, where the vehicle can [m/s^2]."""


class Controller(Protocol):
    """Moves the ego until another one takes over."""

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later; ``since`` seconds after the controller began."""

    def command(self, motion: Motion, t: float) -> Command:
        """What it would do in a motion, ``t`` seconds after it began."""

    def put_back(self, seam: LoopTransform) -> Self:
        """The controller of an ego that was put back over the seam."""


@made_quickly
@dataclass(frozen=True)
class ConstantCommand:
    """The same command all the time.

    Attributes:
        constant: acceleration in the direction of the gear, and road-wheel angle.
        spec: of the vehicle.
        gear: in which it was given; None: the one that is engaged.
    """

    constant: Command
    spec: EgoSpec
    gear: Gear | None = "drive"

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later."""
        backwards, law = self._backwards(motion), constant_law(self.constant)
        forwards = not (backwards or motion.reversing or motion.speed < 0)
        if forwards or not can_reverse(self.spec):
            return advance_motion(motion, law, self.spec, dt_us)
        if backwards:
            law = constant_law(Command(self.constant.acceleration, -self.constant.steering))
        return advance_in_gear(motion, law, self.spec, dt_us, since=0.0, backwards=backwards)

    def command(self, motion: Motion, t: float) -> Command:
        """That command, along the heading."""
        acceleration, steering = self.constant
        return Command(-acceleration if self._backwards(motion) else acceleration, steering)

    def _backwards(self, motion: Motion) -> bool:
        return self.gear == "reverse" if self.gear is not None else motion.reversing

    def put_back(self, seam: LoopTransform) -> Self:
        """Itself: a command has no place."""
        return self


@dataclass(frozen=True)
class Teleport:
    """The vehicle is put somewhere and stays there."""

    pose: Pose
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle at its place, with the velocity that brought it there."""
        return teleported(motion, self.pose, self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """Brakes: a teleported vehicle has no controller."""
        return Command(-EMERGENCY_BRAKING, motion.steering)

    def put_back(self, seam: LoopTransform) -> Self:
        """The pose beyond the seam."""
        x, y, yaw = seam.poses(np.array([self.pose]))[0].tolist()
        return replace(self, pose=(x, y, yaw))


@made_quickly
@dataclass(frozen=True)
class PendingPlan:
    """A plan that has not taken effect yet.

    Attributes:
        from_us: when it does [us].
        plan: in the world.
    """

    from_us: int
    plan: WorldPlan

    @property
    def trajectory(self) -> PlannedTrajectory | None:
        """The plan where it is a trajectory."""
        return self.plan if isinstance(self.plan, PlannedTrajectory) else None

    def put_back(self, seam: LoopTransform) -> PendingPlan:
        """The plan of an ego that was put back over the seam."""
        if isinstance(self.plan, PlannedTrajectory):
            return replace(self, plan=replace(self.plan, poses=seam.poses(self.plan.poses)))
        if isinstance(self.plan, PoseCommand):
            (x, y), yaw = seam.place(self.plan.x, self.plan.y), self.plan.yaw + seam.turn
            return replace(self, plan=self.plan.model_copy(update={"x": x, "y": y, "yaw": yaw}))
        return self


@made_quickly
@dataclass(frozen=True, eq=False)
class EgoController:
    """The active controller of the ego and the pending plans. Immutable.

    Attributes:
        spec: of the episode.
        ego: as it was recorded; followed while there is no plan.
        controller: active; None before the first plan.
        since_us: when it took over [us].
        pending: plans that have not taken effect yet, in the order in which they will.
        single: the pose of the active plan, where it is one of a single pose.
    """

    spec: ResetSpec
    ego: Trajectory
    controller: Controller | None = None
    since_us: int = 0
    pending: tuple[PendingPlan, ...] = ()
    single: SinglePose | None = None

    def with_plan(self, plan: Plan, motion: Motion, t_us: int, from_us: int) -> EgoController:
        """With one more plan.

        Args:
            plan: of the planner.
            motion: that it answers.
            t_us: of that observation [us].
            from_us: when it takes effect [us].

        Raises:
            WorldError: INVALID_ACTION for another kind than the reset named, or times that are
                over.
        """
        if plan.kind != self.spec.action:
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"a plan of kind {plan.kind!r} in an episode that was reset for "
                f"{self.spec.action!r}",
                hint=f"send {self.spec.action!r} plans, or reset with action {plan.kind!r}; in a "
                "planner class for `real2sim drive`, write "
                f"`needs = Needs(action={plan.kind!r})` (from real2sim.planners)",
            )
        if isinstance(plan, Control) and plan.gear == "reverse" and not can_reverse(self.spec.ego):
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                "gear 'reverse' for a vehicle without one: ego.max_reverse_speed is 0, or ego."
                f"dynamics {self.spec.ego.dynamics!r} cannot go backwards",
                hint="reset with ego.max_reverse_speed above 0, or send gear 'drive'",
            )
        if isinstance(plan, TrajectoryPlan) and plan.times_us[0] <= t_us:
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"the plan begins at {plan.times_us[0]} us; it is {t_us} us already",
                hint="times_us are absolute simulation times after t_us of the observation",
            )
        kept = tuple(p for p in self.pending if p.from_us < from_us)
        pending = (*kept, PendingPlan(from_us, plan_in_world(plan, motion)))
        return copy_with(self, pending=pending)

    def advance(self, motion: Motion, t_us: int, us: int) -> tuple[EgoController, Motion]:
        """Controller and vehicle ``us`` later than ``t_us``."""
        current, end_us = self, t_us + us
        while t_us < end_us:
            current = current.activated(motion, t_us)
            until = min([end_us, *(p.from_us for p in current.pending)])
            since = (t_us - current.since_us) * 1e-6
            assert current.controller is not None
            motion = current.controller.advance(motion, since, until - t_us)
            t_us = until
        return current, motion

    def put_back(self, seam: LoopTransform) -> EgoController:
        """The controller and its plans of an ego that was put back over the seam."""
        controller = self.controller.put_back(seam) if self.controller is not None else None
        pending = tuple(plan.put_back(seam) for plan in self.pending)
        single = self.single and self.single.put_back(seam)
        return replace(self, controller=controller, pending=pending, single=single)

    def command(self, motion: Motion, t_us: int) -> Command:
        """Of the active controller in a motion at ``t_us``."""
        assert self.controller is not None
        return self.controller.command(motion, (t_us - self.since_us) * 1e-6)

    def activated(self, motion: Motion, t_us: int) -> EgoController:
        """With the newest plan that has taken effect by ``t_us`` under control."""
        current = self
        while current.pending and current.pending[0].from_us <= t_us:
            plan, *rest = current.pending
            controller = current._controller_of(plan.plan, motion, t_us)
            single = None
            if plan.trajectory is not None and self.spec.ego.tracker_version > 1:
                single = SinglePose.of(plan.trajectory)
            current = EgoController(self.spec, self.ego, controller, t_us, tuple(rest), single)
        if current.controller is None:
            log = current._follow_log(motion, t_us)
            current = replace(current, controller=log, since_us=t_us)
        return current

    def _controller_of(self, plan: WorldPlan, motion: Motion, t_us: int) -> Controller:
        match plan:
            case PlannedTrajectory():
                return self._tracker(motion, t_us, plan.after(t_us))
            case Control():
                command = Command(plan.acceleration, plan.steering)
                return ConstantCommand(command, self.spec.ego, plan.gear)
            case PoseCommand():
                return Teleport((plan.x, plan.y, plan.yaw), self.spec.ego)
            case _:
                assert_never(plan)

    def _follow_log(self, motion: Motion, t_us: int) -> Controller:
        # Even spacing: some logs have poses milliseconds apart, whose differences are noise.
        end_us = self.ego.end_us
        count = max(-(-(end_us - t_us) // LOG_SPACING_US), 1)
        times = np.linspace(t_us, max(end_us, t_us + 1), count + 1).astype(np.int64)[1:]
        transforms, _ = sample(self.ego, times)
        yaws = np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0])
        poses = np.column_stack([transforms[:, :2, 3], yaws])
        return self._tracker(motion, t_us, PlannedTrajectory(times, poses))

    def _tracker(self, motion: Motion, t_us: int, trajectory: PlannedTrajectory) -> Controller:
        return tracker_of(motion, t_us, trajectory, self.spec.ego, self.single)


def emergency_brake(controller: EgoController, motion: Motion, spec: EgoSpec) -> Controller:
    """The fallback of a planner that is late: brake, and keep the wheels as they are."""
    if controller.spec.action == "pose":
        return Teleport((motion.x, motion.y, motion.yaw), spec)
    return ConstantCommand(
        Command(-min(EMERGENCY_BRAKING, spec.max_braking), motion.steering), spec, gear=None
    )


def plan_in_world(plan: Plan, motion: Motion) -> WorldPlan:
    """A plan that answers the observation of ``motion``, with its poses in the world."""
    if not isinstance(plan, TrajectoryPlan):
        return plan
    frame = (motion.x, motion.y, motion.yaw) if plan.frame == "vehicle" else None
    return PlannedTrajectory.of(plan.times_us, plan.poses, frame)
