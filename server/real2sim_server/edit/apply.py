"""Operations onto a state: pure, atomic, each with its inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import (
    Delete,
    Duplicate,
    Frame,
    Operation,
    Restore,
    Rotate,
    Scale,
    SetPose,
    SetTrajectory,
    Translate,
)
from real2sim_proto.scenarios import EditWarning

from ..scene import SceneError, Trajectory
from ..scene.rotation import Float, multiply_quaternions, quaternion_to_matrix
from ..scene.scene import MAX_OBJECTS
from .errors import EditError
from .review import GroundHeight, review
from .state import ObjectState, ScenarioState

MAX_ID_LENGTH = 80
MAX_COORDINATE = 1e6
"""Positions stay within what the wire can carry [m]."""

SCALE_RANGE = (1e-3, 1e3)
"""All scalings of an object together stay within this, along each axis."""


@dataclass(frozen=True, eq=False)
class EditOutcome:
    """What a batch of operations leads to.

    Attributes:
        state: after all operations.
        created: ids of new objects, in order.
        inverse: operations that take the batch back when applied in this order. Numbers come back
            to within rounding; `Scenario.undo` brings back the exact state.
        warnings: what a person should look at.
    """

    state: ScenarioState
    created: tuple[str, ...]
    inverse: tuple[Operation, ...]
    warnings: tuple[EditWarning, ...]


@dataclass(frozen=True, eq=False)
class _Change:
    """One operation's doing: the object as it is now, and what takes that back."""

    changed: ObjectState
    inverse: Operation
    created: bool = False


def apply_operations(
    state: ScenarioState, operations: Sequence[Operation], *, ground: GroundHeight | None = None
) -> EditOutcome:
    """All of ``operations`` in order, or none of them.

    Args:
        state: left as it is.
        operations: validated wire models.
        ground: height of the ground for warnings; without it the ground counts as flat.

    Raises:
        EditError: UNKNOWN_OBJECT or INVALID_OPERATION, naming the place in the batch.
    """
    changes: list[_Change] = []
    after = state
    for index, operation in enumerate(operations):
        change = _apply_one(after, operation, index)
        after = after.with_object(change.changed)
        changes.append(change)
    touched = dict.fromkeys(c.changed.object_id for c in changes)
    return EditOutcome(
        state=after,
        created=tuple(c.changed.object_id for c in changes if c.created),
        inverse=tuple(c.inverse for c in reversed(changes)),
        warnings=tuple(review(after, tuple(touched), ground=ground)),
    )


def advance(state: ScenarioState, operations: Sequence[Operation]) -> ScenarioState:
    """The state of :func:`apply_operations` alone, for replaying a log. Raises like it."""
    for index, operation in enumerate(operations):
        state = state.with_object(_apply_one(state, operation, index).changed)
    return state


def _apply_one(state: ScenarioState, operation: Operation, index: int) -> _Change:
    try:
        return _change(state, operation)
    except EditError as error:
        where = f"operation {index} ({operation.op} of {operation.object_id!r}): {error}"
        raise EditError(error.code, where, hint=error.hint, index=index) from None
    except SceneError as error:
        where = f"operation {index} ({operation.op} of {operation.object_id!r}): {error}"
        raise EditError(ErrorCode.INVALID_OPERATION, where, index=index) from error


def _change(state: ScenarioState, operation: Operation) -> _Change:  # noqa: PLR0911, one per kind
    if isinstance(operation, Restore):
        return _restore(state, operation)
    subject = _existing(state, operation.object_id)
    match operation:
        case Translate():
            return _translate(subject, operation)
        case Rotate():
            return _rotate(subject, operation)
        case Scale():
            return _scale(subject, operation)
        case SetPose():
            track = _standing(operation.pose, state.time_range)
            return _follow(subject, track)
        case SetTrajectory():
            return _follow(subject, operation.trajectory)
        case Duplicate():
            return _duplicate(state, subject, operation)
        case Delete():
            gone = replace(subject, deleted=True)
            return _Change(gone, Restore(object_id=subject.object_id))
        case _:
            assert_never(operation)


def _known(state: ScenarioState, object_id: str) -> ObjectState:
    found = state.objects.get(object_id)
    if found is None:
        known = ", ".join(o.object_id for o in state.visible) or "none"
        raise EditError(
            ErrorCode.UNKNOWN_OBJECT,
            f"there is no object {object_id!r}",
            hint=f"objects of this scenario: {known}",
        )
    return found


def _existing(state: ScenarioState, object_id: str) -> ObjectState:
    found = _known(state, object_id)
    if found.deleted:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"object {object_id!r} is deleted",
            hint=f"bring it back with restore of {object_id!r} first",
        )
    return found


def _restore(state: ScenarioState, operation: Restore) -> _Change:
    found = _known(state, operation.object_id)
    if not found.deleted:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"object {operation.object_id!r} is not deleted",
            hint="leave the restore out",
        )
    return _Change(replace(found, deleted=False), Delete(object_id=operation.object_id))


def _translate(subject: ObjectState, operation: Translate) -> _Change:
    shift = (operation.x, operation.y, operation.z)
    moved = _shifted(subject.trajectory, shift, operation.frame)
    inverse = operation.model_copy(update={k: -v for k, v in zip("xyz", shift, strict=True)})
    return _Change(replace(subject, trajectory=moved), inverse)


def _rotate(subject: ObjectState, operation: Rotate) -> _Change:
    axis = np.array(operation.axis) / np.linalg.norm(operation.axis)
    half = operation.angle / 2
    turn = np.array([np.cos(half), *(np.sin(half) * axis)])
    old = subject.trajectory
    if operation.frame == "world":
        quaternions = multiply_quaternions(turn, old.quaternions)
    else:
        quaternions = multiply_quaternions(old.quaternions, turn)
    turned = Trajectory(old.times_us, old.positions, quaternions)
    inverse = operation.model_copy(update={"angle": -operation.angle})
    return _Change(replace(subject, trajectory=turned), inverse)


def _scale(subject: ObjectState, operation: Scale) -> _Change:
    factors = (operation.x, operation.y, operation.z)
    a, b, c = subject.scale
    scale = (a * operation.x, b * operation.y, c * operation.z)
    lowest, highest = SCALE_RANGE
    if min(scale) < lowest or max(scale) > highest:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"scalings together would be {scale}; {lowest:g} to {highest:g} is allowed",
            hint="scale by factors nearer to 1",
        )
    scaled = replace(subject, scale=scale)
    if operation.anchor == "bottom":
        # The origin is the box centre, so a bottom that stays lifts it by half the growth.
        lift = (scaled.scaled_size[2] - subject.scaled_size[2]) / 2
        raised = _shifted(subject.trajectory, (0.0, 0.0, lift), "object")
        scaled = replace(scaled, trajectory=raised)
    inverse = operation.model_copy(update={k: 1 / v for k, v in zip("xyz", factors, strict=True)})
    return _Change(scaled, inverse)


def _standing(pose: Pose, time_range: tuple[int, int]) -> Track:
    times = sorted(set(time_range))
    return Track(
        times_us=times,
        positions=[pose.position] * len(times),
        quaternions=[pose.quaternion] * len(times),
    )


def _follow(subject: ObjectState, track: Track) -> _Change:
    old = subject.trajectory
    trajectory = Trajectory(
        np.array(track.times_us, dtype=np.int64),
        np.array(track.positions, dtype=np.float64),
        np.array(track.quaternions, dtype=np.float64),
    )
    inverse = SetTrajectory(object_id=subject.object_id, trajectory=_track(old))
    return _Change(replace(subject, trajectory=trajectory), inverse)


def _track(trajectory: Trajectory) -> Track:
    return Track(
        times_us=trajectory.times_us.tolist(),
        positions=trajectory.positions.tolist(),
        quaternions=trajectory.quaternions.tolist(),
    )


def _duplicate(state: ScenarioState, subject: ObjectState, operation: Duplicate) -> _Change:
    if state.next_instance_id > MAX_OBJECTS:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"the scenario has {len(state.objects)} objects, deleted ones included, the most "
            "that instance images can tell apart",
            hint="start from a new scenario",
        )
    new_id = operation.new_id or _free_copy_id(state, subject.object_id)
    if new_id in state.objects:
        deleted = " (deleted; its id stays reserved)" if state.objects[new_id].deleted else ""
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"the id {new_id!r} is taken{deleted}",
            hint="give another new_id, or none to get the next free one",
        )
    copy = replace(
        subject,
        object_id=new_id,
        instance_id=state.next_instance_id,
        trajectory=_shifted(
            subject.trajectory, (operation.x, operation.y, operation.z), operation.frame
        ),
    )
    return _Change(copy, Delete(object_id=new_id), created=True)


def _free_copy_id(state: ScenarioState, object_id: str) -> str:
    n = 1
    while (new_id := f"{object_id}_copy{n}") in state.objects:
        n += 1
    if len(new_id) > MAX_ID_LENGTH:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"the copy's id {new_id!r} would be longer than {MAX_ID_LENGTH} characters",
            hint="give a shorter new_id",
        )
    return new_id


def _shifted(trajectory: Trajectory, shift: tuple[float, float, float], frame: Frame) -> Trajectory:
    offset: Float = np.array(shift)
    if frame == "object":
        offset = quaternion_to_matrix(trajectory.quaternions) @ offset
    positions = trajectory.positions + offset
    if np.abs(positions).max() > MAX_COORDINATE:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"the object would be {np.abs(positions).max():.6g} m away from the origin; "
            f"{MAX_COORDINATE:g} m is allowed",
            hint="shift it by less",
        )
    return Trajectory(trajectory.times_us, positions, trajectory.quaternions)
