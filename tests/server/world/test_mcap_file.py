"""Episodes as MCAP files: Foxglove messages and the embedded recording."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from real2sim_proto import encode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control, TrajectoryPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import transform_from
from real2sim_server.world.mcap_file import cloud_document, mcap_bytes, recording_in, save_mcap
from real2sim_server.world.ranging import Cloud
from real2sim_server.world.recording import RecordingError, record, to_bytes
from real2sim_server.world.replay import Entry, Replayer, action_payload, reset_payload

CLOUD = Cloud(
    sensor="top",
    modality="lidar",
    t_us=5_300_000,
    duration_us=100_000,
    frame="sensor",
    compensated=True,
    T_vehicle_sensor=np.eye(4),
    T_world_sensor=transform_from(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0, 0, 0])),
    columns={
        "points": np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        "intensity": np.array([0.25, 0.5], np.float32),
        "ring": np.array([7, 9], np.uint16),
    },
)
PICTURE = b"\xff\xd8 a picture"


@pytest.fixture(scope="module")
def recording(make_scene, moving):
    scene = make_scene(car=moving(14, 0, z=0.8), other=moving(40, 3.5, z=0.8, speed=5.0))
    spec = ResetSpec(on_collision="continue", action="trajectory")
    log = [Entry("reset", 0, reset_payload(spec))]
    for step in range(12):
        times = [5_000_000 + 100_000 * (step + k + 1) for k in range(10)]
        plan = TrajectoryPlan(times_us=times, poses=[(k + 1.0, 0.0, 0.0) for k in range(10)])
        log.append(Entry("action", step, action_payload(plan)))
    made = record(Replayer.on(scene, ScenarioState.of(scene)), log, scene_hash="abc")
    frames = {"frames/front/rgb/000002.jpg": PICTURE}
    frames["frames/top/lidar/000003.cloud"] = encode(cloud_document(CLOUD))
    return replace(made, frames=frames)


@pytest.fixture(scope="module")
def messages(recording, tmp_path_factory):
    """Messages by topic, read with a generic MCAP reader."""
    path = save_mcap(recording, tmp_path_factory.mktemp("mcap") / "a" / "episode.mcap")
    found: dict[str, list] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema.encoding == "jsonschema"
            assert json.loads(schema.data)["title"] == schema.name
            content = json.loads(message.data)
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, content))
    return found


def test_point_clouds_are_foxglove_messages(messages):
    [(schema, at, cloud)] = messages["/lidar/top"]
    assert (schema, at) == ("foxglove.PointCloud", 5_300_000_000)
    assert cloud["frame_id"] == "world"
    assert cloud["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert [(f["name"], f["offset"], f["type"]) for f in cloud["fields"]] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("intensity", 12, 7),
        ("ring", 16, 3),
    ]
    data = base64.b64decode(cloud["data"])
    assert len(data) == 2 * cloud["point_stride"]
    assert np.frombuffer(data[18:30], "<f4").tolist() == [4.0, 5.0, 6.0]


def test_a_broken_cloud_is_named(recording):
    broken = replace(recording, frames={"frames/top/lidar/000003.cloud": b"nothing"})
    with pytest.raises(RecordingError, match="top/lidar/3 is no point cloud"):
        mcap_bytes(broken)


def test_the_recording_round_trips(recording, tmp_path):
    path = save_mcap(recording, tmp_path / "episode.mcap")
    assert to_bytes(recording_in(path)) == to_bytes(recording)


def test_equal_episodes_give_equal_files(recording):
    assert mcap_bytes(recording) == mcap_bytes(recording)


def test_every_instant_has_the_pose_of_the_vehicle(recording, messages):
    assert len(messages["/tf"]) == len(recording.instants) == 13
    for instant, (schema, log_time, body) in zip(recording.instants, messages["/tf"], strict=True):
        assert schema == "foxglove.FrameTransform"
        assert log_time == instant.t_us * 1000
        assert body["timestamp"]["sec"] * 1_000_000 + body["timestamp"]["nsec"] // 1000 == (
            instant.t_us
        )
        assert body["translation"] == {
            "x": instant.ego.x,
            "y": instant.ego.y,
            "z": instant.ego.z,
        }
        yaw = 2 * math.atan2(body["rotation"]["z"], body["rotation"]["w"])
        assert yaw == pytest.approx(instant.ego.yaw, abs=1e-12)


def test_objects_are_boxes_at_their_positions(recording, messages):
    last, (schema, _, body) = recording.instants[-1], messages["/scene"][-1]
    assert schema == "foxglove.SceneUpdate"
    entities = {e["id"]: e for e in body["entities"]}
    assert set(entities) == {"ego", "car", "other"}
    (cube,) = entities["other"]["cubes"]
    row = last.others.ids.index("other")
    assert list(cube["pose"]["position"].values()) == last.others.centres[row].tolist()
    assert list(cube["size"].values()) == last.others.sizes[row].tolist()


def test_plans_contacts_metrics_and_images_are_exported(recording, messages):
    assert len(messages["/plan"]) == 12
    assert len(messages["/plan"][0][2]["poses"]) == 10
    contacts = [c[2]["object_id"] for c in messages["/contact"]]
    assert contacts == [c.object_id for i in recording.instants for c in i.contacts] != []
    assert messages["/metrics"][-1][2]["collisions"] == recording.accumulators()[-1].collisions > 0
    ((schema, log_time, body),) = messages["/camera/front/rgb"]
    assert (schema, body["format"]) == ("foxglove.CompressedImage", "jpeg")
    assert base64.b64decode(body["data"]) == PICTURE
    assert log_time == recording.instants[2].t_us * 1000


def test_episodes_without_plans_have_no_plan_topic(make_scene):
    scene = make_scene()
    log = [Entry("reset", 0, reset_payload(ResetSpec(action="control")))]
    log.append(Entry("action", 0, action_payload(Control(acceleration=0.0, steering=0.0))))
    made = record(Replayer.on(scene, ScenarioState.of(scene)), log, scene_hash="abc")
    assert b"/plan" not in mcap_bytes(made)
    assert b"/tf" in mcap_bytes(made)


def test_files_that_are_not_mcap_are_refused(tmp_path):
    path = tmp_path / "other.mcap"
    path.write_bytes(b"not mcap at all, but long enough to be looked at")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        recording_in(path)
