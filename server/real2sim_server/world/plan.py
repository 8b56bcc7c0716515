"""Planned trajectories: the reference to follow, legs of one gear each, and reverse gear."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import EgoSpec

from .._records import made_quickly
from .common import cache_by_identity
from .driving import (
    GRAVITY,
    HOLD,
    NO_POSE,
    VEHICLE_MODELS,
    Command,
    curve_at,
    placed_poses,
    plan_curve,
    vehicle_parameters,
)
from .ego_motion import ControlLaw, Motion, advance_motion, commanded, constant_law
from .path import Float, LoopTransform

Pose = tuple[float, float, float]
"""x, y [m], yaw [rad], world frame."""


FEW, CLEARLY = 40, 1e-6
"""Maximum number of poses that are checked one by one, and minimum distance between poses that
rounding cannot reverse [m]."""


MAX_GAP_US = 1_000_000
"""Maximum time between the poses of single-pose plans that continue each other [us]."""


@made_quickly
@dataclass(frozen=True, eq=False)
class PlannedTrajectory:
    """A planned trajectory: poses with times.

    Attributes:
        times_us: [N] int64, increasing [us].
        poses: [N, 3] float64, x, y [m], yaw [rad], world frame.
        is_clear: whether it is already known to lead forwards.
    """

    times_us: NDArray[np.int64]
    poses: Float
    is_clear: bool = False

    @staticmethod
    def of(
        times_us: Sequence[int], poses: Sequence[Pose], frame: Pose | None = None
    ) -> PlannedTrajectory:
        """The trajectory from poses in a frame, whose world pose is given; None for the world."""
        numbers, is_clear = np.array(poses, np.float64), False
        if frame is not None:
            numbers, is_clear = placed_poses(numbers, frame, CLEARLY)
        return PlannedTrajectory(np.array(times_us, np.int64), numbers, is_clear)

    @cached_property
    def leads_forwards(self) -> bool:
        """Whether no pose is behind its predecessor along their mean heading."""
        if len(self.poses) < 2:
            return False
        return (
            self.is_clear
            or _leads_ahead(self.poses)
            or float(distances_along(self.poses).min()) >= 0.0
        )

    def after(self, t_us: int) -> PlannedTrajectory:
        """The part after ``t_us``; the last pose, immediately, if all of it has passed."""
        if t_us < self.times_us.item(0):
            return self
        over = int(np.searchsorted(self.times_us, t_us, side="right"))
        if over == len(self.times_us):
            return PlannedTrajectory(np.array([t_us + 1]), self.poses[-1:])
        return PlannedTrajectory(self.times_us[over:], self.poses[over:])


def _leads_ahead(poses: Float) -> bool:
    """Quick test whether a short plan clearly leads forwards, as nearly all plans do.

    Twice as fast as the arrays of :func:`distances_along`.
    """
    if len(poses) > FEW:
        return False
    x, y, yaw = poses[0].tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    for px, py, pyaw in poses[1:].tolist():
        pcos, psin = math.cos(pyaw), math.sin(pyaw)
        if (px - x) * (cos + pcos) + (py - y) * (sin + psin) < CLEARLY:
            return False
        x, y, cos, sin = px, py, pcos, psin
    return True


def distances_along(poses: Float) -> Float:
    """[..., N - 1] distances between consecutive poses [..., N, 3] along their mean heading [m]."""
    x, y, yaw = poses[..., 0], poses[..., 1], poses[..., 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy = x[..., 1:] - x[..., :-1], y[..., 1:] - y[..., :-1]
    ways: Float = (dx * (cos[..., 1:] + cos[..., :-1]) + dy * (sin[..., 1:] + sin[..., :-1])) / 2
    return ways


class SinglePose(NamedTuple):
    """The pose of a single-pose plan, world frame; start of the next single-pose plan.

    Attributes:
        at_us: target time [us].
        x, y: [m].
        yaw: [rad].
    """

    at_us: int
    x: float
    y: float
    yaw: float

    @staticmethod
    def of(trajectory: PlannedTrajectory) -> SinglePose | None:
        """The pose of a plan if it has only one, else None."""
        if len(trajectory.poses) != 1:
            return None
        return SinglePose(int(trajectory.times_us[0]), *trajectory.poses[0].tolist())

    def before(self, start_us: int, at_us: int) -> tuple[float, float, float, float]:
        """The ``before`` argument of :func:`..driving.plan_curve`, for a plan from ``start_us``.

        ``at_us`` is the time of that plan's pose. ``NO_POSE`` if this one is too old to give a
        speed.
        """
        if not 0 < at_us - self.at_us <= MAX_GAP_US:
            return NO_POSE
        return (self.at_us - start_us) * 1e-6, self.x, self.y, self.yaw

    def speed_to(self, at_us: int, pose: Float) -> float | None:
        """Mean speed along the headings [m/s] to the pose [3] of the next plan.

        None if that pose does not continue this one.
        """
        if not 0 < at_us - self.at_us <= MAX_GAP_US:
            return None
        way = distances_along(np.array([self[1:], pose]))
        return way.item() / ((at_us - self.at_us) * 1e-6)

    def looped(self, loop: LoopTransform) -> SinglePose:
        """The pose after a loop reset of the vehicle."""
        return SinglePose(self.at_us, *loop.poses(np.array([self[1:]]))[0].tolist())


class ReferenceTrajectory:
    """A planned trajectory as a smooth curve over time, see :mod:`..driving.curve`."""

    def __init__(
        self,
        motion: Motion,
        *,
        start_us: int,
        trajectory: PlannedTrajectory,
        spec: EgoSpec,
        before: SinglePose | None = None,
    ) -> None:
        """The curve for a vehicle in ``motion`` at ``start_us``.

        Args:
            motion: vehicle motion.
            start_us: current time [us].
            trajectory: trajectory after ``start_us``.
            spec: vehicle specification.
            before: pose of the previous plan, for single-pose trajectories.
        """
        goes_on = NO_POSE
        if before is not None and len(trajectory.poses) == 1:
            goes_on = before.before(start_us, int(trajectory.times_us[0]))
        self._curve = plan_curve(
            motion.numbers,
            start_us,
            (trajectory.times_us, trajectory.poses, goes_on),
            tuple(vehicle_parameters(spec)),
        )

    @property
    def end(self) -> float:
        """Time of the last pose, relative to the start [s]."""
        return float(self._curve[0][-1, 0])

    @property
    def last_pose(self) -> Pose:
        """x, y [m], yaw [rad], world frame."""
        _, x, y, yaw, _, _ = self._curve[0][-1].tolist()
        return x, y, yaw

    def looped(self, loop: LoopTransform) -> ReferenceTrajectory:
        """The curve after a loop reset of the vehicle."""
        knots = self._curve[0].copy()
        knots[:, 1:4] = loop.poses(knots[:, 1:4])
        # Tangents are only rotated.
        vx, vy, cos, sin = knots[:, 4], knots[:, 5], math.cos(loop.turn), math.sin(loop.turn)
        knots[:, 4:6] = np.column_stack([cos * vx - sin * vy, sin * vx + cos * vy])
        moved = copy.copy(self)
        moved._curve = (knots, *self._curve[1:])
        return moved

    def control_law(self, kind: int) -> ControlLaw:
        """The law that follows the plan by PURSUIT, LQR or ILQR."""
        return ControlLaw(kind, *self._curve)

    def at(self, t: float) -> tuple[float, float, float, float, float]:
        """x, y [m], velocity x, y [m/s] and planned heading [rad], world frame.

        ``t`` >= 0 is the time since the start [s].
        """
        x, y, vx, vy, yaw = curve_at(self._curve, float(t))
        return x, y, vx, vy, yaw


# --- Legs ----------------------------------------------------------------------------------------

CUSP, ON_AGAIN = 0.05, 0.02
"""Minimum distances against and along the headings of a plan for a change of direction [m].
Smaller ones are noise of a stationary plan."""

NEAR = 0.05
"""Minimum distance of a single pose on the other side of the vehicle for a gear change [m]."""


CREEPING = 0.1
"""Minimum speed between successive single poses that determines the gear, independent of the
position of the vehicle [m/s]."""


@made_quickly
@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a plan in one gear.

    Attributes:
        backwards: whether it leads against the headings of its poses.
        trajectory: its poses after the start of the leg.
        begin_us: absolute start time [us]; None for the start of the plan.
        cusp: x, y [m], yaw [rad] of its start; None for the vehicle pose.
    """

    backwards: bool
    trajectory: PlannedTrajectory
    begin_us: int | None = None
    cusp: tuple[float, float, float] | None = None


def legs_of(
    trajectory: PlannedTrajectory, motion: Motion, before: SinglePose | None = None
) -> tuple[Leg, ...]:
    """The legs of a plan for a vehicle; one leg if it leads forwards throughout.

    ``before``: pose of the previous plan, for single-pose plans.
    """
    poses = trajectory.poses
    if len(poses) == 1:
        at_us = int(trajectory.times_us[0])
        goes = None if before is None else before.speed_to(at_us, poses[0])
        backwards = _is_behind(poses[0], motion)
        if goes is not None and abs(goes) > CREEPING:
            backwards = goes < 0
        return (Leg(backwards, trajectory),)
    if not motion.reversing and trajectory.leads_forwards:
        return (Leg(False, trajectory),)
    turns = _turns(distances_along(poses), backwards=motion.reversing)
    legs = []
    for k, (begin, backwards) in enumerate(turns):
        end = turns[k + 1][0] if k + 1 < len(turns) else len(poses) - 1
        first = begin + 1 if k else 0
        part = PlannedTrajectory(trajectory.times_us[first : end + 1], poses[first : end + 1])
        x, y, yaw = poses[begin].tolist()
        legs.append(
            Leg(backwards, part, int(trajectory.times_us[begin]), (x, y, yaw))
            if k
            else Leg(backwards, part)
        )
    return tuple(legs)


def may_lead_backwards(plans: Float) -> NDArray[np.bool_]:
    """[W] bool, whether any part of each plan leads against its headings.

    Args:
        plans: [W, N, 3] poses x, y [m], yaw [rad], vehicle frame.
    """
    if plans.shape[1] == 1:
        x, y, yaw = plans[:, 0].T
        behind: NDArray[np.bool_] = np.less(x * (1 + np.cos(yaw)) + y * np.sin(yaw), 0.0)
        return behind
    against: NDArray[np.bool_] = np.any(distances_along(plans) < 0, axis=1)
    return against


def _turns(along: Float, *, backwards: bool) -> list[tuple[int, bool]]:
    """Start of each leg and whether it leads backwards. ``backwards``: the current gear."""
    way, farthest, place = 0.0, 0.0, 0
    turns = [(0, backwards)]
    for k, step in enumerate(along.tolist(), start=1):
        way += -step if backwards else step
        if way >= farthest:
            farthest, place = way, k
        elif farthest - way > (ON_AGAIN if backwards else CUSP):
            backwards = not backwards
            if place == turns[-1][0]:
                turns[-1] = (place, backwards)
            else:
                turns.append((place, backwards))
            way, farthest, place = farthest - way, farthest - way, k
    return turns


def _is_behind(pose: Float, motion: Motion) -> bool:
    """Whether a single pose leads a vehicle backwards."""
    x, y, yaw = pose.tolist()
    dx, dy = x - motion.x, y - motion.y
    cos, sin = math.cos(motion.yaw) + math.cos(yaw), math.sin(motion.yaw) + math.sin(yaw)
    ahead: float = (dx * cos + dy * sin) / 2
    return ahead < (NEAR if motion.reversing else -NEAR)


# --- Reverse gear --------------------------------------------------------------------------------

# A vehicle rotated by pi, with negated speeds, accelerations and steering angles, obeys the same
# equations at its rear axle. Dynamics and trackers therefore only implement forward driving. The
# gear changes only at rest and reverse has its own top speed; pending commands belong to the gear
# in which they were given.

SHIFT_BRAKING = 6.0
"""Maximum deceleration of a vehicle that still moves when its plan has already changed direction
[m/s^2]."""

SHIFT_LOOK_US = 10_000
"""Check interval while a vehicle brakes for a gear change [us]."""


def can_reverse(spec: EgoSpec) -> bool:
    """Whether a vehicle can reverse: it has a reverse speed and its model supports reversing."""
    return spec.max_reverse_speed > 0 and VEHICLE_MODELS[spec.dynamics].backwards is not None


@cache_by_identity
@lru_cache(maxsize=256)
def backwards_spec(spec: EgoSpec) -> EgoSpec:
    """The mirror image of a vehicle with a reverse gear."""
    model = VEHICLE_MODELS[spec.dynamics].backwards
    change: dict[str, Any] = {"max_speed": spec.max_reverse_speed, "dynamics": model}
    if model != spec.dynamics:
        # Tyre friction limits the acceleration; the kinematic model has no such limit.
        grip = spec.vehicle.friction * GRAVITY
        change["max_acceleration"] = min(spec.max_acceleration, grip)
        change["max_braking"] = min(spec.max_braking, grip)
    return spec.model_copy(update=change)


def mirrored(motion: Motion, half_turn: float = math.pi) -> Motion:
    """The mirror image of a vehicle, which drives forwards if the vehicle drives backwards.

    Args:
        motion: vehicle motion.
        half_turn: pi, or -pi for the inverse.
    """
    return motion._replace(
        yaw=motion.yaw + half_turn,
        speed=_negative(motion.speed),
        acceleration=_negative(motion.acceleration),
        steering=_negative(motion.steering),
        lateral_speed=_negative(motion.lateral_speed),
        drive=_negative(motion.drive),
        pending=tuple([_mirrored_command(c) for c in motion.pending]),
    )


def advance_in_gear(
    motion: Motion,
    law: ControlLaw,
    spec: EgoSpec,
    dt_us: int,
    *,
    since: float,
    backwards: bool,
) -> Motion:
    """The vehicle ``dt_us`` later under a law of one gear.

    Args:
        motion: current motion.
        law: law in the frame of that gear; mirrored for the reverse gear.
        spec: specification of a vehicle with a reverse gear.
        dt_us: duration [us].
        since: time since the start of the law's plan [s].
        backwards: whether the law is for the reverse gear.
    """
    end_us = dt_us
    at_us = 0
    while at_us < end_us:
        motion = _in_gear_of_its_motion(motion)
        if motion.reversing != backwards and motion.speed == 0.0:
            motion = _shifted(motion)
        if motion.reversing == backwards:
            rest_us, later = end_us - at_us, since + at_us * 1e-6
            return _advanced(motion, law, spec, rest_us, since=later)
        piece_us = min(SHIFT_LOOK_US, end_us - at_us)
        motion = _advanced(motion, _braking(law, motion, spec), spec, piece_us, since=0.0)
        at_us += piece_us
    return _in_gear_of_its_motion(motion)


def command_in_gear(
    motion: Motion, law: ControlLaw, spec: EgoSpec, *, since: float, backwards: bool
) -> Command:
    """The command of a law of one gear, along the heading; see :func:`advance_in_gear`."""
    if not backwards:
        return commanded(motion, law, spec, since=since)
    return _mirrored_command(commanded(mirrored(motion), law, backwards_spec(spec), since=since))


def _advanced(
    motion: Motion, law: ControlLaw, spec: EgoSpec, dt_us: int, *, since: float
) -> Motion:
    """Advance with a law of the engaged gear."""
    if not motion.reversing:
        return advance_motion(motion, law, spec, dt_us, since=since)
    image = advance_motion(mirrored(motion), law, backwards_spec(spec), dt_us, since=since)
    return mirrored(image, -math.pi)._replace(reversing=True)


def _braking(law: ControlLaw, motion: Motion, spec: EgoSpec) -> ControlLaw:
    """The law that brakes in the engaged gear, before a gear change.

    A HOLD command of the other gear brakes with its own magnitude and steers; otherwise the
    steering is held.
    """
    if law.kind == HOLD:
        return constant_law(Command(-abs(law.hold[0]), -law.hold[1]))
    steering = -motion.steering if motion.reversing else motion.steering
    return constant_law(Command(-min(SHIFT_BRAKING, spec.max_braking), steering))


def _in_gear_of_its_motion(motion: Motion) -> Motion:
    """Set the gear to the direction of motion, after an impact has reversed it."""
    backwards = motion.speed < 0.0
    return _shifted(motion) if motion.speed and backwards != motion.reversing else motion


def _shifted(motion: Motion) -> Motion:
    """Change the gear: pending braking remains, pending acceleration is dropped."""

    def kept(acceleration: float) -> float:
        brakes = acceleration > 0.0 if motion.reversing else acceleration < 0.0
        return -acceleration if brakes else 0.0

    pending = tuple([Command(kept(c.acceleration), c.steering) for c in motion.pending])
    return motion._replace(
        reversing=not motion.reversing, drive=kept(motion.drive), pending=pending
    )


def _mirrored_command(command: Command) -> Command:
    return Command(_negative(command.acceleration), _negative(command.steering))


def _negative(value: float) -> float:
    """The negated value, without negative zero, which would show on the wire."""
    return 0.0 - value
