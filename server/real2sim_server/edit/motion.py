"""The registry of edit operations, and the operations on poses, sizes and trajectories."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import (
    Frame,
    Operation,
    Retime,
    Rotate,
    Scale,
    SetPose,
    SetTrajectory,
    TimeRange,
    Translate,
)

from ..geometry import (
    Float,
    bottom_centres,
    multiply_quaternions,
    quaternion_to_matrix,
    transform_from,
)
from ..scene import Ground, Trajectory
from .state import EditError, ObjectState, ScenarioState
from .tracks import sample_poses

# --- Registry ------------------------------------------------------------------------------------

# Each operation is registered for its wire model.

MAX_ID_LENGTH = 80


@dataclass(frozen=True, eq=False)
class AppliedOperation:
    """Result of one operation.

    Attributes:
        state: state after the operation.
        inverse: operation that reverts it.
        touched: id of the object to review, or None.
        created: id of the new object, or None.
    """

    state: ScenarioState
    inverse: Operation
    touched: str | None = None
    created: str | None = None


Apply = Callable[[ScenarioState, Any], AppliedOperation]
"""``apply(state, operation)``: pure; raises EditError or SceneError if it is impossible."""

ApplyToObject = Callable[[ScenarioState, ObjectState, Any], AppliedOperation]
"""``apply(state, subject, operation)``, for the object that ``operation.object_id`` names."""

APPLY: dict[type[Any], Apply] = {}
"""Functions by wire model, see :mod:`real2sim_proto.operations`."""


def operation(model: type[Any]) -> Callable[[Apply], Apply]:
    """Register the function that applies operations of a model."""

    def register(apply: Apply) -> Apply:
        APPLY[model] = apply
        return apply

    return register


def object_operation(model: type[Any]) -> Callable[[ApplyToObject], ApplyToObject]:
    """Register the function that applies operations of a model to their object.

    If the object does not exist or is deleted, the operation raises like :func:`require_object`.
    """

    def register(apply: ApplyToObject) -> ApplyToObject:
        def to_object(state: ScenarioState, operation: Any) -> AppliedOperation:
            return apply(state, require_object(state, operation.object_id), operation)

        APPLY[model] = to_object
        return apply

    return register


def apply_operation(state: ScenarioState, operation: Operation) -> AppliedOperation:
    """The state after one operation. Raises EditError or SceneError if it is impossible."""
    return APPLY[type(operation)](state, operation)


def object_changed(
    state: ScenarioState, subject: ObjectState, inverse: Operation
) -> AppliedOperation:
    """The change that replaces the object with the same id by ``subject``."""
    return AppliedOperation(state.with_object(subject), inverse, touched=subject.object_id)


def invalid_operation(message: str, *, hint: str | None = None) -> EditError:
    """An EditError with code INVALID_OPERATION."""
    return EditError(ErrorCode.INVALID_OPERATION, message, hint=hint)


def require_object(state: ScenarioState, object_id: str) -> ObjectState:
    """The object with an id. Raises EditError: UNKNOWN_OBJECT, or INVALID_OPERATION if deleted."""
    found = state.objects.get(object_id)
    if found is None:
        known = ", ".join(o.object_id for o in state.visible) or "none"
        raise EditError(
            ErrorCode.UNKNOWN_OBJECT,
            f"there is no object {object_id!r}",
            hint=f"objects of this scenario: {known}",
        )
    if found.deleted:
        raise invalid_operation(
            f"object {object_id!r} is deleted",
            hint=f"bring it back with restore of {object_id!r} first",
        )
    return found


def new_id(state: ScenarioState, wanted: str | None, stem: str) -> str:
    """The id ``wanted``, or the first free id made of ``stem`` and a number.

    Raises:
        EditError: INVALID_OPERATION if the id is taken or too long.
    """
    if wanted is not None:
        if state.has_id(wanted):
            reserved = wanted in state.tombstones or (
                wanted in state.objects and state.objects[wanted].deleted
            )
            deleted = " (deleted; its id stays reserved)" if reserved else ""
            raise invalid_operation(
                f"the id {wanted!r} is taken{deleted}",
                hint="give another id, or none to get the next free one",
            )
        return wanted
    n = 1
    while state.has_id(free := f"{stem}{n}"):
        n += 1
    if len(free) > MAX_ID_LENGTH:
        raise invalid_operation(
            f"the new id {free!r} would be longer than {MAX_ID_LENGTH} characters",
            hint="give a shorter new_id",
        )
    return free


def wire_track(trajectory: Trajectory) -> Track:
    """Convert a trajectory to its wire model."""
    return Track(
        times_us=trajectory.times_us.tolist(),
        positions=trajectory.positions.tolist(),
        quaternions=trajectory.quaternions.tolist(),
    )


def trajectory_of(track: Track) -> Trajectory:
    """Convert the wire model of a trajectory. Raises SceneError if it is invalid."""
    return Trajectory(
        np.array(track.times_us, dtype=np.int64),
        np.array(track.positions, dtype=np.float64),
        np.array(track.quaternions, dtype=np.float64),
    )


MAX_COORDINATE = 1e6
"""Limit of positions in the wire format [m]."""

MAX_TIME_US = 2**62

SCALE_RANGE = (1e-3, 1e3)
"""Limits of an object's total scale along each axis."""

BLEND_STEP_US = 50_000
"""Spacing of the poses in the transition of an edit."""


@object_operation(Translate)
def translate(state: ScenarioState, subject: ObjectState, operation: Translate) -> AppliedOperation:
    """Shift an object, at all times or in a time range."""
    shift = (operation.x, operation.y, operation.z)
    track, weights = _weighted(subject.trajectory, operation.time_range)
    moved = shifted(track, shift, operation.frame, weights=weights)
    if operation.time_range is None and not operation.snap:
        inverse = operation.model_copy(update={k: -v for k, v in zip("xyz", shift, strict=True)})
        return _moved(state, subject, moved, inverse)
    return _follow(state, subject, moved, snap=operation.snap)


@object_operation(Rotate)
def rotate(state: ScenarioState, subject: ObjectState, operation: Rotate) -> AppliedOperation:
    """Rotate an object about its centre or with its path, at all times or in a time range."""
    axis = np.array(operation.axis) / np.linalg.norm(operation.axis)
    track, weights = _weighted(subject.trajectory, operation.time_range)
    half = operation.angle / 2 * (weights if weights is not None else np.ones(1))[:, None]
    positions, about_us = track.positions, operation.about_us
    if about_us is None:
        turns = np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)
    else:
        at = min(max(about_us, track.start_us), track.end_us)
        [pivot], [facing] = sample_poses(track, np.array([at]))
        if operation.frame == "object":
            axis = quaternion_to_matrix(facing) @ axis
        turns = np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)
        away = (positions - pivot)[:, :, None]
        positions = _within_limits(pivot + (quaternion_to_matrix(turns) @ away)[..., 0])
    if operation.frame == "object" and about_us is None:
        quaternions = multiply_quaternions(track.quaternions, turns)
    else:
        quaternions = multiply_quaternions(turns, track.quaternions)
    turned = Trajectory(track.times_us, positions, quaternions)
    if operation.time_range is None and not operation.snap:
        inverse = operation.model_copy(update={"angle": -operation.angle})
        return _moved(state, subject, turned, inverse)
    return _follow(state, subject, turned, snap=operation.snap)


@object_operation(Scale)
def scale(state: ScenarioState, subject: ObjectState, operation: Scale) -> AppliedOperation:
    """Scale an object; the anchor stays in place."""
    factors = (operation.x, operation.y, operation.z)
    a, b, c = subject.scale
    scaled = rescaled(
        subject,
        (a * operation.x, b * operation.y, c * operation.z),
        keep_bottom=operation.anchor == "bottom",
    )
    inverse = operation.model_copy(update={k: 1 / v for k, v in zip("xyz", factors, strict=True)})
    return object_changed(state, scaled, inverse)


@object_operation(SetPose)
def set_pose(state: ScenarioState, subject: ObjectState, operation: SetPose) -> AppliedOperation:
    """Set a constant pose for the whole time range of the scene."""
    stood = trajectory_of(stationary_track(operation.pose, state.time_range))
    return _follow(state, subject, stood, snap=operation.snap)


@object_operation(SetTrajectory)
def set_trajectory(
    state: ScenarioState, subject: ObjectState, operation: SetTrajectory
) -> AppliedOperation:
    """Replace the trajectory of an object."""
    return _follow(state, subject, trajectory_of(operation.trajectory), snap=operation.snap)


@object_operation(Retime)
def retime(state: ScenarioState, subject: ObjectState, operation: Retime) -> AppliedOperation:
    """Shift or scale an object's trajectory in time."""
    old = subject.trajectory
    since = (old.times_us - old.start_us).astype(np.float64) / operation.speed
    times = old.start_us + operation.delay_us + np.rint(since).astype(np.int64)
    if (np.diff(times) <= 0).any():
        raise invalid_operation(
            f"at {operation.speed:g} times the speed, poses would fall on the same microsecond",
            hint="choose a lower speed",
        )
    if max(abs(int(times[0])), abs(int(times[-1]))) > MAX_TIME_US:
        raise invalid_operation(
            f"the object would move from {times[0]} to {times[-1]} us, beyond what can be stored",
            hint="choose a smaller delay_us or a higher speed",
        )
    return _follow(state, subject, Trajectory(times, old.positions, old.quaternions))


# --- shared with insertion and replacement -----------------------------------------------------


def stationary_track(pose: Pose, time_range: tuple[int, int]) -> Track:
    """The trajectory of a stationary object for the whole time range of the scene."""
    times = sorted(set(time_range))
    return Track(
        times_us=times,
        positions=[pose.position] * len(times),
        quaternions=[pose.quaternion] * len(times),
    )


def straight_on(pose: Pose, speed: float, start_us: int, end_us: int) -> Trajectory:
    """The trajectory from a pose along its heading at ``speed`` [m/s], until ``end_us`` or for a
    second.
    """
    times = np.array([start_us, max(end_us, start_us + 1_000_000)], np.int64)
    ahead = transform_from(pose.position, pose.quaternion)[:3, 0]
    way = speed * (times - start_us)[:, None] * 1e-6
    positions = np.asarray(pose.position) + way * ahead
    return Trajectory(times, positions, np.tile(pose.quaternion, (2, 1)))


def snap_to_ground(
    trajectory: Trajectory, size: tuple[float, float, float], ground: Ground
) -> Trajectory:
    """The trajectory with the bottoms of its boxes on the ground."""
    poses = transform_from(trajectory.positions, trajectory.quaternions)
    bottoms = bottom_centres(poses, size)
    positions = trajectory.positions.copy()
    positions[:, 2] += ground.height_at(bottoms[:, :2]) - bottoms[:, 2]
    return Trajectory(trajectory.times_us, positions, trajectory.quaternions)


def shifted(
    trajectory: Trajectory,
    shift: tuple[float, float, float],
    frame: Frame,
    *,
    weights: Float | None = None,
) -> Trajectory:
    """The trajectory shifted [m], at each pose by the fraction in ``weights`` [T].

    Raises:
        EditError: INVALID_OPERATION if it exceeds the limits of the wire format.
    """
    offset: Float = np.array(shift)
    if frame == "object":
        offset = quaternion_to_matrix(trajectory.quaternions) @ offset
    if weights is not None:
        offset = weights[:, None] * offset
    positions = _within_limits(trajectory.positions + offset)
    return Trajectory(trajectory.times_us, positions, trajectory.quaternions)


def rescaled(
    subject: ObjectState, scale: tuple[float, float, float], *, keep_bottom: bool
) -> ObjectState:
    """The object at another ``scale``; its box centre, or the bottom's centre, stays in place.

    Raises:
        EditError: INVALID_OPERATION outside ``SCALE_RANGE``.
    """
    lowest, highest = SCALE_RANGE
    if min(scale) < lowest or max(scale) > highest:
        raise invalid_operation(
            f"scalings together would be {scale}; {lowest:g} to {highest:g} is allowed",
            hint="scale by factors nearer to 1",
        )
    scaled = replace(subject, scale=scale)
    if not keep_bottom:
        return scaled
    # The origin is the box centre: keeping the bottom in place raises it by half the growth.
    lift = (scaled.scaled_size[2] - subject.scaled_size[2]) / 2
    raised = shifted(subject.trajectory, (0.0, 0.0, lift), "object")
    return replace(scaled, trajectory=raised)


# --- inside -------------------------------------------------------------------------------------


def _within_limits(positions: Float) -> Float:
    if np.abs(positions).max() > MAX_COORDINATE:
        raise invalid_operation(
            f"the object would be {np.abs(positions).max():.6g} m away from the origin; "
            f"{MAX_COORDINATE:g} m is allowed",
            hint="move it by less",
        )
    return positions


def _follow(
    state: ScenarioState, subject: ObjectState, trajectory: Trajectory, *, snap: bool = False
) -> AppliedOperation:
    inverse = SetTrajectory(object_id=subject.object_id, trajectory=wire_track(subject.trajectory))
    if snap:
        trajectory = snap_to_ground(trajectory, subject.scaled_size, state.ground)
    return _moved(state, subject, trajectory, inverse)


def _moved(
    state: ScenarioState, subject: ObjectState, trajectory: Trajectory, inverse: Operation
) -> AppliedOperation:
    return object_changed(state, replace(subject, trajectory=trajectory, edited=True), inverse)


def _weighted(
    trajectory: Trajectory, time_range: TimeRange | None
) -> tuple[Trajectory, Float | None]:
    """The trajectory with extra poses in the edit's transitions, and the edit's weights [T]."""
    if time_range is None:
        return trajectory, None
    times = np.union1d(trajectory.times_us, _bends(trajectory, time_range))
    positions, quaternions = sample_poses(trajectory, times)
    return Trajectory(times, positions, quaternions), _weights(times, time_range)


def _bends(trajectory: Trajectory, time_range: TimeRange) -> NDArray[np.int64]:
    blend = time_range.blend_us
    ramps = []
    if time_range.start_us is not None:
        ramps.append(_ramp(time_range.start_us, blend))
    if time_range.end_us is not None:
        ramps.append(_ramp(time_range.end_us - blend, blend))
    bends = np.concatenate([np.zeros(0, dtype=np.int64), *ramps])
    return bends[(bends > trajectory.start_us) & (bends < trajectory.end_us)]


def _ramp(start_us: int, blend_us: int) -> NDArray[np.int64]:
    if blend_us == 0:
        # A jump needs two poses, one microsecond apart.
        return np.array([start_us - 1, start_us], dtype=np.int64)
    steps = max(2, -(-blend_us // BLEND_STEP_US))
    return start_us + np.arange(steps + 1, dtype=np.int64) * blend_us // steps


def _weights(times_us: NDArray[np.int64], time_range: TimeRange) -> Float:
    weights = np.ones(len(times_us))
    if time_range.start_us is not None:
        weights *= _smooth(times_us - time_range.start_us, time_range.blend_us)
    if time_range.end_us is not None:
        weights *= _smooth(time_range.end_us - times_us, time_range.blend_us)
    return weights


def _smooth(since_us: NDArray[np.int64], blend_us: int) -> Float:
    """0 before, 1 after; in between 6 s^5 - 15 s^4 + 10 s^3, with zero velocity and acceleration at
    both ends (Flash and Hogan 1985, minimum jerk).
    """
    if blend_us == 0:
        return np.where(since_us >= 0, 1.0, 0.0)
    s = np.clip(since_us / blend_us, 0.0, 1.0)
    smooth: Float = s**3 * (10 + s * (6 * s - 15))
    return smooth
