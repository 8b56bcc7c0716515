"""Properties that hold for any sequence of operations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import (
    OPERATION,
    AddCollider,
    BoxShape,
    Delete,
    Duplicate,
    EraseRegion,
    GroundShape,
    Insert,
    Operation,
    PlaneShape,
    Replace,
    Restore,
    Retime,
    Rotate,
    Scale,
    SetPhysics,
    SetPose,
    SetStoryboard,
    SetTime,
    SetTrajectory,
    SetVelocity,
    TimeRange,
    Translate,
    subject_of,
)
from real2sim_proto.storyboard import Entity, Storyboard
from real2sim_server.edit import (
    EditError,
    LogEntry,
    ObjectState,
    Scenario,
    ScenarioState,
    apply_operations,
    pack_state,
    unpack_state,
)

IDS = st.sampled_from(["parked", "crossing", "turning", "late", "parked_copy1"])
LENGTHS = st.floats(-300, 300)
FACTORS = st.floats(0.2, 5.0)
FRAMES = st.sampled_from(["world", "object"])
VECTORS = st.tuples(LENGTHS, LENGTHS, LENGTHS)
QUATERNIONS = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01)


def _unit(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    norm = sum(v * v for v in quaternion) ** 0.5
    return tuple(v / norm for v in quaternion)


POSES = st.builds(Pose, position=VECTORS, quaternion=QUATERNIONS.map(_unit))
TRACKS = st.lists(POSES, min_size=1, max_size=4).map(
    lambda poses: Track(
        times_us=[1_000_000 + 500_000 * i for i in range(len(poses))],
        positions=[p.position for p in poses],
        quaternions=[p.quaternion for p in poses],
    )
)
AXES = VECTORS.filter(lambda v: sum(a * a for a in v) > 1e-6)
SHIFTS = {"x": LENGTHS, "y": LENGTHS, "z": LENGTHS, "frame": FRAMES}
THINGS = st.one_of(IDS, st.sampled_from(["region_1", "collider_1", "van_1"]))
INSTANTS = st.one_of(st.none(), st.integers(-1_000_000, 6_000_000))
TIME_RANGES = st.one_of(
    st.none(),
    st.builds(
        lambda start, length, blend: TimeRange(
            start_us=start, end_us=None if start is None else start + length, blend_us=blend
        ),
        INSTANTS,
        st.integers(1, 6_000_000),
        st.sampled_from([0, 300_000, 2_000_000]),
    ),
)
SIZES = st.one_of(st.none(), st.tuples(*[st.floats(0.5, 20.0)] * 3))
SNAPS = st.booleans()
SPEEDS = st.one_of(st.none(), st.tuples(*[st.floats(-30, 30)] * 3))
SHAPES = st.sampled_from(
    [PlaneShape(point=(0, 0, 0)), BoxShape(position=(1, 2, 3), size=(1, 1, 1)), GroundShape()]
)

STORYBOARDS = st.sampled_from(
    [None, Storyboard(entities=[Entity(name="Ego", kind="ego")]), Storyboard(name="nobody")]
)

OPERATIONS: st.SearchStrategy[Operation] = st.one_of(
    st.builds(Translate, object_id=IDS, time_range=TIME_RANGES, snap=SNAPS, **SHIFTS),
    st.builds(
        Rotate,
        object_id=IDS,
        angle=st.floats(-7, 7),
        axis=AXES,
        frame=FRAMES,
        time_range=TIME_RANGES,
        snap=SNAPS,
    ),
    st.builds(
        Scale,
        object_id=IDS,
        x=FACTORS,
        y=FACTORS,
        z=FACTORS,
        anchor=st.sampled_from(["bottom", "centre"]),
    ),
    st.builds(SetPose, object_id=IDS, pose=POSES, snap=SNAPS),
    st.builds(SetTrajectory, object_id=IDS, trajectory=TRACKS, snap=SNAPS),
    st.builds(
        Retime,
        object_id=IDS,
        delay_us=st.integers(-3_000_000, 3_000_000),
        speed=st.floats(0.1, 10),
    ),
    st.builds(Duplicate, object_id=IDS, snap=SNAPS, **SHIFTS),
    st.builds(Delete, object_id=THINGS),
    st.builds(Restore, object_id=THINGS),
    st.builds(Insert, asset_id=st.just("van"), pose=POSES, size=SIZES, snap=SNAPS),
    st.builds(
        Replace, object_id=IDS, asset_id=st.just("van"), fit=st.sampled_from(["box", "length"])
    ),
    st.builds(Replace, object_id=IDS, recorded_id=st.just("late"), size=SIZES),
    st.builds(EraseRegion, pose=POSES, size=st.just((2.0, 3.0, 4.0))),
    st.builds(
        SetPhysics,
        object_id=IDS,
        mass=st.one_of(st.none(), st.floats(1, 1e5)),
        material=st.sampled_from([None, "metal", "foam"]),
        friction=st.one_of(st.none(), st.floats(0, 2)),
    ),
    st.builds(SetVelocity, object_id=IDS, linear=SPEEDS, angular=SPEEDS, frame=FRAMES),
    st.builds(AddCollider, shape=SHAPES),
    st.builds(
        lambda start, length: SetTime(
            start_us=start, end_us=None if start is None else start + length
        ),
        INSTANTS,
        st.integers(1, 3_000_000),
    ),
    st.builds(SetStoryboard, storyboard=STORYBOARDS),
)


@pytest.fixture(scope="session")
def state(state_with_assets: ScenarioState) -> ScenarioState:
    return state_with_assets


def possible(state: ScenarioState, operations: list[Operation]) -> list[Operation]:
    """The operations that can be applied in order, without those that would be refused."""
    kept: list[Operation] = []
    for operation in operations:
        try:
            state = apply_operations(state, [operation]).state
        except EditError:
            continue
        kept.append(operation)
    return kept


def same_bits(a: ScenarioState, b: ScenarioState) -> bool:
    return (
        list(a.objects) == list(b.objects)
        and (a.regions, a.colliders, a.tombstones) == (b.regions, b.colliders, b.tombstones)
        and (a.clock, a.storyboard) == (b.clock, b.storyboard)
        and a.next_instance_id == b.next_instance_id
        and all(
            _identity(a.objects[i]) == _identity(b.objects[i])
            and all(x.tobytes() == y.tobytes() for x, y in _arrays(a.objects[i], b.objects[i]))
            for i in a.objects
        )
    )


def assert_close(a: ObjectState, b: ObjectState, tolerance: float = 1e-9) -> None:
    """The same object within ``tolerance``; rotations q and -q are equal."""
    assert (a.object_id, a.source_id, a.size, a.instance_id, a.deleted, a.asset) == (
        (b.object_id, b.source_id, b.size, b.instance_id, b.deleted, b.asset)
    )
    nothing = SetPhysics(object_id=a.object_id)
    assert (a.physics or nothing) == (b.physics or nothing)
    usual = SetVelocity(object_id=a.object_id)
    assert (a.velocity or usual) == (b.velocity or usual)
    np.testing.assert_allclose(a.scale, b.scale, rtol=tolerance)
    np.testing.assert_array_equal(a.trajectory.times_us, b.trajectory.times_us)
    np.testing.assert_allclose(a.trajectory.positions, b.trajectory.positions, atol=tolerance)
    dots = np.abs(np.sum(a.trajectory.quaternions * b.trajectory.quaternions, axis=1))
    np.testing.assert_allclose(dots, 1, atol=tolerance)


def _identity(o: ObjectState) -> tuple[object, ...]:
    look = (o.source_id, o.asset, o.category, o.size, o.scale, o.edited)
    return (o.object_id, look, o.instance_id, o.deleted, o.physics, o.velocity)


def _arrays(a: ObjectState, b: ObjectState) -> list[tuple[np.ndarray, np.ndarray]]:
    s, t = a.trajectory, b.trajectory
    return [
        (s.times_us, t.times_us),
        (s.positions, t.positions),
        (s.quaternions, t.quaternions),
    ]


def stored_and_read_again(entry: LogEntry) -> LogEntry:
    texts = [OPERATION.dump_json(operation) for operation in entry.operations]
    return replace(entry, operations=tuple(OPERATION.validate_json(text) for text in texts))


ENOUGH = settings(max_examples=40, deadline=None)
BATCHES = st.lists(OPERATIONS, min_size=1, max_size=8)


@ENOUGH
@given(operations=BATCHES)
def test_inverse_operations_restore_every_object(state: ScenarioState, operations: list[Operation]):
    outcome = apply_operations(state, possible(state, operations))

    restored = apply_operations(outcome.state, outcome.inverse).state

    for object_id, before in state.objects.items():
        assert_close(restored.objects[object_id], before)
    assert all(i in restored.tombstones or restored.objects[i].deleted for i in outcome.created)
    assert (restored.erased, restored.standing_colliders) == ((), ())
    assert restored.clock == state.clock


@ENOUGH
@given(batches=st.lists(BATCHES, min_size=1, max_size=5))
def test_undoing_everything_restores_the_initial_state(
    state: ScenarioState, batches: list[list[Operation]]
):
    scenario = Scenario(state)
    for batch in batches:
        scenario.edit(possible(scenario.state, batch))

    while scenario.can_undo:
        scenario.undo()

    assert same_bits(scenario.state, state)


@ENOUGH
@given(batches=st.lists(BATCHES, min_size=1, max_size=4), moves=st.lists(st.booleans(), max_size=8))
def test_replaying_a_log_is_reproducible(
    state: ScenarioState, batches: list[list[Operation]], moves: list[bool]
):
    scenario = Scenario(state)
    for batch in batches:
        scenario.edit(possible(scenario.state, batch))
    for undo in moves:
        if undo and scenario.can_undo:
            scenario.undo()
        elif not undo and scenario.can_redo:
            scenario.redo()

    replayed = Scenario.replay(state, map(stored_and_read_again, scenario.entries))

    assert same_bits(replayed.state, scenario.state)
    assert (replayed.revision, replayed.can_undo, replayed.can_redo) == (
        (scenario.revision, scenario.can_undo, scenario.can_redo)
    )


@ENOUGH
@given(batches=st.lists(BATCHES, min_size=1, max_size=4), undos=st.integers(0, 2))
def test_replay_from_a_saved_state_equals_replay_of_the_whole_log(
    state: ScenarioState, batches: list[list[Operation]], undos: int
):
    scenario = Scenario(state)
    kept = [(0, pack_state(state))]
    for batch in batches:
        scenario.edit(possible(scenario.state, batch))
        kept.append((scenario.revision, pack_state(scenario.state)))
    for _ in range(min(undos, len(batches))):
        scenario.undo()
        kept.append((scenario.revision, pack_state(scenario.state)))

    for revision, packed in kept:
        known = (revision, unpack_state(state, packed))
        opened = Scenario.replay(state, scenario.entries, known=known)
        assert same_bits(opened.state, scenario.state)
        if undos:
            assert same_bits(opened.redo().state, Scenario.replay(state, opened.entries).state)


@ENOUGH
@given(operations=BATCHES)
def test_undo_then_redo_restores_the_identical_state(
    state: ScenarioState, operations: list[Operation]
):
    scenario = Scenario(state)
    edited = scenario.edit(possible(state, operations)).state

    scenario.undo()
    scenario.redo()

    assert same_bits(scenario.state, edited)


@ENOUGH
@given(operations=BATCHES, place=st.integers(0, 8))
def test_one_refused_operation_rejects_the_batch(
    state: ScenarioState, operations: list[Operation], place: int
):
    scenario = Scenario(state)
    batch = possible(state, operations)
    place = min(place, len(batch))
    batch.insert(place, Delete(object_id="nobody"))

    with pytest.raises(EditError) as refused:
        scenario.edit(batch)

    assert refused.value.index == place
    assert scenario.state is state
    assert scenario.revision == 0


@ENOUGH
@given(operations=BATCHES)
def test_untouched_objects_are_shared_not_copied(state: ScenarioState, operations: list[Operation]):
    batch = possible(state, operations)
    after = apply_operations(state, batch).state

    untouched = set(state.objects) - {subject_of(o) for o in batch}

    assert all(after.objects[i] is state.objects[i] for i in untouched)


@ENOUGH
@given(operations=BATCHES)
def test_instance_ids_stay_unique(state: ScenarioState, operations: list[Operation]):
    after = apply_operations(state, possible(state, operations)).state
    ids = [o.instance_id for o in after.objects.values()]

    assert len(set(ids)) == len(ids)
    assert all(after.objects[i].instance_id == o.instance_id for i, o in state.objects.items())
    assert after.next_instance_id == max(ids) + 1
