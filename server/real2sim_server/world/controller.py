"""Controllers of the ego: they follow the active plan, or the log before the first plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, Self, assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import EgoSpec, ResetSpec
from real2sim_proto.plans import Control, Gear, PoseCommand, TrajectoryPlan

from .._records import made_quickly
from ..edit.tracks import sample
from ..scene import Trajectory
from .common import WorldError, copy_with
from .driving import KINDS, LQR, MOVING, Command
from .ego_motion import Motion, advance_motion, commanded, constant_law, teleported
from .path import LoopTransform
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
    """A tracker within the limits of the vehicle; stateless, so worlds can be forked.

    Attributes:
        kind: number of the tracker, see :mod:`..driving.trackers`.
        reference: reference trajectory.
        spec: vehicle specification.
    """

    kind: int
    reference: ReferenceTrajectory
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later.

        Args:
            motion: current motion.
            since: time since the start of the reference [s].
            dt_us: duration [us].
        """
        return advance_motion(
            motion, self.reference.control_law(self.kind), self.spec, dt_us, since=since
        )

    def command(self, motion: Motion, t: float) -> Command:
        """The command for a motion, ``t`` seconds after the start of the reference."""
        return commanded(motion, self.reference.control_law(self.kind), self.spec, since=t)

    def looped(self, loop: LoopTransform) -> Self:
        """The tracker after a loop reset of the vehicle."""
        return replace(self, reference=self.reference.looped(loop))


@dataclass(frozen=True, eq=False)
class PerfectTracker:
    """Moves the vehicle exactly along the plan, without any vehicle limits.

    For open-loop comparisons.

    Attributes:
        reference: reference trajectory.
        spec: vehicle specification.
    """

    reference: ReferenceTrajectory
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later, at the planned pose (the last one after the plan's end)."""
        t = since + dt_us * 1e-6
        if t >= self.reference.end:
            return teleported(motion, self.reference.last_pose, self.spec, dt_us)
        x, y, vx, vy, yaw = self.reference.at(t)
        if math.hypot(vx, vy) > MOVING:
            back = vx * math.cos(yaw) + vy * math.sin(yaw) < 0 and can_reverse(self.spec)
            yaw = math.atan2(-vy, -vx) if back else math.atan2(vy, vx)
        return teleported(motion, (x, y, yaw), self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """The LQR command; used for vehicles pushed by an impact."""
        return commanded(motion, self.reference.control_law(LQR), self.spec, since=t)

    def looped(self, loop: LoopTransform) -> Self:
        """The tracker after a loop reset of the vehicle."""
        return replace(self, reference=self.reference.looped(loop))


@dataclass(frozen=True, eq=False)
class GearedLeg:
    """A leg of a plan with its reference.

    Attributes:
        backwards: whether it is driven in reverse gear; the reference is mirrored then.
        begin_us, end_us: relative to the start of the plan [us].
        reference: reference trajectory.
    """

    backwards: bool
    begin_us: int
    end_us: int
    reference: ReferenceTrajectory


@dataclass(frozen=True, eq=False)
class GearedTracker:
    """A tracker that changes gear at the cusps of its plan.

    Attributes:
        kind: number of the tracker, see :mod:`..driving.trackers`.
        legs: consecutive legs of the plan.
        spec: vehicle specification.
    """

    kind: int
    legs: tuple[GearedLeg, ...]
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later, ``since`` seconds after the start of the plan."""
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
        """The command for a motion, ``t`` seconds after the start of the plan."""
        leg = self._leg_at(round(t * 1e6))
        law = leg.reference.control_law(self.kind)
        since = t - leg.begin_us * 1e-6
        return command_in_gear(motion, law, self.spec, since=since, backwards=leg.backwards)

    def looped(self, loop: LoopTransform) -> Self:
        """The tracker after a loop reset of the vehicle."""
        legs = [replace(leg, reference=leg.reference.looped(loop)) for leg in self.legs]
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
    """The tracker of a spec, for a vehicle in ``motion`` at ``start_us``.

    ``before`` is the pose of the previous plan, for plans of a single pose.
    """
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
    """The tracker of a spec, for a plan without reverse driving."""
    if spec.tracker == "perfect":
        return PerfectTracker(reference, spec)
    return ControlledTracker(KINDS[spec.tracker], reference, spec)


Plan = TrajectoryPlan | Control | PoseCommand
WorldPlan = PlannedTrajectory | Control | PoseCommand

LOG_SPACING_US = 100_000
"""Maximum interval between poses for following the log [us]."""

EMERGENCY_BRAKING = 6.0
"""Maximum deceleration of the fallback ``brake`` [m/s^2]."""


class Controller(Protocol):
    """Moves the ego until another one takes over."""

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later, ``since`` seconds after the controller's start."""

    def command(self, motion: Motion, t: float) -> Command:
        """The command for a motion, ``t`` seconds after the controller's start."""

    def looped(self, loop: LoopTransform) -> Self:
        """The controller after a loop reset of the ego."""


@made_quickly
@dataclass(frozen=True)
class ConstantCommand:
    """A constant command.

    Attributes:
        constant: acceleration in the direction of the gear, and road-wheel angle.
        spec: vehicle specification.
        gear: gear of the command; None for the engaged one.
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
        """The constant command, along the heading."""
        acceleration, steering = self.constant
        return Command(-acceleration if self._backwards(motion) else acceleration, steering)

    def _backwards(self, motion: Motion) -> bool:
        return self.gear == "reverse" if self.gear is not None else motion.reversing

    def looped(self, loop: LoopTransform) -> Self:
        """Returns itself, because a command does not depend on the position."""
        return self


@dataclass(frozen=True)
class Teleport:
    """Places the vehicle at a pose and keeps it there."""

    pose: Pose
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle at the pose, with the velocity of the displacement."""
        return teleported(motion, self.pose, self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """A braking command, because a teleported vehicle has no controller."""
        return Command(-EMERGENCY_BRAKING, motion.steering)

    def looped(self, loop: LoopTransform) -> Self:
        """The pose after a loop reset."""
        x, y, yaw = loop.poses(np.array([self.pose]))[0].tolist()
        return replace(self, pose=(x, y, yaw))


@made_quickly
@dataclass(frozen=True)
class PendingPlan:
    """A plan that has not taken effect yet.

    Attributes:
        from_us: time at which it takes effect [us].
        plan: plan, world frame.
    """

    from_us: int
    plan: WorldPlan

    @property
    def trajectory(self) -> PlannedTrajectory | None:
        """The plan if it is a trajectory, else None."""
        return self.plan if isinstance(self.plan, PlannedTrajectory) else None

    def looped(self, loop: LoopTransform) -> PendingPlan:
        """The plan after a loop reset of the ego."""
        if isinstance(self.plan, PlannedTrajectory):
            return replace(self, plan=replace(self.plan, poses=loop.poses(self.plan.poses)))
        if isinstance(self.plan, PoseCommand):
            (x, y), yaw = loop.place(self.plan.x, self.plan.y), self.plan.yaw + loop.turn
            return replace(self, plan=self.plan.model_copy(update={"x": x, "y": y, "yaw": yaw}))
        return self


@made_quickly
@dataclass(frozen=True, eq=False)
class EgoController:
    """The active controller of the ego and the pending plans. Immutable.

    Attributes:
        spec: options of the episode.
        ego: recorded trajectory, followed before the first plan.
        controller: active controller; None before the first plan.
        since_us: its start time [us].
        pending: plans that have not taken effect yet, in order of activation.
        single: pose of the active plan if it has a single pose.
    """

    spec: ResetSpec
    ego: Trajectory
    controller: Controller | None = None
    since_us: int = 0
    pending: tuple[PendingPlan, ...] = ()
    single: SinglePose | None = None

    def with_plan(self, plan: Plan, motion: Motion, t_us: int, from_us: int) -> EgoController:
        """Add a plan.

        Args:
            plan: plan of the policy.
            motion: ego motion of the observation that the plan is based on.
            t_us: time of that observation [us].
            from_us: time at which the plan takes effect [us].

        Raises:
            WorldError: INVALID_ACTION if the kind differs from that of the reset, or its times have
                passed.
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
                hint="times_us are absolute simulation times after t_us of the observation; leave "
                "out the present pose, which some planners put first (as those of nuPlan do)",
            )
        kept = tuple(p for p in self.pending if p.from_us < from_us)
        pending = (*kept, PendingPlan(from_us, plan_in_world(plan, motion)))
        return copy_with(self, pending=pending)

    def advance(self, motion: Motion, t_us: int, us: int) -> tuple[EgoController, Motion]:
        """Controller and vehicle ``us`` microseconds after ``t_us``."""
        current, end_us = self, t_us + us
        while t_us < end_us:
            current = current.activated(motion, t_us)
            until = min([end_us, *(p.from_us for p in current.pending)])
            since = (t_us - current.since_us) * 1e-6
            assert current.controller is not None
            motion = current.controller.advance(motion, since, until - t_us)
            t_us = until
        return current, motion

    def looped(self, loop: LoopTransform) -> EgoController:
        """The controller and its plans after a loop reset of the ego."""
        controller = self.controller.looped(loop) if self.controller is not None else None
        pending = tuple(plan.looped(loop) for plan in self.pending)
        single = self.single and self.single.looped(loop)
        return replace(self, controller=controller, pending=pending, single=single)

    def command(self, motion: Motion, t_us: int) -> Command:
        """The command of the active controller for a motion at ``t_us``."""
        assert self.controller is not None
        return self.controller.command(motion, (t_us - self.since_us) * 1e-6)

    def activated(self, motion: Motion, t_us: int) -> EgoController:
        """Activate the newest plan that has taken effect by ``t_us``."""
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
        # Resample evenly: some logs have poses milliseconds apart, whose differences are noise.
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
    """The fallback for a late planner: brake and hold the steering."""
    if controller.spec.action == "pose":
        return Teleport((motion.x, motion.y, motion.yaw), spec)
    return ConstantCommand(
        Command(-min(EMERGENCY_BRAKING, spec.max_braking), motion.steering), spec, gear=None
    )


def plan_in_world(plan: Plan, motion: Motion) -> WorldPlan:
    """The plan in the world frame; ``motion`` is the ego motion that it is based on."""
    if not isinstance(plan, TrajectoryPlan):
        return plan
    frame = (motion.x, motion.y, motion.yaw) if plan.frame == "vehicle" else None
    return PlannedTrajectory.of(plan.times_us, plan.poses, frame)
