"""The batch socket: one message steps the worlds of many sessions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from real2sim_proto import DRIVE_SUBPROTOCOL
from real2sim_proto.drive_batch import BATCH_SERVER_MESSAGE, COMMANDS, EGO_COLUMNS, MAX_WORLDS
from real2sim_server.service.storage.errors import StoreUnavailableError
from real2sim_server.service.storage.store import Claim

from .conftest import Planner

pytestmark = pytest.mark.network

SPEC: dict[str, Any] = {"action": "control", "privileged": True, "agents": {"default": "idm"}}
MOTION = ("yaw", "speed", "lateral_speed", "acceleration", "steering", "yaw_rate")


class Batch(Planner):
    """One end of a batch socket."""

    def __init__(self, infos: list[dict[str, Any]]) -> None:
        base = infos[0]["ws_url"].rsplit("/", 2)[0]
        super().__init__({"ws_url": f"{base}/batch/drive"})
        self.infos = infos

    def ask(self, type_: str, **fields: Any) -> dict[str, Any]:
        answer = super().ask(type_, **fields)
        BATCH_SERVER_MESSAGE.validate_python(answer)
        return answer

    def hello(self, **fields: Any) -> dict[str, Any]:
        named = [{k: info[k] for k in ("session_id", "token")} for info in self.infos]
        fields = {"sessions": named, "protocols": [DRIVE_SUBPROTOCOL], **fields}
        self.welcome = self.ask("batch_hello", **fields)
        return self.welcome

    def reset(self, spec: dict[str, Any] = SPEC, **fields: Any) -> dict[str, Any]:
        return self.ask("batch_reset", spec=spec, **fields)

    def act(self, steps: Any, values: Any, **fields: Any) -> dict[str, Any]:
        plans = {"kind": "control", "values": np.asarray(values, np.float64)}
        return self.ask("batch_action", steps=np.asarray(steps), plans=plans, **fields)


@pytest.fixture
def batch(site):
    """Opens batch sockets of new sessions."""
    opened: list[Batch] = []

    def open_batch(count: int, **create: Any) -> Batch:
        opened.append(Batch([site.create(**create) for _ in range(count)]))
        opened[-1].hello()
        return opened[-1]

    yield open_batch
    for one in opened:
        one.stack.close()


def row_of(obs: dict[str, Any], world: int) -> dict[str, Any]:
    """A world's part of a batch_obs, as its own obs has it."""
    k = obs["worlds"].tolist().index(world)
    detail = next((d for d in obs["details"] if d["world"] == world), {})
    ego = obs["ego"][k].tolist()
    return {
        "step": obs["step"][k],
        "t_us": obs["t_us"][k],
        "revision": obs["revision"][k],
        "position": ego[:3],
        "quaternion": ego[3:7],
        "motion": ego[7:],
        "command": COMMANDS[obs["command"][k]],
        "route": obs["route"][k].tobytes(),
        "metrics": {n: v[k] for n, v in obs["metrics"].items() if not np.isnan(v[k])},
        "ends": [bool(obs[name][k]) for name in ("terminated", "truncated", "warming_up")],
        "reason": detail.get("reason"),
        "agents": detail.get("agents", []),
        "events": [
            {n: v for n, v in event.items() if n != "world"}
            for event in obs["events"]
            if event["world"] == world
        ],
    }


def row_of_single(obs: dict[str, Any]) -> dict[str, Any]:
    """An obs, as :func:`row_of` tells it."""
    ego = obs["ego"]
    return {
        **{name: obs[name] for name in ("step", "t_us", "revision", "command", "metrics")},
        **{name: obs[name] for name in ("reason", "agents", "events")},
        "position": ego["position"],
        "quaternion": ego["quaternion"],
        "motion": [ego[name] for name in MOTION],
        "route": obs["route"].tobytes(),
        "ends": [obs[name] for name in ("terminated", "truncated", "warming_up")],
    }


def test_worlds_of_a_batch_do_what_single_sessions_do_bit_for_bit(site, batch, join):
    worlds, many = 3, batch(3)
    singles = [join(site.create()) for _ in range(worlds)]
    together = many.reset(seeds=[5, 6, 7])
    alone = [p.reset(**SPEC, seed=5 + k) for k, p in enumerate(singles)]
    assert EGO_COLUMNS[7:] == MOTION
    for step in range(12):
        for k, obs in enumerate(alone):
            assert row_of(together, k) == row_of_single(obs), (step, k)
        values = [[1.0 + k, 0.01 * k] for k in range(worlds)]
        together = many.act([step] * worlds, values)
        alone = [
            p.act(step, acceleration=a, steering=s)
            for p, (a, s) in zip(singles, values, strict=True)
        ]
    for info, single in zip(many.infos, singles, strict=True):
        states = [site.call("GET", i, "/state").json() for i in (info, single.info)]
        own = {"session_id": "", "planning_ms": None}
        assert states[0] | own == states[1] | own


# --- images -----------------------------------------------------------------------------------

SENSORS = [
    {"camera": "front", "modalities": ["rgb", "depth"], "codec": "raw"},
    {"camera": "left", "codec": "jpeg", "period_us": 200_000},
]
SEEING = SPEC | {"sensors": SENSORS}


def images_of(obs: dict[str, Any], world: int) -> list[dict[str, Any]]:
    """A world's images, as its own obs has them."""
    found = []
    for images in obs["images"]:
        if world in (worlds := images["worlds"].tolist()):
            k = worlds.index(world)
            end = int(images["sizes"][: k + 1].sum())
            shared = {n: images[n] for n in ("sensor", "modality", "codec", "dtype", "shape")}
            place = (images["K"].tobytes(), images["T_world_sensor"][k].tobytes())
            data = images["data"][end - int(images["sizes"][k]) : end]
            found.append(shared | {"place": place, "data": data})
    return found


def images_of_single(obs: dict[str, Any]) -> list[dict[str, Any]]:
    """The images of an obs, as :func:`images_of` tells them."""
    named = ("sensor", "modality", "codec", "dtype", "shape", "data")
    return [
        {n: frame[n] for n in named}
        | {"place": (frame["K"].tobytes(), frame["T_world_sensor"].tobytes())}
        for frame in obs["frames"]
    ]


def test_images_of_a_batch_are_those_of_single_sessions_bit_for_bit(site, batch, join):
    many = batch(2)
    assert many.welcome["limits"]["max_image_bytes"] > 2**20
    singles = [join(site.create()) for _ in range(2)]
    together = many.reset(SEEING)
    alone = [p.reset(**SEEING) for p in singles]
    for step in range(4):
        for k, obs in enumerate(alone):
            assert images_of(together, k) == images_of_single(obs), (step, k)
            assert row_of(together, k) == row_of_single(obs), (step, k)
        values = [[1.0, 0.1], [3.0, 0.0]]
        together = many.act([step] * 2, values)
        alone = [
            p.act(step, acceleration=a, steering=s)
            for p, (a, s) in zip(singles, values, strict=True)
        ]
    assert [i["modality"] for i in together["images"]] == ["rgb", "depth", "rgb"]
    assert len(images_of(many.act([4] * 2, values), 0)) == 2


def test_images_of_a_batch_are_drawn_in_one_go(site, batch, monkeypatch):
    many = batch(3)
    many.reset(SEEING)
    renderer, drawn = site.worker.renderer, []
    render = renderer.render_together

    def counted(requests, **options):
        drawn.append(len(requests))
        return render(requests, **options)

    monkeypatch.setattr(renderer, "render_together", counted)
    many.act([0] * 3, [[0.0, 0.0]] * 3)
    assert drawn == [3]


def test_an_action_sent_again_brings_the_same_images_again(batch):
    many = batch(2)
    many.reset(SEEING)
    first = many.act([0, 0], [[1.0, 0.0]] * 2)
    again = many.act([0, 0], [[1.0, 0.0]] * 2)
    assert [images_of(again, k) for k in range(2)] == [images_of(first, k) for k in range(2)]
    assert many.act([1, 1], [[1.0, 0.0]] * 2)["step"].tolist() == [2, 2]


def test_what_is_wrong_with_one_world_leaves_the_images_of_the_others(batch):
    many = batch(3)
    unknown = many.reset(SPEC | {"sensors": [{"camera": "top"}]})
    assert [e["code"] for e in unknown["errors"]] == ["UNKNOWN_CAMERA"] * 3
    many.reset(SEEING, worlds=[0, 1])
    many.reset(worlds=[2])
    obs = many.act([0, 5, 0], [[1.0, 0.0]] * 3)
    assert [(e["world"], e["code"]) for e in obs["errors"]] == [(1, "BAD_STEP")]
    assert obs["worlds"].tolist() == [0, 2]
    assert [len(images_of(obs, k)) for k in range(3)] == [2, 0, 0]


def test_more_raw_images_than_a_message_holds_are_refused(batch, monkeypatch):
    many = batch(2)
    one = 96 * 64 * (3 + 4)
    monkeypatch.setattr(
        "real2sim_server.service.sessions.batch_connection.MAX_IMAGE_BYTES", 2 * one - 1
    )
    refused = many.reset(SEEING)
    assert refused["code"] == "INVALID_REQUEST"
    assert f"{2 * one} bytes" in refused["detail"]
    assert len(many.reset(SEEING, worlds=[1])["images"]) == 3


# --- what goes wrong --------------------------------------------------------------------------


def test_what_is_wrong_with_one_world_is_said_in_its_place(batch):
    many = batch(4)
    many.reset()
    values = np.array([[1.0, 0.0], [np.nan, 0.0], [1.0, 0.0], [500.0, 0.0]])
    obs = many.act([0, 0, 7, 0], values)
    assert obs["worlds"].tolist() == [0]
    codes = {e["world"]: (e["code"], e["step"]) for e in obs["errors"]}
    assert codes == {1: ("BAD_MESSAGE", 0), 2: ("BAD_STEP", 0), 3: ("BAD_MESSAGE", 0)}
    # The refused have not moved, and go on with what is right.
    after = many.act([0, 0, 0], [[1.0, 0.0]] * 3, worlds=[3, 2, 1])
    assert after["worlds"].tolist() == [3, 2, 1]
    assert after["step"].tolist() == [1, 1, 1]
    assert after["ego"].tobytes() == np.tile(obs["ego"], (3, 1)).tobytes()


def test_an_action_that_is_sent_again_is_answered_again_and_moves_nothing(batch):
    many = batch(2)
    many.reset()
    first = many.act([0, 0], [[1.0, 0.0], [2.0, 0.0]])
    again = many.act([0, 0], [[1.0, 0.0], [2.0, 0.0]])
    assert again["ego"].tobytes() == first["ego"].tobytes()
    assert again["step"].tolist() == [1, 1]
    other = many.act([0, 1], [[3.0, 0.0], [2.0, 0.0]])
    assert [(e["world"], e["code"]) for e in other["errors"]] == [(0, "STEP_CONFLICT")]
    assert other["step"].tolist() == [2]


def test_episodes_that_are_over_are_reset_alone(batch):
    many = batch(2)
    many.reset(SPEC | {"horizon": 2})
    for step in range(2):
        obs = many.act([step, step], [[0.0, 0.0]] * 2)
    assert obs["truncated"].tolist() == [True, True]
    assert {d["reason"] for d in obs["details"]} == {"horizon"}
    begun = many.reset(SPEC | {"horizon": 9}, worlds=[1])
    assert (begun["worlds"].tolist(), begun["step"].tolist()) == ([1], [0])
    obs = many.act([2, 0], [[0.0, 0.0]] * 2)
    assert [e["code"] for e in obs["errors"]] == ["EPISODE_OVER"]
    assert obs["step"].tolist() == [1]


def test_trajectories_and_poses_go_as_arrays(batch, site, join):
    many, single = batch(1), join(site.create())
    many.reset({"action": "trajectory"})
    alone = single.reset(action="trajectory")
    times = alone["t_us"] + np.array([[500_000, 1_000_000]])
    poses = np.array([[[3.0, 0.1, 0.02], [7.0, 0.2, 0.0]]])
    plans = {"kind": "trajectory", "times_us": times, "poses": poses}
    together = many.ask("batch_action", steps=[0], plans=plans)
    alone = single.ask(
        "action",
        step=0,
        plan={"kind": "trajectory", "times_us": times[0].tolist(), "poses": poses[0].tolist()},
    )
    assert row_of(together, 0) == row_of_single(alone)
    many.reset({"action": "pose"})
    moved = many.ask("batch_action", steps=[0], plans={"kind": "pose", "values": [[1.0, 2.0, 0.5]]})
    assert moved["ego"][0, :2].tolist() == [1.0, 2.0]


def test_the_gear_of_a_batch_is_that_of_its_plans(batch, site, join):
    many, single = batch(2), join(site.create())
    many.reset()
    single.reset(**SPEC)
    for step in range(4):
        plans = {"kind": "control", "values": [[2.0, 0.0]] * 2, "reverse": [True, False]}
        obs = many.ask("batch_action", steps=[step] * 2, plans=plans)
        alone = single.act(step, acceleration=2.0, steering=0.0, gear="reverse")
    assert row_of(obs, 0) == row_of_single(alone)
    ahead, reversing = obs["ego"][1, 8], obs["ego"][0, 8]
    assert ahead > reversing
    assert bool(obs["reverse"][0]) == (alone["ego"].get("gear") == "reverse")


def test_what_a_batch_has_not_is_refused_as_a_whole(batch):
    many = batch(2)
    refused = many.reset(SPEC | {"deadline_ms": 50, "wall_clock_s": 3.0})
    assert refused["code"] == "INVALID_REQUEST"
    assert "deadline_ms, wall_clock_s" in refused["detail"]
    many.reset()
    for worlds in ([0, 0], [0, 2]):
        assert many.act([0, 0], [[0, 0]] * 2, worlds=worlds)["code"] == "BAD_MESSAGE"
    assert many.act([0, 0], [[0, 0]])["code"] == "BAD_MESSAGE"
    assert many.ask("batch_action", steps=[0.5, 0], plans={})["code"] == "BAD_MESSAGE"
    assert many.reset(seeds=[1])["code"] == "BAD_MESSAGE"
    assert many.act([0, 0], [[0, 0]] * 2)["step"].tolist() == [1, 1]


def test_a_hello_opens_all_sessions_or_none(site):
    infos = [site.create(), site.create()]
    wrong = [dict(infos[0]), infos[1] | {"token": "wrong"}]
    with Batch(wrong) as refused:
        answer = refused.hello()
        assert (answer["code"], answer["fatal"]) == ("UNAUTHORIZED", True)
        assert refused.wait_closed() == 1008
    with Batch([infos[0], infos[0]]) as twice:
        assert twice.hello()["code"] == "BAD_MESSAGE"
    with Batch(infos) as first, Batch(infos) as second:
        welcome = first.hello()
        assert [w["session_id"] for w in welcome["worlds"]] == [i["session_id"] for i in infos]
        assert welcome["limits"]["max_sessions_per_socket"] == MAX_WORLDS
        first.reset()
        assert second.hello()["code"] == "CONTROLLER_TAKEN"
        assert first.act([0, 0], [[0, 0]] * 2)["step"].tolist() == [1, 1]


def test_a_controller_that_comes_back_takes_the_place_of_the_old_one(batch):
    many = batch(2)
    many.reset()
    many.act([0, 0], [[1.0, 0.0]] * 2)
    with Batch(many.infos) as again:
        tokens = [
            {"session_id": w["session_id"], "resume_token": w["resume_token"]}
            for w in many.welcome["worlds"]
        ]
        welcome = again.hello(sessions=tokens)
        assert [w["step"] for w in welcome["worlds"]] == [1, 1]
        assert again.act([0, 0], [[1.0, 0.0]] * 2)["step"].tolist() == [1, 1]
        old = many.act([1, 1], [[1.0, 0.0]] * 2)
        assert {e["code"] for e in old["errors"]} == {"CONTROLLER_TAKEN"}
        assert again.act([1, 1], [[1.0, 0.0]] * 2)["step"].tolist() == [2, 2]


def test_a_step_that_is_not_on_record_has_not_happened(site, batch, monkeypatch):
    many = batch(3)
    many.reset()
    store, bad = site.worker.store, many.infos[1]["session_id"]
    record = store.record

    def fail_together(_logs: Any) -> None:
        raise StoreUnavailableError("no disk")

    def fail_for_one(claim: Claim, *args: Any, **options: Any) -> None:
        if claim.session_id == bad:
            raise StoreUnavailableError("no disk")
        record(claim, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(store, "record_together", fail_together)
        patch.setattr(store, "record", fail_for_one)
        obs = many.act([0, 0, 0], [[1.0, 0.0]] * 3)
    assert [(e["world"], e["code"], e["step"]) for e in obs["errors"]] == [
        (1, "STORAGE_UNAVAILABLE", 0)
    ]
    assert obs["worlds"].tolist() == [0, 2]
    again = many.act([1, 0, 1], [[1.0, 0.0]] * 3)
    assert again["step"].tolist() == [2, 1, 2]
    assert again["ego"][1].tobytes() == obs["ego"][0].tobytes()


def test_observers_of_a_session_see_what_a_batch_does(batch, join):
    many = batch(2)
    many.reset()
    watcher = join(many.infos[1], role="observer")
    obs = many.act([0, 0], [[1.0, 0.0], [2.0, 0.0]])
    seen = watcher.receive()
    assert (seen["type"], seen["id"]) == ("obs", 0)
    assert row_of(obs, 1) == row_of_single(seen)


def test_a_session_that_is_deleted_leaves_the_others_alone(site, batch):
    many = batch(2)
    many.reset()
    site.call("DELETE", many.infos[0])
    obs = many.act([0, 0], [[1.0, 0.0]] * 2)
    assert [(e["world"], e["code"]) for e in obs["errors"]] == [(0, "SESSION_CLOSED")]
    assert obs["worlds"].tolist() == [1]
    result = many.ask("batch_bye")
    assert [r["world"] for r in result["results"]] == [1]
    assert result["results"][0]["steps"] == 1
    assert [e["code"] for e in result["errors"]] == ["SESSION_CLOSED"]


def test_sessions_keep_their_log_and_are_rebuilt_and_recorded_from_it(site, batch, join):
    many = batch(2)
    many.reset()
    for step in range(3):
        obs = many.act([step, step], [[1.0, 0.02], [0.5, -0.02]])
    many.stack.close()
    info = many.infos[1]
    # A client of its own finds the observation of the last step, and may go on.
    single = join(info)
    again = single.act(2, acceleration=0.5, steering=-0.02)
    assert row_of(obs, 1) == row_of_single(again)
    assert single.act(3)["step"] == 4
    recording = site.call("GET", info, "/recording")
    assert recording.status_code == 200, recording.text
