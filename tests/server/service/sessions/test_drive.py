"""The drive socket of a worker, message by message."""

from __future__ import annotations

import asyncio
import threading
from weakref import WeakSet

import numpy as np
import pytest

from real2sim_proto import DRIVE_SUBPROTOCOL, decode
from real2sim_proto.drive import SERVER_MESSAGE
from real2sim_server.service.engine import QueueFullError
from real2sim_server.service.sessions import messages
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.network

CAMERA = {"camera": "front"}


def pixels(frame: dict) -> np.ndarray:
    return np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])


# --- welcome and reset ------------------------------------------------------------------------


def test_welcome_lists_cameras_objects_and_time_span(site, join):
    info = site.create()
    answer = join(info, None).hello()
    welcome = SERVER_MESSAGE.validate_python(answer)
    assert welcome.session_id == info["session_id"]
    assert [c.name for c in welcome.cameras] == ["front", "left"]
    assert {o.object_id for o in welcome.objects} == {"car_red", "car_blue", "post"}
    assert (welcome.start_us, welcome.end_us, welcome.step) == (0, 2_000_000, None)
    assert welcome.versions["scene_hash"] == site.session(info).row.scene_hash


def test_a_worker_with_a_low_pixel_limit_warms_up_and_drives(site, join, monkeypatch):
    sessions = site.worker.sessions
    for checks in (sessions.pipeline, site.worker.renderer):
        monkeypatch.setattr(checks, "_max_pixels", 1000)
    monkeypatch.setattr(sessions, "_warm", WeakSet())
    planner = join(site.create())
    assert planner.reset(sensors=[CAMERA | {"width": 16}])["step"] == 0
    assert planner.reset(sensors=[CAMERA])["code"] == "INVALID_REQUEST"


def test_the_first_observation_shows_step_0(planner):
    obs = SERVER_MESSAGE.validate_python(planner.reset(sensors=[CAMERA], privileged=True))
    assert (obs.step, obs.t_us, obs.revision) == (0, 0, 0)
    assert {a.object_id for a in obs.agents} == {"car_red", "car_blue", "post"}
    assert [f.sensor for f in obs.frames] == ["front"]
    assert {"queue", "world", "render", "settle", "encode", "pack"} <= set(obs.timing)


def test_all_frames_of_an_observation_have_its_timestamp(planner):
    planner.reset(sensors=[CAMERA, {"camera": "left", "modalities": ["rgb", "depth", "instance"]}])
    obs = planner.act(0)
    assert [(f["sensor"], f["modality"]) for f in obs["frames"]] == [
        ("front", "rgb"),
        ("left", "rgb"),
        ("left", "depth"),
        ("left", "instance"),
    ]
    assert {f["t_us"] for f in obs["frames"]} == {obs["t_us"]} == {100_000}


def test_the_state_route_shows_the_step_of_the_last_observation(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[CAMERA])
    for step in range(20):
        assert planner.act(step)["step"] == step + 1
        assert site.call("GET", info, "/state").json()["step"] == step + 1


def test_a_slower_camera_is_delivered_only_when_due(planner):
    slow = {"camera": "left", "period_us": 300_000}
    obs = planner.reset(sensors=[CAMERA, slow])
    seen = [{f["sensor"] for f in obs["frames"]}]
    for step in range(4):
        seen.append({f["sensor"] for f in planner.act(step)["frames"]})
    assert seen == [{"front", "left"}, {"front"}, {"front"}, {"front", "left"}, {"front"}]


@pytest.mark.parametrize("codec", ["raw", "jpeg", "png"])
def test_frames_use_the_requested_codec(planner, codec):
    (frame,) = planner.reset(sensors=[CAMERA | {"codec": codec, "width": 48}])["frames"]
    assert (frame["codec"], frame["shape"]) == (codec, [32, 48, 3])


def test_a_raw_frame_shows_the_sky_above_the_road(planner):
    (frame,) = planner.reset(sensors=[CAMERA])["frames"]
    top = pixels(frame)[2].mean(axis=0)
    assert top == pytest.approx([127, 178, 229], abs=2)


def test_a_second_reset_starts_from_the_beginning(planner):
    first = planner.reset(sensors=[CAMERA])
    planner.act(0)
    planner.ask("edit", operations=[{"op": "delete", "object_id": "car_red"}])
    again = planner.reset(sensors=[CAMERA])
    assert (again["step"], again["revision"]) == (0, 0)
    assert again["frames"][0]["data"] == first["frames"][0]["data"]


@pytest.mark.parametrize(
    ("spec", "code"),
    [
        ({"start_us": 9_000_000}, "TIME_OUT_OF_RANGE"),
        ({"horizon": 1000}, "TIME_OUT_OF_RANGE"),
        ({"sensors": [{"camera": "rear"}]}, "UNKNOWN_CAMERA"),
        ({"sensors": [CAMERA | {"period_us": 150_000}]}, "INVALID_REQUEST"),
        ({"sensors": [CAMERA, CAMERA]}, "INVALID_REQUEST"),
        ({"sensors": [CAMERA | {"width": 4}]}, "BAD_MESSAGE"),
        ({"seed": -1}, "BAD_MESSAGE"),
    ],
)
def test_an_invalid_reset_is_refused_and_the_episode_continues(planner, spec, code):
    planner.reset()
    planner.act(0)
    answer = planner.reset(**spec)
    assert (answer["type"], answer["code"], answer["fatal"]) == ("error", code, False)
    assert planner.act(1)["step"] == 2


def test_progress_is_reported_while_the_scene_warms_up(site, join, monkeypatch):
    info = site.create()
    planner = join(info, None)

    warm = threading.Event()

    async def slowly(_session: object) -> None:
        await asyncio.to_thread(warm.wait, LIMIT_S)

    monkeypatch.setattr(messages, "PROGRESS_S", 0.05)
    monkeypatch.setattr(site.worker.sessions, "warm_up", slowly)
    hello = planner.send("hello", protocols=[DRIVE_SUBPROTOCOL], token=info["token"])
    progress = decode(planner.socket.recv(timeout=LIMIT_S))
    assert (progress["type"], progress["id"]) == ("progress", hello)
    SERVER_MESSAGE.validate_python(progress)
    warm.set()
    assert planner.receive()["type"] == "welcome"


def test_a_step_refused_by_a_busy_engine_can_be_retried(site, planner, monkeypatch):
    planner.reset(sensors=[CAMERA])

    async def busy(*_: object, **__: object) -> None:
        raise QueueFullError("64 jobs wait")

    with monkeypatch.context() as patch:
        for call in ("call", "call_together"):
            patch.setattr(site.worker.engine, call, busy)
        answer = planner.act(0)
        assert (answer["code"], answer["retryable"]) == ("QUEUE_FULL", True)
    assert planner.act(0)["step"] == 1


def test_raw_frames_over_the_message_size_are_refused(planner):
    huge = CAMERA | {"width": 8192, "modalities": ["rgb", "depth"]}
    answer = planner.reset(sensors=[huge])
    assert (answer["code"], answer["fatal"]) == ("INVALID_REQUEST", False)


# --- lock step --------------------------------------------------------------------------------


def test_one_action_advances_one_step(planner):
    planner.reset(dt_us=50_000)
    for step in range(5):
        obs = planner.act(step)
        assert (obs["step"], obs["t_us"]) == (step + 1, (step + 1) * 50_000)


def test_a_repeated_action_gets_the_same_observation_with_its_own_id(planner):
    planner.reset(sensors=[CAMERA])
    first = planner.act(0)
    again = planner.act(0)
    assert again["id"] == first["id"] + 1
    for message in (first, again):
        del message["id"]
    np.testing.assert_equal(again, first)


def test_equal_plans_in_different_encodings_are_the_same_action(planner):
    planner.reset(action="trajectory")
    plan = {"kind": "trajectory", "times_us": [100_000, 200_000], "poses": [[1, 0, 0], [2, 0, 0]]}
    as_arrays = plan | {
        "times_us": np.array(plan["times_us"]),
        "poses": np.array(plan["poses"], float),
        "frame": "vehicle",
    }
    first = planner.ask("action", step=0, plan=plan)
    assert planner.ask("action", step=0, plan=as_arrays)["t_us"] == first["t_us"]
    assert planner.ask("action", step=1, plan=plan | {"times_us": [200_000, 300_000]})["step"] == 2


@pytest.mark.parametrize(
    ("step", "plan", "code"),
    [
        (1, {"steering": 0.1}, "STEP_CONFLICT"),
        (0, {}, "STALE_STEP"),
        (3, {}, "BAD_STEP"),
        (2, {"kind": "pose", "x": 1.0, "y": 0.0, "yaw": 0.0}, "INVALID_ACTION"),
    ],
)
def test_an_action_for_the_wrong_step_does_not_advance(planner, step, plan, code):
    planner.reset()
    planner.act(0)
    planner.act(1)
    wanted = plan if "kind" in plan else {"kind": "control", "acceleration": 0.5, "steering": 0.02}
    answer = planner.ask("action", step=step, plan=wanted | plan)
    assert (answer["type"], answer["code"], answer["step"]) == ("error", code, 2)
    assert planner.act(2)["step"] == 3


def test_actions_edits_and_renders_require_a_reset(planner):
    for answer in (
        planner.act(0),
        planner.ask("edit", operations=[{"op": "delete", "object_id": "post"}]),
        planner.ask("render", sensors=[CAMERA]),
    ):
        assert (answer["type"], answer["code"]) == ("error", "NOT_RESET")


def test_after_the_end_only_the_last_observation_is_available(planner):
    planner.reset(horizon=2)
    planner.act(0)
    last = planner.act(1)
    assert (last["truncated"], last["reason"]) == (True, "horizon")
    assert planner.act(1)["truncated"]
    assert planner.act(2)["code"] == "EPISODE_OVER"
    assert planner.reset()["step"] == 0


def test_a_collision_ends_the_episode_with_an_event(planner):
    planner.reset(action="pose")
    obs = planner.ask("action", step=0, plan={"kind": "pose", "x": 12.0, "y": -3.0, "yaw": 0.0})
    assert (obs["terminated"], obs["reason"]) == (True, "collision")
    assert ("collision", "car_red") in [(e["type"], e["object_id"]) for e in obs["events"]]


# --- edit, render, bye ------------------------------------------------------------------------


def test_an_edit_takes_effect_before_the_next_step(planner):
    planner.reset(privileged=True)
    operations = [{"op": "duplicate", "object_id": "post", "y": 2.0}]
    edited = planner.ask("edit", base_rev=0, operations=operations)
    assert (edited["type"], edited["revision"]) == ("edited", 1)
    obs = planner.act(0)
    assert obs["revision"] == 1
    assert edited["created"][0] in {a["object_id"] for a in obs["agents"]}
    assert "edited" in {e["type"] for e in obs["events"]}


def test_an_asset_is_inserted_into_a_session_without_a_scenario(site, planner):
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "red"}
    site.http.post("/v1/assets", json=cut).raise_for_status()
    planner.reset(privileged=True)
    insert = {"op": "insert", "asset_id": "red", "pose": {"position": [20.0, 3.0, 0.8]}}
    edited = planner.ask("edit", operations=[insert])
    assert edited["type"] == "edited"
    assert edited["created"][0] in {a["object_id"] for a in planner.act(0)["agents"]}
    site.http.delete("/v1/assets/red").raise_for_status()


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"base_rev": 7}, "STALE_REVISION"),
        ({"operations": [{"op": "delete", "object_id": "bus"}]}, "UNKNOWN_OBJECT"),
        ({"operations": [{"op": "explode", "object_id": "post"}]}, "BAD_MESSAGE"),
        ({"operations": []}, "BAD_MESSAGE"),
    ],
)
def test_a_refused_edit_changes_nothing(planner, fields, code):
    planner.reset(privileged=True)
    operations = [{"op": "delete", "object_id": "post"}]
    answer = planner.ask("edit", **{"operations": operations} | fields)
    assert (answer["type"], answer["code"]) == ("error", code)
    obs = planner.act(0)
    assert (obs["revision"], len(obs["agents"])) == (0, 3)


def test_rendering_does_not_advance_time(planner):
    planner.reset()
    planner.act(0)
    view = planner.ask("render", sensors=[CAMERA, {"camera": "left", "codec": "jpeg"}])
    assert (view["type"], view["t_us"], len(view["frames"])) == ("view", 100_000, 2)
    assert planner.act(1)["step"] == 2


def test_bye_returns_the_result_and_closes_the_session(site, planner):
    planner.reset()
    planner.act(0)
    result = SERVER_MESSAGE.validate_python(planner.ask("bye"))
    assert (result.steps, result.t_us) == (1, 100_000)
    assert result.metrics["distance"] > 0
    assert planner.wait_closed() == 1000
    answer = site.call("GET", planner.info)
    assert (answer.status_code, answer.json()["code"]) == (410, "SESSION_CLOSED")


# --- concurrency ------------------------------------------------------------------------------


def test_sessions_on_one_scene_are_isolated(site, join):
    one, two = join(site.create()), join(site.create())
    one.reset(privileged=True)
    two.reset(privileged=True)
    one.ask("edit", operations=[{"op": "delete", "object_id": "car_red"}])
    assert len(one.act(0)["agents"]) == 2
    obs = two.act(0)
    assert (obs["revision"], len(obs["agents"])) == (0, 3)


def test_pings_are_answered_while_a_step_is_computed(site, join):
    planner = join(site.create())
    planner.reset(sensors=[CAMERA | {"width": 2048, "modalities": ["rgb", "depth", "instance"]}])
    planner.send("action", step=0, plan={"kind": "control", "acceleration": 0, "steering": 0})
    pong = planner.socket.ping()
    assert pong.wait(0.5)
    with pytest.raises(TimeoutError):
        planner.socket.recv(timeout=0)
    assert planner.receive()["step"] == 1


def test_concurrent_planners_get_their_own_answers(site, join):
    planners = [join(site.create()) for _ in range(4)]
    wrong: list[object] = []

    def drive(planner, steering: float) -> None:
        planner.reset(sensors=[CAMERA])
        for step in range(8):
            obs = planner.act(step, steering=steering)
            if obs["step"] != step + 1 or abs(obs["ego"]["steering"] - steering) > 0.1:
                wrong.append(obs)

    threads = [
        threading.Thread(target=drive, args=(p, 0.05 * (k - 2))) for k, p in enumerate(planners)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_frame_poses_follow_the_estimated_ego_pose(site, join):
    planner = join(site.create())
    cameras = [{"camera": "front", "codec": "raw"}, {"camera": "left", "codec": "jpeg"}]
    exact = planner.reset(sensors=cameras, privileged=True)
    noise = {"estimate": {"position": 0.5, "heading": 0.05}}
    obs = planner.reset(sensors=cameras, privileged=True, randomization=noise)
    turn = obs["ego"]["yaw"] - obs["ego_truth"]["yaw"]
    for frame, true in zip(obs["frames"], exact["frames"], strict=True):
        assert frame["data"] == true["data"]
        (x, y), (tx, ty) = (f["T_world_sensor"][:2, 3] for f in (frame, true))
        assert (x, y) != (tx, ty)
        ahead, was = (np.arctan2(*f["T_world_sensor"][[1, 0], 2]) for f in (frame, true))
        assert ahead - was == pytest.approx(turn, abs=1e-3)
