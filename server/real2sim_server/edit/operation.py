"""The family of edit operations: how each is applied, registered for its model of the wire."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.base import Track
from real2sim_proto.operations import Operation

from ..scene import Trajectory
from .errors import EditError
from .state import ObjectState, ScenarioState

MAX_ID_LENGTH = 80


@dataclass(frozen=True, eq=False)
class AppliedOperation:
    """What one operation leads to.

    Attributes:
        state: after it.
        inverse: takes it back.
        touched: id of the object that a person should look at; None where there is none.
        created: id of what is new; None where nothing is.
    """

    state: ScenarioState
    inverse: Operation
    touched: str | None = None
    created: str | None = None


Apply = Callable[[ScenarioState, Any], AppliedOperation]
"""``apply(state, operation)``: pure; raises EditError or SceneError where it cannot be done."""

ApplyToObject = Callable[[ScenarioState, ObjectState, Any], AppliedOperation]
"""``apply(state, subject, operation)``, for the object that ``operation.object_id`` names."""

APPLY: dict[type[Any], Apply] = {}
"""By the model of the wire, see :mod:`real2sim_proto.operations`."""


def operation(model: type[Any]) -> Callable[[Apply], Apply]:
    """Register how operations of a model are applied."""

    def register(apply: Apply) -> Apply:
        APPLY[model] = apply
        return apply

    return register


def object_operation(model: type[Any]) -> Callable[[ApplyToObject], ApplyToObject]:
    """Register how operations of a model are applied to the object that they name.

    The object exists and is not deleted; else the operation raises as :func:`require_object`.
    """

    def register(apply: ApplyToObject) -> ApplyToObject:
        def to_object(state: ScenarioState, operation: Any) -> AppliedOperation:
            return apply(state, require_object(state, operation.object_id), operation)

        APPLY[model] = to_object
        return apply

    return register


def apply_operation(state: ScenarioState, operation: Operation) -> AppliedOperation:
    """The state after one operation. Raises EditError or SceneError as the operation does."""
    return APPLY[type(operation)](state, operation)


def object_changed(
    state: ScenarioState, subject: ObjectState, inverse: Operation
) -> AppliedOperation:
    """The change that puts ``subject`` in the place of the object of its id."""
    return AppliedOperation(state.with_object(subject), inverse, touched=subject.object_id)


def invalid_operation(message: str, *, hint: str | None = None) -> EditError:
    """An INVALID_OPERATION."""
    return EditError(ErrorCode.INVALID_OPERATION, message, hint=hint)


def require_object(state: ScenarioState, object_id: str) -> ObjectState:
    """The object of that id. Raises EditError: UNKNOWN_OBJECT, or INVALID_OPERATION if deleted."""
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
    """The id ``wanted``, or the first free one of ``stem`` with a number.

    Raises:
        EditError: INVALID_OPERATION when it is taken, or would be too long.
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
    """A trajectory as operations carry it."""
    return Track(
        times_us=trajectory.times_us.tolist(),
        positions=trajectory.positions.tolist(),
        quaternions=trajectory.quaternions.tolist(),
    )


def trajectory_of(track: Track) -> Trajectory:
    """The trajectory an operation carries. Raises SceneError when it is none."""
    return Trajectory(
        np.array(track.times_us, dtype=np.int64),
        np.array(track.positions, dtype=np.float64),
        np.array(track.quaternions, dtype=np.float64),
    )
