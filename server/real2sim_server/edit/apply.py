"""Batches of operations onto a state: pure, atomic, with their inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Operation, subject_of
from real2sim_proto.scenarios import EditWarning

from ..scene import SceneError
from . import lifecycle, motion, properties
from .errors import EditError
from .operation import AppliedOperation, apply_operation
from .state import ScenarioState
from .validation import validate_edit

OPERATION_MODULES = (lifecycle, motion, properties)
"""Importing them registers their operations, see :mod:`.operation`."""

MAX_OBJECTS = 4096
"""Objects of a scenario, without deleted ones; streets have some hundreds."""


@dataclass(frozen=True, eq=False)
class EditOutcome:
    """What a batch of operations leads to.

    Attributes:
        state: after all operations.
        created: ids of new objects, regions and colliders, in order.
        inverse: operations that take the batch back when applied in this order. Numbers come back
            to within rounding; `Scenario.undo` brings back the exact state.
        warnings: what a person should look at.
    """

    state: ScenarioState
    created: tuple[str, ...]
    inverse: tuple[Operation, ...]
    warnings: tuple[EditWarning, ...]


def apply_operations(state: ScenarioState, operations: Sequence[Operation]) -> EditOutcome:
    """All of ``operations`` in order, or none of them.

    Args:
        state: left as it is.
        operations: validated wire models.

    Raises:
        EditError: UNKNOWN_OBJECT, UNKNOWN_ASSET or INVALID_OPERATION, naming the place in the
            batch; also for more than MAX_OBJECTS objects.
    """
    changes: list[AppliedOperation] = []
    after = state
    for index, operation in enumerate(operations):
        change = _apply_one(after, operation, index)
        after = change.state
        if change.created is not None:
            _check_number(after, operation, index)
        changes.append(change)
    touched = dict.fromkeys(c.touched for c in changes if c.touched is not None)
    return EditOutcome(
        state=after,
        created=tuple(c.created for c in changes if c.created is not None),
        inverse=tuple(c.inverse for c in reversed(changes)),
        warnings=tuple(validate_edit(after, tuple(touched))),
    )


def replay_operations(state: ScenarioState, operations: Sequence[Operation]) -> ScenarioState:
    """The state of :func:`apply_operations` alone, for replaying a log. Raises like it."""
    for index, operation in enumerate(operations):
        state = _apply_one(state, operation, index).state
    return state


def _apply_one(state: ScenarioState, operation: Operation, index: int) -> AppliedOperation:
    try:
        return apply_operation(state, operation)
    except EditError as error:
        where = f"operation {index} ({_named(operation)}): {error}"
        raise EditError(error.code, where, hint=error.hint, index=index) from None
    except SceneError as error:
        where = f"operation {index} ({_named(operation)}): {error}"
        raise EditError(ErrorCode.INVALID_OPERATION, where, index=index) from error


def _check_number(state: ScenarioState, operation: Operation, index: int) -> None:
    """Only of new edits: a log that went further is replayed as it is."""
    if len(state.objects) <= MAX_OBJECTS:
        return
    if sum(not found.deleted for found in state.objects.values()) > MAX_OBJECTS:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"operation {index}: a scenario has {MAX_OBJECTS} objects at most",
            hint="delete objects that are not needed",
            index=index,
        )


def _named(operation: Operation) -> str:
    subject = subject_of(operation)
    return f"{operation.op} of {subject!r}" if subject is not None else operation.op
