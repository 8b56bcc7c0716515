from __future__ import annotations

import threading

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.scenes import Readiness
from real2sim_server._numba import Made
from real2sim_server.service.app import create_app
from real2sim_server.service.storage.store import StoreError
from tests.waiting import LIMIT_S, wait_until

from .waiting import wait_ready

HERE = {"Host": "127.0.0.1"}


def samples(client) -> dict[str, float]:
    families = text_string_to_metric_families(client.get("/metrics").text)
    return {
        sample.name + "".join(sorted(sample.labels.values())): sample.value
        for family in families
        for sample in family.samples
    }


def test_a_started_worker_is_live_and_becomes_ready(client):
    assert client.get("/livez").json() == {"status": "alive"}
    wait_ready(client)
    assert Readiness.model_validate(client.get("/readyz").json()).ready


def test_a_worker_is_live_but_not_ready_while_kernels_warm_up(make_settings, monkeypatch):
    warm = threading.Event()
    monkeypatch.setattr("real2sim_server.service.renderer.warm_up", lambda _: warm.wait(LIMIT_S))
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        assert client.get("/livez").status_code == 200
        response = client.get("/readyz")
        assert response.status_code == 503
        assert "warming up kernels" in response.json()["reasons"]
        assert "Retry-After" in response.headers
        told = []
        client.app.state.worker.on_ready = lambda: told.append(client.app.state.worker.waiting_for)
        warm.set()
        wait_ready(client)
        assert told == [{"warming up kernels"}]


def test_readiness_reports_the_progress_of_kernel_compilation(make_settings, monkeypatch):
    warm = threading.Event()
    monkeypatch.setattr("real2sim_server.service.renderer.warm_up", lambda _: warm.wait(LIMIT_S))
    monkeypatch.setattr("real2sim_server.service.warm_up.made", Made(12, 40, compiled=3))
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        assert any(": 12 of 40" in r for r in client.get("/readyz").json()["reasons"])
        warm.set()
        wait_ready(client)


def test_a_worker_is_ready_before_the_kernels_for_small_images(make_settings, monkeypatch):
    made = threading.Event()
    monkeypatch.setattr(
        "real2sim_server.service.renderer.warm_up_small_images",
        lambda _: made.wait(LIMIT_S),
    )
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        wait_ready(client)
        assert not made.is_set()
        made.set()


def test_a_failed_warm_up_is_reported_as_the_reason(make_settings, monkeypatch):
    def fail(_backend):
        raise RuntimeError("no compiler")

    monkeypatch.setattr("real2sim_server.service.renderer.warm_up", fail)
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        wait_until(lambda: "no compiler" in client.get("/readyz").text, "the reason")
        assert client.get("/livez").status_code == 200


def test_a_job_that_hangs_makes_the_worker_not_live(start_worker, manual_clock):
    client = start_worker(stall_seconds=60)
    wait_ready(client)
    engine, go_on = client.app.state.worker.engine, threading.Event()
    stuck = threading.Thread(target=engine.call_sync, args=(go_on.wait,), kwargs={"label": "stuck"})
    stuck.start()
    wait_until(lambda: engine.running == "stuck", "the job to run")
    assert client.get("/livez").status_code == 200
    manual_clock.advance(61.0)
    response = client.get("/livez")
    go_on.set()
    stuck.join()
    assert response.status_code == 503
    assert "'stuck'" in response.json()["reason"]


def test_a_worker_with_a_lost_device_is_neither_live_nor_ready(client):
    wait_ready(client)

    def lose():
        raise RuntimeError("CUDA error: unspecified launch failure")

    with pytest.raises(RuntimeError, match="launch failure"):
        client.app.state.worker.engine.call_sync(lose)
    assert client.get("/livez").status_code == 503
    assert client.get("/readyz").status_code == 503


def test_metrics_count_requests_by_route_and_never_by_id(client):
    client.get("/v1/scenes/tiny")
    found = samples(client)
    assert found["real2sim_http_request_duration_seconds_count/v1/scenes/{scene}200GET"] == 1
    assert not any("tiny" in name for name in found)


def test_metrics_show_scenes_by_state(client):
    assert samples(client)["real2sim_scenesresident"] == 0
    client.put("/v1/scenes/tiny/residency")
    found = samples(client)
    assert found["real2sim_scenesresident"] == 1
    assert found["real2sim_scene_memory_bytes"] > 0


def test_metrics_can_be_turned_off(start_worker):
    assert start_worker(metrics=False).get("/metrics").status_code == 404


def test_two_workers_in_one_process_have_separate_metrics(start_worker, tmp_path):
    first, second = start_worker(), start_worker(data_dir=tmp_path / "other")
    first.get("/v1/server")
    name = "real2sim_http_request_duration_seconds_count/v1/server200GET"
    assert samples(first)[name] == 1
    assert name not in samples(second)


def test_a_failed_store_aborts_the_start_and_leaves_no_thread(make_settings, tmp_path):
    (tmp_path / "data" / "real2sim.db").mkdir(parents=True)
    before = threading.active_count()
    app = create_app(make_settings())
    with pytest.raises(StoreError), TestClient(app):
        pass
    assert threading.active_count() <= before


def test_metrics_include_store_jobs_and_sockets(client):
    client.put("/v1/scenes/tiny/residency")
    info = client.post("/v1/sessions?scene=tiny", json={"reset": {"action": "control"}}).json()
    url = f"/v1/sessions/{info['session_id']}/drive"
    with client.websocket_connect(url, [DRIVE_SUBPROTOCOL], headers=HERE) as drive:
        hello = {"protocols": [DRIVE_SUBPROTOCOL], "token": info["token"]}
        plan = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
        drive.send_bytes(encode({"v": 1, "type": "hello", "id": 1, **hello}))
        drive.receive_bytes()
        drive.send_bytes(encode({"v": 1, "type": "action", "id": 2, "step": 0, "plan": plan}))
        assert decode(drive.receive_bytes())["type"] == "obs"
        assert samples(client)["real2sim_socketsdrive"] == 1
    found = samples(client)
    assert found["real2sim_socketsdrive"] == 0
    assert found["real2sim_step_duration_seconds_count"] == 1
    assert found["real2sim_store_duration_seconds_countwrite"] > 0
    assert found["real2sim_ended_jobs_totalload_scenesucceeded"] == 1


def test_missed_deadlines_are_counted(client):
    body = {"reset": {"action": "control", "deadline_ms": 1, "on_timeout": "fail"}}
    info = client.post("/v1/sessions?scene=tiny", json=body).json()
    url = f"/v1/sessions/{info['session_id']}/drive"
    with client.websocket_connect(url, [DRIVE_SUBPROTOCOL], headers=HERE) as drive:
        hello = {"protocols": [DRIVE_SUBPROTOCOL], "token": info["token"]}
        resume = {"resume": {"token": "none", "last_step": 0}}
        drive.send_bytes(encode({"v": 1, "type": "hello", "id": 1, **hello, **resume}))
        assert decode(drive.receive_bytes())["type"] == "welcome"
        assert decode(drive.receive_bytes())["type"] == "obs"
    assert samples(client)["real2sim_missed_deadlines_total"] == 1


def test_opening_and_closing_a_drive_socket_is_logged(client, logged):
    info = client.post("/v1/sessions?scene=tiny").json()
    url = f"/v1/sessions/{info['session_id']}/drive"
    name = HERE | {"X-Real2Sim-Client": "planner 7"}
    with client.websocket_connect(url, [DRIVE_SUBPROTOCOL], headers=name) as drive:
        hello = {"protocols": [DRIVE_SUBPROTOCOL], "token": info["token"]}
        drive.send_bytes(encode({"v": 1, "type": "hello", "id": 1, **hello}))
        drive.receive_bytes()
    lines = {e["event"]: e for e in logged if e["event"].startswith("drive socket")}
    assert lines["drive socket opened"]["role"] == "controller"
    assert lines["drive socket closed"]["steps"] == 0


def test_opening_and_closing_a_view_socket_is_logged(client, logged):
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()
    with client.websocket_connect(
        f"/v1/scenarios/{made['scenario_id']}/view", headers=HERE
    ) as view:
        view.send_json({"type": "hello"})
        view.receive_json()
    told = [e["event"] for e in logged if e["event"].startswith("view socket")]
    assert told == ["view socket opened", "view socket closed"]
