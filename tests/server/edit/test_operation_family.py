"""The contract of edit operations, for all built-in ones and one defined here."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import pytest

from real2sim_proto.base import Model, Pose, Track
from real2sim_proto.operations import (
    AddCollider,
    Delete,
    Duplicate,
    EraseRegion,
    Insert,
    Operation,
    PlaneShape,
    Replace,
    Restore,
    Retime,
    Rotate,
    Scale,
    SetGait,
    SetPhysics,
    SetPose,
    SetStoryboard,
    SetTime,
    SetTrajectory,
    SetVelocity,
    Spawn,
    Translate,
)
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import EditError, ScenarioState, apply_operations
from real2sim_server.edit.motion import APPLY, AppliedOperation, object_changed, object_operation
from real2sim_server.scene import Trajectory

POSE = Pose(position=(3.0, 1.0, 0.8))


class Mirror(Model):
    """Mirror an object's path at the x axis of the world."""

    op: Literal["mirror"] = "mirror"
    object_id: str


def apply_mirror(state: ScenarioState, subject: Any, operation: Mirror) -> AppliedOperation:
    track = subject.trajectory
    w, x, y, z = track.quaternions.T
    mirrored = Trajectory(
        track.times_us,
        track.positions * [1.0, -1.0, 1.0],
        np.stack([w, -x, y, -z], axis=1),
    )
    return object_changed(state, replace(subject, trajectory=mirrored, edited=True), operation)


def examples(state: ScenarioState) -> list[Any]:
    """One operation of each kind that can be applied to a state."""
    car, other = list(state.objects)[:2]
    first, last = state.time_range
    places, level = [(0, 0, 1), (5, 0, 1)], [(1, 0, 0, 0)] * 2
    track = Track(times_us=[first, last], positions=places, quaternions=level)
    return [
        Translate(object_id=car, x=1.0),
        Rotate(object_id=car, angle=0.2),
        Scale(object_id=car, x=1.1),
        SetPose(object_id=car, pose=POSE),
        SetTrajectory(object_id=car, trajectory=track),
        Retime(object_id=car, delay_us=1000),
        Duplicate(object_id=car, y=5.0),
        Delete(object_id=car),
        Replace(object_id=car, recorded_id=other),
        EraseRegion(pose=POSE, size=(1.0, 1.0, 1.0)),
        SetPhysics(object_id=car, mass=900.0),
        SetVelocity(object_id=car, linear=(1.0, 0.0, 0.0)),
        AddCollider(shape=PlaneShape(point=(0.0, 0.0, 0.0))),
        SetTime(start_us=first, end_us=last - 1),
        SetStoryboard(storyboard=Storyboard(entities=[{"name": "Ego", "kind": "ego"}])),
        Mirror(object_id=car),
    ]


NEEDS_MORE = {Restore, Insert, Spawn, SetGait}
"""A deleted object, an asset library, a driver, a person: tested with what they need elsewhere."""


@pytest.fixture
def state(summary, monkeypatch) -> ScenarioState:
    monkeypatch.setitem(APPLY, Mirror, None)
    object_operation(Mirror)(apply_mirror)
    return ScenarioState.of(summary)


def described(state: ScenarioState) -> list[Any]:
    """What an inverse must restore, without ids that stay reserved."""
    return [
        [
            (o.object_id, o.scale, o.source_id, o.trajectory.times_us.tolist(), o.deleted)
            for o in state.objects.values()
            if not o.deleted
        ],
        state.erased,
        state.standing_colliders,
        state.clock,
        state.storyboard,
    ]


def test_every_operation_of_the_protocol_is_registered():
    union, _ = get_args(Operation)

    assert set(get_args(union)) == set(APPLY)


def test_there_is_an_example_of_every_operation(state):
    assert {type(o) for o in examples(state)} == set(APPLY) - NEEDS_MORE


@pytest.mark.parametrize("index", range(16))
def test_an_operation_makes_a_new_state_and_leaves_the_old_one_unchanged(state, index):
    before = described(state)
    after = apply_operations(state, [examples(state)[index]]).state

    assert after is not state
    assert described(state) == before


@pytest.mark.parametrize("index", range(16))
def test_the_inverse_undoes_an_operation(state, index):
    outcome = apply_operations(state, [examples(state)[index]])
    back = apply_operations(outcome.state, outcome.inverse).state

    assert described(back) == described(state)
    for name, subject in state.objects.items():
        found = back.objects[name].trajectory
        np.testing.assert_allclose(found.positions, subject.trajectory.positions, atol=1e-9)


@pytest.mark.parametrize("index", range(15))
def test_an_operation_on_an_unknown_object_is_refused_with_its_location(state, index):
    example = examples(state)[index]
    if not hasattr(example, "object_id"):
        pytest.skip("names no object")
    unknown = example.model_copy(update={"object_id": "nobody"})
    with pytest.raises(EditError, match="operation 0") as caught:
        apply_operations(state, [unknown])

    assert caught.value.index == 0
