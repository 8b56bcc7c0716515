from __future__ import annotations

import dataclasses

import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Delete, Duplicate, Translate
from real2sim_server.edit import EditError, Scenario
from real2sim_server.edit.scenario import KEPT_STATES

SHIFT = [Translate(object_id="parked", x=1)]


def test_every_entry_increases_the_revision_by_one(state):
    scenario = Scenario(state, scene="street", scene_hash="abc")
    scenario.edit(SHIFT)
    scenario.undo()
    scenario.redo()

    assert [(e.revision, e.kind, e.target) for e in scenario.entries] == [
        (1, "edit", None),
        (2, "undo", 1),
        (3, "redo", 1),
    ]
    assert scenario.revision == 3


def test_undo_returns_the_previous_state_object(state):
    scenario = Scenario(state)
    scenario.edit(SHIFT)

    assert scenario.undo().state is state
    assert not scenario.can_undo
    assert scenario.can_redo


def test_a_new_edit_after_an_undo_clears_redo(state):
    scenario = Scenario(state)
    scenario.edit(SHIFT)
    scenario.undo()
    scenario.edit([Delete(object_id="late")])

    assert not scenario.can_redo
    with pytest.raises(EditError) as refused:
        scenario.redo()
    assert refused.value.code == ErrorCode.NOTHING_TO_REDO


def test_undo_without_an_edit_is_refused(state):
    with pytest.raises(EditError) as refused:
        Scenario(state).undo()

    assert refused.value.code == ErrorCode.NOTHING_TO_UNDO


def test_a_dry_run_responds_and_changes_nothing(state):
    scenario = Scenario(state)
    outcome = scenario.edit([Duplicate(object_id="parked")], dry_run=True)

    assert outcome.created == ("parked_copy1",)
    assert scenario.state is state
    assert scenario.entries == []


def test_planning_alone_changes_nothing(state):
    scenario = Scenario(state)
    planned = scenario.plan_edit(SHIFT)
    assert scenario.revision == 0

    scenario.commit(planned)
    assert scenario.state is planned.outcome.state
    assert scenario.entries == [planned.entry]


def test_a_plan_made_stale_by_another_commit_is_refused(state):
    scenario = Scenario(state)
    first, second = scenario.plan_edit(SHIFT), scenario.plan_edit(SHIFT)
    scenario.commit(first)

    with pytest.raises(EditError) as refused:
        scenario.commit(second)

    assert refused.value.code == ErrorCode.STALE_REVISION
    assert scenario.state is first.outcome.state


@pytest.mark.parametrize("call", ["plan_undo", "plan_redo", "plan_edit"])
def test_a_stale_base_revision_is_refused(state, call):
    scenario = Scenario(state)
    scenario.edit(SHIFT)
    arguments = [SHIFT] if call == "plan_edit" else []

    with pytest.raises(EditError, match="made for revision 0; the scenario is at 1") as refused:
        getattr(scenario, call)(*arguments, base_revision=0)

    assert refused.value.code == ErrorCode.STALE_REVISION


def test_the_inverse_of_an_undo_is_the_edit(state):
    scenario = Scenario(state)
    edited = scenario.edit(SHIFT)
    undone = scenario.undo()

    assert undone.inverse == tuple(SHIFT)
    again = scenario.edit(undone.inverse).state.objects["parked"].trajectory.positions
    assert again.tobytes() == edited.state.objects["parked"].trajectory.positions.tobytes()


def test_undo_reaches_beyond_the_states_kept_in_memory(state):
    scenario = Scenario(state)
    seen = [state]
    for _ in range(2 * KEPT_STATES):
        seen.append(scenario.edit(SHIFT).state)

    for expected in reversed(seen[:-1]):
        positions = scenario.undo().state.objects["parked"].trajectory.positions
        assert positions.tobytes() == expected.objects["parked"].trajectory.positions.tobytes()


def test_states_kept_for_undo_take_little_memory(state):
    scenario = Scenario(state)
    first = scenario.edit(SHIFT).state
    assert first.tracks.objects
    scenario.edit(SHIFT)

    assert "tracks" not in vars(first)
    assert first.tracks.at(0).objects


def test_edits_undone_and_replaced_leave_no_trace_in_the_state(state):
    scenario = Scenario(state)
    scenario.edit(SHIFT)
    scenario.edit([Duplicate(object_id="late")])
    scenario.undo()
    scenario.undo()
    scenario.edit([Delete(object_id="parked")])
    scenario.edit([Translate(object_id="late", y=1)])
    scenario.undo()

    assert [o.object_id for o in scenario.state.visible] == ["crossing", "turning", "late"]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"revision": 3}, ErrorCode.STALE_REVISION),
        ({"kind": "undo", "target": 7}, ErrorCode.INVALID_OPERATION),
        ({"kind": "redo", "target": 1}, ErrorCode.INVALID_OPERATION),
    ],
)
def test_a_broken_log_is_refused(state, change, code):
    scenario = Scenario(state)
    scenario.edit(SHIFT)
    scenario.edit(SHIFT)
    first, second = scenario.entries

    with pytest.raises(EditError) as refused:
        Scenario.replay(state, [first, dataclasses.replace(second, **change)])

    assert refused.value.code == code
