"""Operations on objects, their appearance and physics, the background and the clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.operations import (
    AddCollider,
    Delete,
    Duplicate,
    EraseRegion,
    Insert,
    MeshShape,
    Replace,
    Restore,
    SetGait,
    SetPhysics,
    SetStoryboard,
    SetTime,
    SetVelocity,
    Spawn,
)

from ..physics.colliders import TriangleSurface
from ..physics.errors import ColliderError
from ..scene.scene import MAX_OBJECTS
from .motion import (
    AppliedOperation,
    invalid_operation,
    new_id,
    object_changed,
    object_operation,
    operation,
    require_object,
    rescaled,
    shifted,
    snap_to_ground,
    stationary_track,
    straight_on,
    trajectory_of,
)
from .state import AssetSource, EditError, ObjectState, ScenarioState


@object_operation(Duplicate)
def duplicate(state: ScenarioState, subject: ObjectState, operation: Duplicate) -> AppliedOperation:
    """Add a shifted copy of an object."""
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
    """Add a moving road user; its initial trajectory is straight."""
    _require_free_instance_id(state)
    appearance = _appearance(state, operation)
    if operation.pose is None:
        raise invalid_operation(
            "a position relative to the ego's route is only allowed in a running session",
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
    """Replace the appearance of an object; the centre of its box's bottom stays in place."""
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
    """Delete an object, region or collider; a tombstone reserves its id."""
    target, inverse = operation.object_id, Restore(object_id=operation.object_id)
    if target in state.regions or target in state.colliders:
        if target in state.tombstones:
            raise invalid_operation(f"{target!r} is deleted already", hint="leave the delete out")
        return AppliedOperation(replace(state, tombstones=state.tombstones | {target}), inverse)
    return object_changed(state, replace(require_object(state, target), deleted=True), inverse)


@operation(Restore)
def restore(state: ScenarioState, operation: Restore) -> AppliedOperation:
    """Restore a deleted object, region or collider."""
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


# --- Physics, background and clock ---------------------------------------------------------------

PEOPLE = frozenset({"pedestrian", "person"})
"""Categories of scene objects that may be walking people."""


@object_operation(SetPhysics)
def set_physics(
    state: ScenarioState, subject: ObjectState, operation: SetPhysics
) -> AppliedOperation:
    """Set physical properties of an object; omitted ones return to their defaults."""
    inverse = subject.physics or SetPhysics(object_id=subject.object_id)
    return object_changed(
        state,
        replace(subject, physics=operation),
        inverse.model_copy(update={"object_id": subject.object_id}),
    )


@object_operation(SetVelocity)
def set_velocity(
    state: ScenarioState, subject: ObjectState, operation: SetVelocity
) -> AppliedOperation:
    """Set the initial velocity of an object in the physics."""
    inverse = subject.velocity or SetVelocity(object_id=subject.object_id)
    return object_changed(
        state,
        replace(subject, velocity=operation),
        inverse.model_copy(update={"object_id": subject.object_id}),
    )


@object_operation(SetGait)
def set_gait(state: ScenarioState, subject: ObjectState, operation: SetGait) -> AppliedOperation:
    """Set the gait of a walking person."""
    walks = subject.asset.figure is not None if subject.asset else subject.category in PEOPLE
    if not walks:
        raise invalid_operation(
            f"{subject.object_id!r} is a {subject.category} and does not walk",
            hint="set_gait is for people of the body model: POST /v1/assets with a build makes one",
        )
    inverse = subject.gait or SetGait(object_id=subject.object_id)
    return object_changed(
        state,
        replace(subject, gait=operation),
        inverse.model_copy(update={"object_id": subject.object_id}),
    )


@operation(EraseRegion)
def erase_region(state: ScenarioState, operation: EraseRegion) -> AppliedOperation:
    """Hide the background in a box."""
    region_id = new_id(state, operation.region_id, "region_")
    named = operation.model_copy(update={"region_id": region_id})
    regions = MappingProxyType(dict(state.regions) | {region_id: named})
    after = replace(state, regions=regions)
    return AppliedOperation(after, Delete(object_id=region_id), created=region_id)


@operation(AddCollider)
def add_collider(state: ScenarioState, operation: AddCollider) -> AppliedOperation:
    """Add a fixed obstacle."""
    if isinstance(operation.shape, MeshShape):
        mesh = operation.shape
        try:
            TriangleSurface(mesh.vertices, mesh.triangles, mesh.thickness)
        except ColliderError as problem:
            raise invalid_operation(
                str(problem),
                hint="triangles list vertices counter-clockwise seen from outside; a sheet needs a "
                "thickness",
            ) from problem
    collider_id = new_id(state, operation.collider_id, "collider_")
    named = operation.model_copy(update={"collider_id": collider_id})
    colliders = MappingProxyType(dict(state.colliders) | {collider_id: named})
    after = replace(state, colliders=colliders)
    return AppliedOperation(after, Delete(object_id=collider_id), created=collider_id)


@operation(SetTime)
def set_time(state: ScenarioState, operation: SetTime) -> AppliedOperation:
    """Set the time span of the scenario."""
    first, last = state.time_range
    start = first if operation.start_us is None else operation.start_us
    end = last if operation.end_us is None else operation.end_us
    if not first <= start < end <= last and (start, end) != (first, last):
        raise invalid_operation(
            f"the scenario would play from {start} to {end} us; the recording has {first} to "
            f"{last} us",
            hint="choose start_us before end_us, both within the recording",
        )
    inverse = SetTime(start_us=state.clock[0], end_us=state.clock[1])
    if state.clock[0] >= state.clock[1]:
        inverse = SetTime()
    return AppliedOperation(replace(state, clock=(start, end)), inverse)


@operation(SetStoryboard)
def set_storyboard(state: ScenarioState, operation: SetStoryboard) -> AppliedOperation:
    """Set the storyboard of episodes; it is validated when an episode starts."""
    after = replace(state, storyboard=operation.storyboard)
    return AppliedOperation(after, SetStoryboard(storyboard=state.storyboard))
