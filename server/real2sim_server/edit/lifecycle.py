"""Operations on what exists: copies, assets, tombstones, appearance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Delete, Duplicate, Insert, Replace, Restore, Spawn

from ..scene.scene import MAX_OBJECTS
from .errors import EditError
from .motion import rescaled, shifted, snap_to_ground, stationary_track, straight_on
from .operation import (
    AppliedOperation,
    invalid_operation,
    new_id,
    object_changed,
    object_operation,
    operation,
    require_object,
    trajectory_of,
)
from .state import AssetSource, ObjectState, ScenarioState


@object_operation(Duplicate)
def duplicate(state: ScenarioState, subject: ObjectState, operation: Duplicate) -> AppliedOperation:
    """Add a copy, shifted."""
    _require_free_instance_id(state)
    shift = (operation.x, operation.y, operation.z)
    trajectory = shifted(subject.trajectory, shift, operation.frame)
    if operation.snap:
        trajectory = snap_to_ground(trajectory, subject.scaled_size, state.ground)
    copy = replace(
        subject,
        object_id=new_id(state, operation.new_id, f"{subject.object_id}_copy"),
        instance_id=state.next_instance_id,
        trajectory=trajectory,
        edited=True,
    )
    return _added(state, copy)


@operation(Insert)
def insert(state: ScenarioState, operation: Insert) -> AppliedOperation:
    """Add an object that shows an asset."""
    _require_free_instance_id(state)
    asset = _asset(state, operation.asset_id)
    if operation.trajectory is not None:
        track = operation.trajectory
    else:
        assert operation.pose is not None  # the model has one of the two
        track = stationary_track(operation.pose, state.time_range)
    added = ObjectState(
        object_id=new_id(state, operation.object_id, f"{operation.asset_id}_"),
        source_id="",
        category=asset.category,
        size=asset.size,
        scale=(1.0, 1.0, 1.0),
        trajectory=trajectory_of(track),
        instance_id=state.next_instance_id,
        asset=asset,
        edited=True,
    )
    if operation.size is not None:
        added = rescaled(added, _fitting(operation.size, asset.size), keep_bottom=False)
    if operation.snap:
        on_ground = snap_to_ground(added.trajectory, added.scaled_size, state.ground)
        added = replace(added, trajectory=on_ground)
    return _added(state, added)


@operation(Spawn)
def spawn(state: ScenarioState, operation: Spawn) -> AppliedOperation:
    """Add a road user that drives; its own track goes straight on."""
    _require_free_instance_id(state)
    appearance = _appearance(state, operation)
    if operation.pose is None:
        raise invalid_operation(
            "a place beside the ego's route is known in a running session only",
            hint="give the pose of the box centre",
        )
    start_us = state.clock[0] if operation.start_us is None else operation.start_us
    added = ObjectState(
        object_id=new_id(state, operation.object_id, "spawned_"),
        source_id=appearance.source_id,
        category=appearance.category,
        size=appearance.size,
        scale=(1.0, 1.0, 1.0),
        trajectory=straight_on(operation.pose, operation.speed, start_us, state.time_range[1]),
        instance_id=state.next_instance_id,
        asset=appearance.asset,
        edited=True,
        driver=operation.driver,
    )
    if operation.snap:
        on_ground = snap_to_ground(added.trajectory, added.scaled_size, state.ground)
        added = replace(added, trajectory=on_ground)
    return _added(state, added)


@object_operation(Replace)
def replace_appearance(
    state: ScenarioState, subject: ObjectState, operation: Replace
) -> AppliedOperation:
    """Show something else in the box; the centre of its bottom stays where it is."""
    appearance = _appearance(state, operation)
    box = operation.size or subject.scaled_size
    factors = _fitting(box, appearance.size)
    if operation.fit == "length":
        factors = (factors[0],) * 3
    old_size = subject.scaled_size
    replaced = replace(
        subject,
        source_id=appearance.source_id,
        asset=appearance.asset,
        category=appearance.category,
        size=appearance.size,
        scale=_fitting(old_size, appearance.size),
        edited=True,
    )
    replaced = rescaled(replaced, factors, keep_bottom=True)
    inverse = Replace(
        object_id=subject.object_id,
        asset_id=subject.asset.asset_id if subject.asset else None,
        recorded_id=None if subject.asset else subject.source_id,
        size=old_size,
    )
    return object_changed(state, replaced, inverse)


@operation(Delete)
def delete(state: ScenarioState, operation: Delete) -> AppliedOperation:
    """Leave a tombstone."""
    target, inverse = operation.object_id, Restore(object_id=operation.object_id)
    if target in state.regions or target in state.colliders:
        if target in state.tombstones:
            raise invalid_operation(f"{target!r} is deleted already", hint="leave the delete out")
        return AppliedOperation(replace(state, tombstones=state.tombstones | {target}), inverse)
    return object_changed(state, replace(require_object(state, target), deleted=True), inverse)


@operation(Restore)
def restore(state: ScenarioState, operation: Restore) -> AppliedOperation:
    """Take a tombstone away."""
    target, inverse = operation.object_id, Delete(object_id=operation.object_id)
    if target in state.tombstones:
        return AppliedOperation(replace(state, tombstones=state.tombstones - {target}), inverse)
    found = state.objects.get(target)
    if found is None and not state.has_id(target):
        require_object(state, target)
    if found is None or not found.deleted:
        raise invalid_operation(f"{target!r} is not deleted", hint="leave the restore out")
    return object_changed(state, replace(found, deleted=False), inverse)


def _added(state: ScenarioState, added: ObjectState) -> AppliedOperation:
    return AppliedOperation(
        state.with_object(added),
        Delete(object_id=added.object_id),
        touched=added.object_id,
        created=added.object_id,
    )


def _require_free_instance_id(state: ScenarioState) -> None:
    if state.next_instance_id > MAX_OBJECTS:
        raise invalid_operation(
            f"the scenario has {len(state.objects)} objects, deleted ones included, the most "
            "that instance images can tell apart",
            hint="start from a new scenario",
        )


def _asset(state: ScenarioState, asset_id: str) -> AssetSource:
    found = state.assets(asset_id) if state.assets else None
    if found is None:
        raise EditError(
            ErrorCode.UNKNOWN_ASSET,
            f"there is no asset {asset_id!r} in the library",
            hint="GET /v1/assets lists them; POST /v1/assets adds one",
        )
    return found


@dataclass(frozen=True, eq=False)
class _Appearance:
    source_id: str
    category: str
    size: tuple[float, float, float]
    asset: AssetSource | None = None


def _appearance(state: ScenarioState, operation: Replace | Spawn) -> _Appearance:
    if operation.asset_id is not None:
        asset = _asset(state, operation.asset_id)
        return _Appearance("", asset.category, asset.size, asset)
    recorded: Mapping[str, Any] = state.recorded
    found = recorded.get(operation.recorded_id or "")
    if found is None:
        raise EditError(
            ErrorCode.UNKNOWN_OBJECT,
            f"the recording has no object {operation.recorded_id!r}",
            hint=f"it has: {', '.join(recorded) or 'none'}",
        )
    return _Appearance(found.source_id, found.category, found.size)


def _fitting(
    box: tuple[float, float, float], size: tuple[float, float, float]
) -> tuple[float, float, float]:
    x, y, z = (b / s for b, s in zip(box, size, strict=True))
    return (x, y, z)
