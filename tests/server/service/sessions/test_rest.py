"""Sessions over REST."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_proto import decode
from real2sim_proto.drive import SERVER_MESSAGE
from real2sim_proto.sessions import SessionEdited, SessionInfo, SessionState
from real2sim_server.world.recording import first_difference, recording_of_bytes
from real2sim_server.world.replay import Replayer

pytestmark = pytest.mark.network

CONTROL = {"kind": "control", "acceleration": 1.0, "steering": 0.0}
RESET = {"action": "control", "dt_us": 100_000}
CAMERA = {"camera": "front"}


@pytest.fixture
def info(site) -> dict:
    return site.create(RESET)


def problem(answer) -> tuple[int, str]:
    return answer.status_code, answer.json()["code"]


# --- lifetime -----------------------------------------------------------------------------------


def test_a_session_id_starts_with_its_worker_and_urls_are_returned(site):
    answer = site.http.post("/v1/sessions", params={"scene": "tiny"})
    made = SessionInfo.model_validate_json(answer.content)
    site.made.append(answer.json())
    assert made.session_id.startswith("w0.")
    assert answer.headers["Location"] == f"/v1/sessions/{made.session_id}"
    assert made.ws_url == f"{site.url.replace('http', 'ws')}/v1/sessions/{made.session_id}/drive"
    assert (made.scene, made.step, made.controller) == ("tiny", None, False)


def test_a_creation_with_reset_starts_the_first_episode(info):
    assert (info["step"], info["t_us"], info["reset"]["dt_us"]) == (0, 0, 100_000)


def test_a_session_on_a_scenario_starts_with_its_edits(site):
    scenario = site.http.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    operations = {"operations": [{"op": "delete", "object_id": "car_red"}]}
    site.http.post(f"/v1/scenarios/{scenario}/operations", json=operations)
    info = site.create(RESET, scenario=scenario)
    state = site.call("GET", info, "/state").json()
    assert info["scenario_id"] == scenario
    assert {a["object_id"] for a in state["agents"]} == {"car_blue", "post"}
    later = {"operations": [{"op": "delete", "object_id": "post"}]}
    site.http.post(f"/v1/scenarios/{scenario}/operations", json=later)
    site.call("POST", info, "/reset", json=RESET)
    assert len(site.call("GET", info, "/state").json()["agents"]) == 2


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({}, (422, "INVALID_REQUEST")),
        ({"scene": "tiny", "scenario": "sc_1"}, (422, "INVALID_REQUEST")),
        ({"scene": "moon"}, (404, "UNKNOWN_SCENE")),
        ({"scenario": "sc_none"}, (404, "UNKNOWN_SCENARIO")),
    ],
)
def test_a_session_requires_exactly_one_existing_world(site, query, expected):
    assert problem(site.http.post("/v1/sessions", params=query)) == expected


def test_a_session_with_an_invalid_first_episode_is_not_created(site):
    body = {"reset": {"start_us": 99_000_000}}
    answer = site.http.post("/v1/sessions", params={"scene": "tiny"}, json=body)
    assert problem(answer) == (422, "TIME_OUT_OF_RANGE")
    assert site.http.get("/v1/sessions").json()["sessions"] == []
    assert site.worker.scene_cache._resident["tiny"].pins == 0


def test_the_list_contains_no_tokens(site, info):
    (listed,) = site.http.get("/v1/sessions").json()["sessions"]
    assert (listed["session_id"], listed["token"]) == (info["session_id"], "")


@pytest.mark.parametrize("token", ["guess", ""])
def test_a_session_requires_its_token(site, info, token):
    headers = {"Authorization": f"Bearer {token}"} if token else {"Authorization": ""}
    answer = site.call("GET", info, "/state", headers=headers)
    assert problem(answer) == (401, "UNAUTHORIZED")
    assert answer.headers["WWW-Authenticate"] == "Bearer"


def test_unknown_and_closed_sessions_get_different_errors(site, info):
    unknown = info | {"session_id": "w0.0000000000000000"}
    assert problem(site.call("GET", unknown)) == (404, "UNKNOWN_SESSION")
    assert site.call("DELETE", info).status_code == 204
    assert problem(site.call("GET", info)) == (410, "SESSION_CLOSED")
    assert problem(site.call("DELETE", info)) == (410, "SESSION_CLOSED")


def test_a_deleted_session_unpins_its_scene(site, info):
    assert site.worker.scene_cache._resident["tiny"].pins == 1
    site.call("DELETE", info)
    assert site.worker.scene_cache._resident["tiny"].pins == 0


def test_a_creation_sent_twice_creates_one_session(site):
    headers = {"Idempotency-Key": "one-session"}
    answers = [
        site.http.post("/v1/sessions", params={"scene": "tiny"}, headers=headers) for _ in range(2)
    ]
    site.made.append(answers[0].json())
    assert answers[1].json() == answers[0].json()
    assert answers[1].headers["Location"] == answers[0].headers["Location"]
    assert len(site.http.get("/v1/sessions").json()["sessions"]) == 1


# --- time -------------------------------------------------------------------------------------


def test_steps_advance_the_clock_under_one_plan(site, info):
    answer = site.call("POST", info, "/step", json={"n": 3, "plan": CONTROL})
    state = SessionState.model_validate_json(answer.content)
    assert (state.step, state.t_us) == (3, 300_000)
    # 1 m/s^2 for 0.3 s, with the 0.2 s lag of engine and brakes.
    assert state.ego.speed == pytest.approx(5.3 - 0.2 * (1 - math.exp(-0.3 / 0.2)), abs=0.01)


def test_without_a_plan_the_ego_follows_the_log(site, info):
    state = site.call("POST", info, "/step", json={"n": 10}).json()
    assert state["ego"]["position"] == pytest.approx([5.0, 0.0, 0.0], abs=0.05)


def test_many_steps_equal_single_steps(site):
    one, other = site.create(RESET), site.create(RESET)
    at_once = site.call("POST", one, "/step", json={"n": 15, "plan": CONTROL}).json()
    site.call("POST", other, "/step", json={"plan": CONTROL})
    for _ in range(14):
        single = site.call("POST", other, "/step", json={}).json()
    assert single["ego"] == at_once["ego"]
    assert single["metrics"] == at_once["metrics"]


def test_steps_stop_at_the_end_of_the_episode(site):
    info = site.create(RESET | {"dt_us": 50_000})
    state = site.call("POST", info, "/step", json={"n": 1000}).json()
    assert (state["step"], state["truncated"], state["reason"]) == (40, True, "horizon")
    assert [e["type"] for e in state["events"]] == ["horizon"]
    assert problem(site.call("POST", info, "/step", json={})) == (409, "EPISODE_OVER")


def test_events_are_reported_once(site):
    info = site.create({"action": "pose", "on_collision": "continue"})
    plan = {"kind": "pose", "x": 12.0, "y": -3.0, "yaw": 0.0}
    first = site.call("POST", info, "/step", json={"plan": plan}).json()
    assert "car_red" in {e["object_id"] for e in first["events"]}
    again = site.call("POST", info, "/step", json={}).json()
    assert again["events"] == []


def test_reset_restores_the_initial_state(site, info):
    before = site.call("GET", info, "/state").json()
    site.call("POST", info, "/step", json={"n": 3, "plan": CONTROL})
    answer = site.call("POST", info, "/reset", json=RESET)
    assert answer.status_code == 200
    assert site.call("GET", info, "/state").json() == before


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"n": 0}, (422, "INVALID_REQUEST")),
        ({"n": 1001}, (422, "INVALID_REQUEST")),
        ({"dt_us": 7}, (422, "INVALID_REQUEST")),
        ({"plan": {"kind": "pose", "x": 0, "y": 0, "yaw": 0}}, (422, "INVALID_ACTION")),
        ({"plan": CONTROL | {"acceleration": "NaN"}}, (422, "INVALID_REQUEST")),
    ],
)
def test_a_refused_step_does_not_advance_the_clock(site, info, body, expected):
    assert problem(site.call("POST", info, "/step", json=body)) == expected
    assert site.call("GET", info, "/state").json()["step"] == 0


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [("GET", "/state", None), ("POST", "/step", {}), ("POST", "/render", {"sensors": [CAMERA]})],
)
def test_requests_before_a_reset_are_refused(site, method, path, body):
    answer = site.call(method, site.create(), path, json=body)
    assert problem(answer) == (409, "NOT_RESET")


@pytest.mark.parametrize(("path", "body"), [("/step", {}), ("/reset", RESET)])
def test_requests_are_refused_while_a_controller_is_connected(site, join, info, path, body):
    planner = join(info)
    assert problem(site.call("POST", info, path, json=body)) == (409, "CONTROLLER_TAKEN")
    assert site.call("GET", info).json()["controller"]
    assert planner.act(0)["step"] == 1
    assert site.call("GET", info, "/state").json()["step"] == 1


def test_a_controller_continues_after_steps_by_request(site, join, info):
    site.call("POST", info, "/step", json={"n": 2, "plan": CONTROL})
    planner = join(info, None)
    assert planner.hello()["step"] == 2
    assert planner.act(1)["code"] == "STALE_STEP"
    assert planner.act(2)["step"] == 3


# --- render -----------------------------------------------------------------------------------


def test_several_images_are_returned_as_msgpack(site, info):
    sensors = [{"camera": "front", "modalities": ["rgb", "depth"]}, {"camera": "left"}]
    answer = site.call("POST", info, "/render", json={"sensors": sensors})
    view = SERVER_MESSAGE.validate_python(decode(answer.content))
    assert answer.headers["Content-Type"] == "application/msgpack"
    assert [(f.sensor, f.modality) for f in view.frames] == [
        ("front", "rgb"),
        ("front", "depth"),
        ("left", "rgb"),
    ]


@pytest.mark.parametrize(
    ("media_type", "magic"), [("image/jpeg", b"\xff\xd8\xff"), ("image/png", b"\x89PNG")]
)
def test_a_single_image_is_returned_as_a_file(site, info, media_type, magic):
    headers = {"Accept": media_type}
    answer = site.call("POST", info, "/render", json={"sensors": [CAMERA]}, headers=headers)
    assert answer.headers["Content-Type"] == media_type
    assert answer.content.startswith(magic)
    assert "render;dur=" in answer.headers["Server-Timing"]


def test_several_images_are_not_available_as_a_file(site, info):
    body = {"sensors": [CAMERA, {"camera": "left"}]}
    answer = site.call("POST", info, "/render", json=body, headers={"Accept": "image/png"})
    assert problem(answer) == (406, "NOT_ACCEPTABLE")


def test_a_render_by_request_equals_the_observation(site, join, info):
    answer = site.call("POST", info, "/render", json={"sensors": [CAMERA]}, headers=MSGPACK)
    rendered = decode(answer.content)["frames"][0]
    observed = join(info).reset(sensors=[CAMERA])["frames"][0]
    np.testing.assert_equal(rendered, observed)


ALL = ["rgb", "depth", "instance"]


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        ({"camera": "rear"}, (404, "UNKNOWN_CAMERA")),
        ({"camera": "front", "width": 8192, "modalities": ALL}, (422, "INVALID_REQUEST")),
        ({"camera": "front", "modalities": ["rgb", "rgb"]}, (422, "INVALID_REQUEST")),
    ],
)
def test_invalid_sensors_are_refused(site, info, sensor, expected):
    answer = site.call("POST", info, "/render", json={"sensors": [sensor]}, headers=MSGPACK)
    assert problem(answer) == expected


MSGPACK = {"Accept": "application/msgpack"}


# --- edits ------------------------------------------------------------------------------------

KEEP = {"op": "restore", "object_id": "post"}
SPAWN = {"op": "spawn", "recorded_id": "car_red", "place": {"ahead": 12.0}, "speed": 4.0}


def ids(answer) -> set[str]:
    return {a["object_id"] for a in answer.json()["agents"]}


def test_rest_spawns_and_removes_a_car_while_a_controller_drives(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(privileged=True)
    answer = site.call("POST", info, "/operations", json={"operations": [SPAWN]})
    made = SessionEdited.model_validate_json(answer.content)
    assert (made.step, made.revision, made.created) == (0, 1, ["spawned_1"])
    obs = planner.act(0)
    assert "spawned_1" in {a["object_id"] for a in obs["agents"]}
    assert "edited" in {e["type"] for e in obs["events"]}
    gone = {"operations": [{"op": "delete", "object_id": "spawned_1"}]}
    assert site.call("POST", info, "/operations", json=gone).json()["revision"] == 2
    assert "spawned_1" not in {a["object_id"] for a in planner.act(1)["agents"]}


def test_an_edit_of_a_running_world_sent_twice_takes_effect_once(site, info):
    key = {"Idempotency-Key": "one"}
    body = {"operations": [SPAWN]}
    answers = [site.call("POST", info, "/operations", json=body, headers=key) for _ in range(2)]
    assert answers[1].headers["Idempotent-Replayed"] == "true"
    assert answers[0].json() == answers[1].json()
    assert len(ids(site.call("GET", info, "/state"))) == 4


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"operations": [SPAWN | {"recorded_id": "ghost"}]}, (404, "UNKNOWN_OBJECT")),
        ({"operations": [SPAWN | {"recorded_id": None}]}, (422, "INVALID_REQUEST")),
        ({"operations": [SPAWN], "base_rev": 7}, (412, "STALE_REVISION")),
        (
            {"operations": [SPAWN, {"op": "restore", "object_id": "post"}]},
            (422, "INVALID_OPERATION"),
        ),
    ],
)
def test_a_refused_edit_of_a_running_world_changes_nothing(site, info, body, expected):
    assert problem(site.call("POST", info, "/operations", json=body)) == expected
    state = site.call("GET", info, "/state").json()
    assert (state["revision"], len(state["agents"])) == (0, 3)


def test_a_recording_contains_spawned_objects(site, info):
    site.call("POST", info, "/operations", json={"operations": [SPAWN]})
    for _ in range(3):
        site.call("POST", info, "/step", json={"plan": CONTROL})
    recording = recording_of_bytes(site.call("GET", info, "/recording").content, "it")
    assert [e.kind for e in recording.entries] == ["reset", "edit", *["action"] * 3]
    assert "spawned_1" in recording.instants[-1].others.ids
    session = site.session(info)
    assert (
        first_difference(recording, Replayer.on(session.start.scene, session.start.state)) is None
    )
