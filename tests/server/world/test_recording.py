"""Episode recordings: round trips, replay and rescoring."""

from __future__ import annotations

import contextlib
import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto import decode, encode
from real2sim_proto.episode import ActuatorSpec, ResetSpec
from real2sim_proto.operations import Delete, Translate
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.edit.apply import replay_operations
from real2sim_server.world import recording as recording_module
from real2sim_server.world.recording import (
    RecordingError,
    first_difference,
    load_recording,
    record,
    save_recording,
    to_bytes,
)
from real2sim_server.world.replay import (
    Entry,
    Replayer,
    action_payload,
    agent_payload,
    edit_payload,
    last_episode,
    name_payload,
    no_action_impact,
    reset_payload,
    stop_payload,
    stored_spec,
)

DRIVERS = {"car": {"kind": "external"}, "other": {"kind": "idm"}}


@pytest.fixture(scope="module")
def scene(make_scene, moving):
    return make_scene(
        car=moving(40, 3.5, z=0.8, speed=5.0),
        other=moving(12, 0, z=0.8, speed=8.0),
        parked=moving(70, 0.5, z=0.8),
    )


def plan_at(step: int) -> TrajectoryPlan:
    times = [5_000_000 + 100_000 * (step + k + 1) for k in range(10)]
    return TrajectoryPlan(times_us=times, poses=[(1.0 * (k + 1), 0.0, 0.0) for k in range(10)])


def entries(steps: int = 40, **spec) -> list[Entry]:
    """An episode with all kinds of entries: plans on time, late and missed, an edit, an agent plan,
    a snapshot and restore, and a wall-clock stop."""
    fields = {
        "on_collision": "continue",
        "agents": {"drivers": DRIVERS},
        "latency": {"model": "measured"},
    }
    log = [Entry("reset", 0, reset_payload(ResetSpec(**fields | spec)))]
    for step in range(steps):
        if step == 5:
            log.append(Entry("edit", step, edit_payload([Translate(object_id="parked", y=-0.5)])))
        if step == 8:
            payload = agent_payload("car", [6_500_000, 8_000_000], [(45, 3.5, 0), (50, 1.5, -0.2)])
            log.append(Entry("agent", step, payload))
        if step == 20:
            log.append(Entry("snapshot", step, name_payload("here")))
        plan = None if step % 7 == 3 else plan_at(step)
        payload = action_payload(plan, latency_us=30_000 * (step % 3), missed=step == 17)
        log.append(Entry("action", step, payload))
    log.append(Entry("restore", 20, name_payload("here")))
    log += [Entry("action", 20 + k, action_payload(None)) for k in range(15)]
    log.append(Entry("stop", 35, stop_payload("wall_clock")))
    return log


def fresh(scene) -> Replayer:
    return Replayer.on(scene, ScenarioState.of(scene))


@pytest.fixture(scope="module")
def recording(scene):
    return record(fresh(scene), entries(), scene_hash="abc", scenario=("sc_1", 3))


def test_a_recording_omits_instants_undone_by_a_restore(recording):
    assert [i.step for i in recording.instants] == list(range(36))
    assert (recording.scenario_id, recording.scenario_revision) == ("sc_1", 3)


def test_a_recording_round_trips(recording, tmp_path):
    path = save_recording(recording, tmp_path / "a" / "episode.r2e")
    again = load_recording(path)
    assert to_bytes(again) == to_bytes(recording)
    assert again.entries == recording.entries


def test_replay_reproduces_the_recording(recording, scene):
    assert first_difference(recording, fresh(scene)) is None


def test_a_scenario_episode_replays_from_the_file_alone(scene, tmp_path):
    moved = ScenarioState.of(scene)
    for operation in (Translate(object_id="other", x=3.0), Delete(object_id="parked")):
        moved = replay_operations(moved, [operation])
    log = [e for e in entries(8) if e.kind in {"reset", "action"}][:9]
    made = record(
        Replayer.on(scene, moved), log, scene_hash="abc", scenario=("sc_1", 3), state=moved
    )
    loaded = load_recording(save_recording(made, tmp_path / "episode.r2e"))
    assert first_difference(loaded, loaded.replayer(scene)) is None
    assert first_difference(loaded, fresh(scene)) == 0


def test_scenario_recordings_without_state_cannot_be_replayed(recording, scene):
    assert recording.state is None
    with pytest.raises(RecordingError, match="'sc_1' at revision 3, which is not in the file"):
        recording.replayer(scene)


def test_replay_on_another_scene_reports_the_first_difference(recording, make_scene, moving):
    other = make_scene(
        car=moving(40, 3.5, z=0.8, speed=5.0),
        other=moving(12, 0, z=0.8, speed=8.1),
        parked=moving(70, 0.5, z=0.8),
    )
    assert first_difference(recording, fresh(other)) == 0


def test_rescoring_a_file_reproduces_its_scores(recording, tmp_path):
    loaded = load_recording(save_recording(recording, tmp_path / "episode.r2e"))
    assert [s.fields() for s in loaded.rescore()] == list(recording.scores)
    assert len({s["name"] for s in recording.scores}) == len(recording.scores) >= 9


def test_equal_episodes_give_equal_files(recording, scene):
    again = record(fresh(scene), entries(), scene_hash="abc", scenario=("sc_1", 3))
    assert to_bytes(again) == to_bytes(recording)


@pytest.mark.parametrize("content", [b"", b"not a zip", None])
def test_files_that_are_not_recordings_are_refused(tmp_path, content):
    path = tmp_path / "episode.r2e"
    if content is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("episode.json", '{"format": "real2sim-episode", "version": 99}')
    else:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"recording|version 99"):
        load_recording(path)


def rewritten(path, recording, name, change):
    """Save the recording with ``change`` applied to one part."""
    parts = {}
    with zipfile.ZipFile(io.BytesIO(to_bytes(recording))) as archive:
        parts = {n: archive.read(n) for n in archive.namelist()}
    is_json = name.endswith(".json")
    fields = json.loads(parts[name]) if is_json else decode(parts[name])
    change(fields)
    parts[name] = json.dumps(fields).encode() if is_json else encode(fields)
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in parts.items():
            archive.writestr(entry, data)
    return path


def _put(key, value):
    return lambda fields: fields.__setitem__(key, value)


def _row(key, value):
    return lambda fields: fields["instants"][0].__setitem__(key, value)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("episode.json", _put("scene", 5)),
        ("episode.json", _put("scores", [1])),
        ("log.msgpack", _put("entries", [["reset", 0]])),
        ("log.msgpack", _put("entries", [["dance", 0, b""]])),
        ("instants.msgpack", _put("instants", [])),
        ("instants.msgpack", _row("ids", ["a"])),
        ("instants.msgpack", _row("ego", [0.0] * 3)),
        ("instants.msgpack", _row("yaws", np.full(3, np.nan))),
        ("instants.msgpack", _row("centres", np.zeros((3, 2)))),
        ("instants.msgpack", _row("step", 1.5)),
        ("instants.msgpack", _row("plan", [[2, 1], [[0, 0, 0]] * 2])),
        ("instants.msgpack", _row("contacts", [{"side": "above"}])),
        ("context.msgpack", _put("route", np.zeros((1, 2)))),
        ("context.msgpack", _put("route", np.array([[0.0, 0], [1e300, 0]]))),
        ("context.msgpack", _put("route", np.array([[0.0, 0], [1e9, 0]]))),
        ("context.msgpack", _put("horizon", 3)),
        ("context.msgpack", _put("dt", "soon")),
        ("context.msgpack", _put("ego_mass", 0.0)),
        ("context.msgpack", _put("lanes", [np.zeros((3, 1))])),
    ],
)
def test_damaged_parts_are_refused_with_the_file_name(recording, tmp_path, part, change):
    path = rewritten(tmp_path / "episode.r2e", recording, part, change)
    with pytest.raises(RecordingError, match=r"episode\.r2e"):
        load_recording(path)


def test_bit_flips_raise_only_recording_errors(recording, tmp_path):
    whole = to_bytes(recording)
    path = tmp_path / "episode.r2e"
    generator = np.random.default_rng(3)
    for place in generator.integers(0, len(whole), 150):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        with contextlib.suppress(RecordingError):
            load_recording(path).rescore()


def test_a_file_that_unpacks_beyond_the_limit_is_refused(recording, tmp_path, monkeypatch):
    path = save_recording(recording, tmp_path / "episode.r2e")
    monkeypatch.setattr(recording_module, "MAX_BYTES", 1000)
    with pytest.raises(RecordingError, match="allowed are 1000"):
        load_recording(path)


def test_an_entry_that_cannot_be_applied_is_named(recording, scene):
    broken = replace(recording, entries=(*recording.entries[:2], Entry("edit", 1, b"\x80")))
    with pytest.raises(RecordingError, match=r"entry 2 \(edit, step 1\) is damaged"):
        first_difference(broken, Replayer.on(scene, ScenarioState.of(scene)))


def earlier_spec(**ego) -> dict:
    """A complete spec as stored before trackers compensated actuator lag."""
    fields = decode(reset_payload(ResetSpec(ego=ego)))["spec"]
    del fields["ego"]["actuators"]["foreseen"]
    return fields


def test_an_old_log_keeps_its_actuators_without_foresight():
    lagging = {"steering_lag": 0.1, "drive_lag": 0.0}
    spec = stored_spec(earlier_spec(actuators=lagging))

    assert spec.ego.actuators == ActuatorSpec(**lagging, foreseen=False)


@pytest.mark.parametrize("fields", [{}, {"ego": {}}, {"ego": {"actuators": {}}}])
def test_a_log_without_actuators_has_ideal_ones(fields):
    assert stored_spec(fields).ego.actuators == ActuatorSpec(
        steering_lag=0.0, drive_lag=0.0, foreseen=False
    )


def test_a_current_spec_round_trips():
    spec = ResetSpec(ego={"actuators": {"steering_lag": 0.3}})

    assert stored_spec(decode(reset_payload(spec))["spec"]) == spec


def test_an_old_log_replays_identically(scene):
    ideal = {"tracker": "ilqr", "actuators": {"steering_lag": 0.0, "drive_lag": 0.0}}
    resets = encode({"spec": earlier_spec(**ideal)}), reset_payload(ResetSpec(ego=ideal))
    logs = [[Entry("reset", 0, reset), *entries(10)[1:5]] for reset in resets]
    then, now = (
        record(Replayer.on(scene, ScenarioState.of(scene)), log, scene_hash="x") for log in logs
    )

    assert then.digests == now.digests


def test_the_last_episode_starts_at_the_last_reset():
    log = entries(3)
    assert last_episode([*log, *log]) == log
    assert last_episode([]) == []


def test_no_action_impact_is_the_speed_into_a_parked_car(make_scene, moving):
    scene = make_scene(car=moving(60, 0, z=0.8))
    log = [Entry("reset", 0, reset_payload(ResetSpec(action="control")))]
    assert no_action_impact(fresh(scene), log) == pytest.approx(10.0, rel=0.01)
    log.append(Entry("edit", 0, edit_payload([Translate(object_id="car", y=8.0)])))
    assert no_action_impact(fresh(scene), log) == 0.0


def test_a_log_starts_with_a_reset(scene):
    with pytest.raises(ValueError, match="a reset comes first"):
        fresh(scene).apply(Entry("action", 0, action_payload(None)))


def as_written_before(recording):
    """The recording as an older version wrote it, without later context fields."""
    parts = {}
    with zipfile.ZipFile(io.BytesIO(to_bytes(recording))) as archive:
        for name in archive.namelist():
            parts[name] = archive.read(name)
    context = decode(parts["context.msgpack"])
    for name in ("warmup_steps", "background", "reactive"):
        del context[name]
    about = json.loads(parts["episode.json"]) | {"metrics": "pdms@1"}
    parts |= {"context.msgpack": encode(context), "episode.json": json.dumps(about).encode()}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return recording_module.recording_of_bytes(file.getvalue(), "old.r2e")


def test_an_older_recording_is_rescored_with_current_formulas(scene):
    made = record(fresh(scene), entries(warmup_us=1_000_000), scene_hash="abc")
    old = as_written_before(made)

    assert old.context.warmup_steps == 10
    assert [s.fields() for s in old.rescore()] == list(made.scores)


def test_an_older_recording_is_compared_by_motion(scene, recording):
    old = as_written_before(recording)
    assert first_difference(old, fresh(scene)) is None

    third = old.instants[3]
    moved = replace(third, ego=third.ego._replace(x=third.ego.x + 1e-9))
    changed = replace(old, instants=(*old.instants[:3], moved, *old.instants[4:]))
    assert first_difference(changed, fresh(scene)) == 3
