"""Number, lifetime, logs and memory of sessions."""

from __future__ import annotations

import asyncio
import sqlite3
import tracemalloc

import pytest

from real2sim_proto import decode, encode
from real2sim_server.render import RenderError
from tests.waiting import wait_until

pytestmark = pytest.mark.network

CAMERA = {"camera": "front"}


def entries(site, info) -> list:
    return asyncio.run(site.worker.store.session_entries(info["session_id"]))


def test_creation_over_the_limit_is_refused_with_retry_after(own_site):
    site = own_site(max_sessions=2)
    made = [site.create() for _ in range(2)]
    answer = site.http.post("/v1/sessions", params={"scene": "tiny"})
    assert (answer.status_code, answer.json()["code"]) == (429, "OVER_CAPACITY")
    assert int(answer.headers["Retry-After"]) > 0
    site.call("DELETE", made[0])
    site.create()


def test_a_worker_at_its_session_limit_stays_ready(own_site):
    site = own_site(max_sessions=1)
    site.create()
    assert site.http.get("/readyz").status_code == 200
    metrics = site.http.get("/metrics").text
    assert "real2sim_sessions 1.0" in metrics
    assert "real2sim_session_limit 1.0" in metrics


def test_idle_sessions_are_evicted_and_restored_on_demand(own_site, join, manual_clock):
    site = own_site(session_idle_seconds=1.0)
    left, held = site.create(), site.create()
    with join(left) as planner:
        planner.reset(seed=3)
        ego = planner.act(0)["ego"]
    stays = join(held)
    wait_until(lambda: not site.session(left).connected, "the planner to be gone")
    for _ in range(3):
        manual_clock.expire_next()
    wait_until(lambda: len(site.worker.sessions) == 1, "the idle session to be evicted")
    state = site.call("GET", left, "/state").json()
    assert (state["step"], state["ego"]["speed"]) == (1, ego["speed"])
    assert stays.reset()["step"] == 0


def test_sessions_of_an_earlier_run_are_rebuilt_on_demand(own_site, tmp_path):
    url = f"sqlite:///{tmp_path / 'store.db'}"
    before = own_site(store_url=url)
    info = before.create({"action": "control"})
    plan = {"kind": "control", "acceleration": 1.0, "steering": 0.02}
    state = before.call("POST", info, "/step", json={"n": 5, "plan": plan}).json()
    before.stop()
    after = own_site(store_url=url)
    again = after.call("GET", info, "/state").json()
    assert {k: again[k] for k in ("ego", "step")} == {k: state[k] for k in ("ego", "step")}
    assert after.call("POST", info, "/step", json={}).json()["step"] == 6


def test_a_repeated_action_is_recognised_after_an_upgrade(own_site, join, tmp_path):
    store = tmp_path / "store.db"
    before = own_site(store_url=f"sqlite:///{store}")
    info = before.create()
    with join(info) as planner:
        planner.reset()
        planner.act(0)
    before.stop()
    with sqlite3.connect(store) as database:
        (stored,) = database.execute("SELECT payload FROM session_log WHERE kind = 'action'")
        plan = decode(stored[0])["plan"]
        assert plan.pop("gear") == "drive"
        new = (encode({"plan": plan}),)
        database.execute("UPDATE session_log SET payload = ? WHERE kind = 'action'", new)
    after = own_site(store_url=f"sqlite:///{store}")
    again = join(info | {"ws_url": info["ws_url"].replace(before.url[7:], after.url[7:])})
    assert again.act(0)["type"] == "obs"
    assert again.act(0, acceleration=0.1)["code"] == "STEP_CONFLICT"


def test_the_workers_token_opens_every_session(own_site, join):
    site = own_site(token="a-secret-token")
    worker = {"Authorization": "Bearer a-secret-token"}
    assert site.http.post("/v1/sessions", params={"scene": "tiny"}).status_code == 401
    info = site.http.post("/v1/sessions", params={"scene": "tiny"}, headers=worker).json()
    assert site.call("GET", info, headers=worker).status_code == 200
    assert site.call("GET", info).status_code == 200
    assert join(info | {"token": "a-secret-token"}).reset()["step"] == 0


def test_applied_messages_are_logged_in_order(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(seed=4)
    planner.act(0)
    planner.ask("edit", operations=[{"op": "delete", "object_id": "post"}])
    planner.act(1)
    planner.reset()
    log = entries(site, info)
    assert [(e.seq, e.kind, e.step) for e in log] == [
        (0, "reset", 0),
        (1, "action", 0),
        (2, "edit", 1),
        (3, "action", 1),
        (4, "reset", 0),
    ]
    assert decode(log[0].payload)["spec"]["seed"] == 4
    assert decode(log[1].payload)["plan"]["kind"] == "control"
    assert decode(log[2].payload)["operations"][0]["object_id"] == "post"


def test_refused_and_repeated_messages_are_not_logged(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(start_us=99_000_000)
    planner.reset()
    planner.act(0)
    planner.act(0)
    planner.act(5)
    planner.ask("action", step=1, plan={"kind": "pose", "x": 0.0, "y": 0.0, "yaw": 0.0})
    planner.ask("edit", base_rev=9, operations=[{"op": "delete", "object_id": "post"}])
    planner.socket.send(encode({"type": "nonsense"}))
    planner.receive()
    assert [e.kind for e in entries(site, info)] == ["reset", "action"]


def test_steps_by_request_are_logged_one_by_one(site):
    info = site.create({"action": "control", "dt_us": 10_000})
    plan = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
    site.call("POST", info, "/step", json={"n": 45, "plan": plan})
    log = entries(site, info)
    assert [e.step for e in log] == [0, *range(45)]
    assert [decode(e.payload)["plan"] is None for e in log[1:]] == [False] + [True] * 44


@pytest.mark.parametrize("sensors", [[], [CAMERA]])
def test_a_step_that_cannot_be_recorded_does_not_take_effect(site, join, monkeypatch, sensors):
    planner = join(site.create())
    planner.reset(sensors=sensors)

    def full_disk(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(site.worker.store, "record", full_disk)
        assert planner.act(0)["code"] == "INTERNAL"
    obs = planner.act(0)
    assert (obs["step"], obs["type"]) == (1, "obs")


@pytest.mark.parametrize("codec", ["raw", "jpeg"])
def test_a_step_that_cannot_be_encoded_is_removed_from_the_log(site, join, monkeypatch, codec):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[CAMERA | {"codec": codec}])

    def fail(*_: object, **__: object) -> None:
        raise RenderError("no memory for this picture")

    with monkeypatch.context() as patch:
        patch.setattr("real2sim_server.service.renderer.encode_frame", fail)
        assert planner.act(0)["type"] == "error"
    assert [e.kind for e in entries(site, info)] == ["reset"]
    assert planner.act(0, acceleration=0.2)["step"] == 1
    assert [(e.seq, e.kind) for e in entries(site, info)] == [(0, "reset"), (1, "action")]


def test_an_unfinished_step_is_logged_but_not_yet_visible(site, join, monkeypatch):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[CAMERA])
    session, renderer, seen = site.session(info), site.worker.renderer, []
    render_together = renderer.render_together

    def check_log(*given: object, **options: object) -> object:
        wait_until(lambda: len(entries(site, info)) == 2, "the action on record")
        seen.append([e.kind for e in entries(site, info)])
        seen.append([e.kind for e in asyncio.run(site.worker.sessions.entries(session))])
        return render_together(*given, **options)

    with monkeypatch.context() as patch:
        patch.setattr(renderer, "render_together", check_log)
        planner.act(0)
    assert seen == [["reset", "action"], ["reset"]]


def test_sessions_on_one_scene_need_less_than_5_mb_each(site, join):
    def driven() -> None:
        planner = join(site.create())
        planner.reset(sensors=[CAMERA | {"width": 640}], privileged=True)
        planner.act(0)

    driven()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(10):
            driven()
        each = (tracemalloc.get_traced_memory()[0] - before) / 10
    finally:
        tracemalloc.stop()
    # Includes the ten clients in this process.
    assert each < 5e6


def test_sessions_share_the_scene_and_its_objects(site):
    one, two = site.session(site.create({})), site.session(site.create({}))
    assert one.start.scene is two.start.scene
    assert one.start.state is two.start.state
    assert one.running_world().instances()[0].cloud is two.running_world().instances()[0].cloud
