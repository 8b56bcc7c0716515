"""Operations on what objects are for the physics, on the background, on the clock and on what
happens."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from real2sim_proto.operations import (
    AddCollider,
    Delete,
    EraseRegion,
    MeshShape,
    SetGait,
    SetPhysics,
    SetStoryboard,
    SetTime,
    SetVelocity,
)

from ..physics.colliders import TriangleSurface
from ..physics.errors import ColliderError
from .operation import (
    AppliedOperation,
    invalid_operation,
    new_id,
    object_changed,
    object_operation,
    operation,
)
from .state import ObjectState, ScenarioState

PEOPLE = frozenset({"pedestrian", "person"})
"""Categories of scenes' objects that may be walking bodies."""


@object_operation(SetPhysics)
def set_physics(
    state: ScenarioState, subject: ObjectState, operation: SetPhysics
) -> AppliedOperation:
    """Say what an object is; defaults for what is left out."""
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
    """Say how fast an object enters the physics."""
    inverse = subject.velocity or SetVelocity(object_id=subject.object_id)
    return object_changed(
        state,
        replace(subject, velocity=operation),
        inverse.model_copy(update={"object_id": subject.object_id}),
    )


@object_operation(SetGait)
def set_gait(state: ScenarioState, subject: ObjectState, operation: SetGait) -> AppliedOperation:
    """Say how a person walks."""
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
    """Hide what the background shows in a box."""
    region_id = new_id(state, operation.region_id, "region_")
    named = operation.model_copy(update={"region_id": region_id})
    regions = MappingProxyType(dict(state.regions) | {region_id: named})
    after = replace(state, regions=regions)
    return AppliedOperation(after, Delete(object_id=region_id), created=region_id)


@operation(AddCollider)
def add_collider(state: ScenarioState, operation: AddCollider) -> AppliedOperation:
    """Add what does not yield."""
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
    """Set the span in which the scenario plays."""
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
    """Set what happens in episodes; whether they can run it shows when one begins."""
    after = replace(state, storyboard=operation.storyboard)
    return AppliedOperation(after, SetStoryboard(storyboard=state.storyboard))
