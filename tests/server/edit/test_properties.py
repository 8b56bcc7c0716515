from __future__ import annotations

import pytest

from real2sim_proto.operations import (
    AddCollider,
    BoxShape,
    Duplicate,
    SetPhysics,
    SetTime,
    SetVelocity,
)
from real2sim_server.edit import EditError, apply_operations


def test_omitted_physics_values_return_to_their_defaults(state):
    heavy = SetPhysics(object_id="parked", mass=2000, friction=0.4)
    slippery = SetPhysics(object_id="parked", friction=0.1)
    after = apply_operations(state, [heavy, slippery]).state.objects["parked"]

    assert (after.physics.mass, after.physics.friction) == (None, 0.1)


def test_the_inverse_of_set_physics_restores_the_previous_values(state):
    heavy = SetPhysics(object_id="parked", mass=2000)
    outcome = apply_operations(state, [heavy, SetPhysics(object_id="parked", mass=10)])

    assert outcome.inverse == (heavy, SetPhysics(object_id="parked"))


def test_a_copy_inherits_physics_and_velocity(state):
    fast = SetVelocity(object_id="parked", linear=(9, 0, 0))
    heavy = SetPhysics(object_id="parked", mass=2000)
    copy = Duplicate(object_id="parked", new_id="twin", y=9)
    twin = apply_operations(state, [fast, heavy, copy]).state.objects["twin"]

    assert (twin.velocity.linear, twin.physics.mass) == ((9, 0, 0), 2000)


def test_the_inverse_of_a_copys_physics_refers_to_the_copy(state):
    heavy = SetPhysics(object_id="parked", mass=2000)
    copied = apply_operations(state, [heavy, Duplicate(object_id="parked", new_id="twin")]).state
    outcome = apply_operations(copied, [SetPhysics(object_id="twin")])

    assert outcome.inverse == (SetPhysics(object_id="twin", mass=2000),)


def test_a_collider_gets_an_id(state):
    wall = AddCollider(shape=BoxShape(position=(1, 2, 3), size=(4, 1, 2)), friction=0.5)
    outcome = apply_operations(state, [wall, wall])

    assert outcome.created == ("collider_1", "collider_2")
    assert [c.collider_id for c in outcome.state.standing_colliders] == list(outcome.created)


def test_the_clock_is_set_within_the_recording(state):
    outcome = apply_operations(state, [SetTime(start_us=1_000_000)])

    assert outcome.state.clock == (1_000_000, 4_900_000)
    assert apply_operations(outcome.state, outcome.inverse).state.clock == state.clock


@pytest.mark.parametrize("span", [{"start_us": -1}, {"end_us": 9_000_000}])
def test_the_clock_cannot_leave_the_recording(state, span):
    with pytest.raises(EditError, match="the recording has 0 to 4900000 us"):
        apply_operations(state, [SetTime(**span)])
