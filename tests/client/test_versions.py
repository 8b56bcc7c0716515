"""Compatibility between clients and workers of different versions."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from real2sim._calls import Reply, model_of, read_fields, read_json, sent_fields
from real2sim._protocol import ProtocolState, server_message
from real2sim._requests import create_session, export_scenario, reset_spec
from real2sim.errors import MalformedReplyError
from real2sim_proto import decode, encode
from real2sim_proto.drive import CLIENT_MESSAGE, SERVER_MESSAGE, Action, Obs, Reset, Welcome
from real2sim_proto.episode import ResetSpec
from real2sim_proto.errors import ErrorCode, Problem
from real2sim_proto.jobs import JobInfo
from real2sim_proto.operations import Delete, Spawn
from real2sim_proto.plans import Control, TrajectoryPlan
from real2sim_proto.scenarios import History, HistoryEntry, OperationResult, ScenarioInfo
from real2sim_proto.scenes import SceneInfo, SceneState
from real2sim_proto.sessions import SessionCreate, SessionInfo, SessionList

SPEC = ResetSpec(
    beyond_log="loop",
    sensors=[{"camera": "front"}],
    agents={"drivers": {"car_1": {"kind": "idm"}}, "spawn": {"density": 30}},
)
SESSION = SessionInfo(
    session_id="w0.1", scene="street", ws_url="ws://x", token="t", created_at="now", reset=SPEC
)
TRACK = {"times_us": [0], "positions": [(0, 0, 0)], "quaternions": [(1, 0, 0, 0)]}
OBJECT = {
    "object_id": "car_1",
    "category": "car",
    "size": (4, 2, 1.5),
    "instance_id": 1,
    "gaussians": 1,
    "start_us": 0,
    "end_us": 1,
    "trajectory": TRACK,
    "physics": {"object_id": "car_1", "material": "metal"},
}
SCENARIO = {
    "scenario_id": "s",
    "name": "",
    "scene": "street",
    "scene_hash": "0",
    "revision": 1,
    "etag": '"r1"',
    "created_at": "now",
    "can_undo": True,
    "can_redo": False,
    "objects": [OBJECT],
}
DELETED = Delete(object_id="car_1")
PROBLEM = Problem(title="Internal", status=500, code=ErrorCode.INTERNAL, detail="it broke")
JOB = JobInfo(
    job_id="j",
    kind="export",
    subject="street",
    state="failed",
    created_at="now",
    error=PROBLEM,
)
ANSWERS: list[BaseModel] = [
    SESSION,
    SessionList(sessions=[SESSION]),
    SceneInfo(scene="street", state=SceneState.RESIDENT, objects=[OBJECT], ego=TRACK),
    ScenarioInfo.model_validate(SCENARIO),
    OperationResult(revision=1, etag='"r1"', inverse=[DELETED]),
    History(
        revision=1,
        can_undo=True,
        can_redo=False,
        entries=[HistoryEntry(revision=1, kind="edit", operations=[DELETED], created_at="now")],
    ),
]


def with_more(value: Any) -> Any:
    """JSON with an unknown member added to every object, except mappings of names."""
    if isinstance(value, list):
        return [with_more(item) for item in value]
    if not isinstance(value, dict):
        return value
    named = {"drivers", "masses", "provenance"}
    members = {
        key: {k: with_more(v) for k, v in item.items()} if key in named else with_more(item)
        for key, item in value.items()
    }
    return members | {"of_the_future": {"x": 1}}


# --- a newer worker ----------------------------------------------------------------------------


@pytest.mark.parametrize("answer", ANSWERS, ids=lambda answer: type(answer).__name__)
def test_members_added_by_a_newer_worker_are_ignored_at_any_depth(answer):
    content = encode_json(with_more(answer.model_dump(mode="json")))
    assert read_json(type(answer), content) == answer


def test_a_welcome_with_unknown_members_is_read():
    welcome = Welcome(
        protocol="p",
        session_id="w0.1",
        role="controller",
        versions={},
        limits={},
        cameras=[],
        objects=[OBJECT],
        start_us=0,
        end_us=1,
        step=None,
    )
    fields = welcome.model_dump(mode="json")
    fields["objects"] = with_more(fields["objects"])
    assert server_message(encode(fields), SERVER_MESSAGE) == welcome


def test_an_unknown_event_type_is_read():
    ego = {"position": (0, 0, 0), "quaternion": (1, 0, 0, 0), "size": (4, 2, 1.5)}
    ego |= dict.fromkeys(("yaw", "speed", "acceleration", "steering", "yaw_rate"), 0.0)
    fields = {"type": "obs", "step": 0, "t_us": 0, "revision": 0, "ego": ego}
    fields |= {"command": "straight", "route": None, "frames": []}
    fields["events"] = [{"type": "sunset", "t_us": 0}]
    message = read_fields(SERVER_MESSAGE, fields)
    assert isinstance(message, Obs)
    assert message.events[0].type == "sunset"


def test_a_session_with_unknown_options_does_not_affect_others():
    fields = SessionList(sessions=[SESSION, SESSION]).model_dump(mode="json")
    reset = fields["sessions"][0]["reset"]
    reset["ego"]["dynamics"] = "articulated"
    reset["agents"]["drivers"] = {"car_1": {"kind": "parade"}, "car_2": {"kind": "log"}}
    first, second = read_json(SessionList, encode_json(fields)).sessions
    assert second == SESSION
    assert first.reset.ego.dynamics == "kinematic_bicycle"
    assert list(first.reset.agents.drivers) == ["car_2"]


def test_an_unknown_operation_does_not_affect_the_history():
    fields = ANSWERS[-1].model_dump(mode="json")
    fields["entries"][0]["operations"] = [{"op": "repaint"}, {"op": "delete", "object_id": "car_1"}]
    assert read_json(History, encode_json(fields)) == ANSWERS[-1]


def test_unknown_job_kinds_and_error_codes_are_read():
    fields = JOB.model_dump(mode="json")
    fields["kind"], fields["error"]["code"] = "reconstruct", "OUT_OF_FILM"
    job = read_json(JobInfo, encode_json(fields))
    assert (job.kind, str(job.error.code)) == ("reconstruct", "OUT_OF_FILM")
    assert read_json(JobInfo, encode_json(JOB.model_dump(mode="json"))).error.code is (
        ErrorCode.INTERNAL
    )


def test_a_reply_of_another_shape_is_refused():
    with pytest.raises(ValidationError):
        read_json(SessionInfo, b'{"scene": "street", "reset": {"action": "fly"}}')
    with pytest.raises(MalformedReplyError, match="not a SessionInfo"):
        model_of(SessionInfo)(Reply(200, {}, b"[]"))


def test_an_export_with_unknown_members_is_refused():
    entry = {"revision": 1, "kind": "edit", "created_at": "now"}
    entry["operations"] = [{"op": "delete", "object_id": "car_1", "slowly": True}]
    content = encode_json({"scene": "street", "scene_hash": "0" * 64, "entries": [entry]})
    with pytest.raises(MalformedReplyError, match="slowly"):
        export_scenario("s").parse(Reply(200, {}, content))


# --- an older worker ---------------------------------------------------------------------------


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class OldSensor(Strict):
    camera: str
    codec: str = "raw"


class OldEgo(Strict):
    tracker: str = "pursuit"


class OldSpec(Strict):
    seed: int = 0
    sensors: list[OldSensor] = Field(default_factory=list)
    ego: OldEgo = OldEgo()


class OldControl(Strict):
    kind: Literal["control"]
    acceleration: float
    steering: float


class OldReset(Strict):
    v: Literal[1]
    id: int
    type: Literal["reset"]
    spec: OldSpec


class OldAction(Strict):
    v: Literal[1]
    id: int
    type: Literal["action"]
    step: int
    plan: OldControl


class OldMessage(Strict):
    message: Annotated[OldReset | OldAction, Field(discriminator="type")]


def test_a_reset_for_an_older_worker_contains_only_set_options():
    spec = reset_spec(["front"], "jpeg", {"seed": 3, "ego": {"tracker": "lqr"}})
    request = ProtocolState().reset(spec)
    read = OldMessage.model_validate({"message": decode(request.encoded())}).message
    assert (read.spec.seed, read.spec.ego.tracker) == (3, "lqr")
    assert read.spec.sensors == [OldSensor(camera="front", codec="jpeg")]
    action = Action(id=1, step=0, plan=Control(acceleration=1.0, steering=0.0))
    assert OldMessage.model_validate({"message": sent_fields(action)}).message.step == 0


def test_a_session_creation_contains_only_set_options():
    spec = reset_spec([], "raw", {"seed": 3})
    call = create_session("street", None, SessionCreate(reset=spec))
    assert json.loads(call.request.body) == {"reset": {"sensors": [], "seed": 3}}


def test_an_option_set_to_its_default_is_sent():
    spec = reset_spec([], "raw", {"contact": {"pulse": True}})
    assert sent_fields(spec) == {"sensors": [], "contact": {"pulse": True}}


# --- the same version --------------------------------------------------------------------------


def test_none_is_sent_if_it_is_not_the_default():
    spec = reset_spec([], "raw", {"ego": {"suspension": None}, "start_us": None})
    assert sent_fields(spec) == {"sensors": [], "ego": {"suspension": None}}
    assert ResetSpec.model_validate(sent_fields(spec)).ego.suspension is None


@pytest.mark.parametrize(
    "message",
    [
        Reset(id=1, spec=SPEC, slot=2),
        Action(id=2, step=0, plan=TrajectoryPlan(times_us=[1, 2], poses=[(1, 0, 0), (2, 0, 0)])),
        Action(id=2, step=0, plan=Control(acceleration=0, steering=0, gear="reverse")),
    ],
)
def test_sent_fields_decode_to_the_same_message(message):
    assert CLIENT_MESSAGE.validate_python(decode(encode(sent_fields(message)))) == message


def test_sent_operations_keep_their_kinds():
    spawned = Spawn(recorded_id="van_0", place={"ahead": 40.0}, driver={"kind": "idm"})
    assert sent_fields(spawned) == {
        "op": "spawn",
        "recorded_id": "van_0",
        "place": {"ahead": 40.0},
        "driver": {"kind": "idm"},
    }


def encode_json(value: Any) -> bytes:
    return json.dumps(value).encode()
