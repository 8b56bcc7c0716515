from __future__ import annotations

import threading
import time

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from real2sim_proto.scenes import Readiness
from real2sim_server.service.app import create_app
from real2sim_server.service.storage.store import StoreError


def wait_until_ready(client) -> None:
    deadline = time.monotonic() + 60
    while client.get("/readyz").status_code != 200:
        assert time.monotonic() < deadline, client.get("/readyz").text
        time.sleep(0.02)


def samples(client) -> dict[str, float]:
    families = text_string_to_metric_families(client.get("/metrics").text)
    return {
        sample.name + "".join(sorted(sample.labels.values())): sample.value
        for family in families
        for sample in family.samples
    }


def test_a_started_worker_lives_and_becomes_ready(client):
    assert client.get("/livez").json() == {"status": "alive"}
    wait_until_ready(client)
    assert Readiness.model_validate(client.get("/readyz").json()).ready


def test_while_kernels_warm_up_it_lives_but_is_not_ready(make_settings, monkeypatch):
    warm = threading.Event()
    monkeypatch.setattr(
        "real2sim_server.service.rendering.renderer.warm_up", lambda _: warm.wait(30)
    )
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        assert client.get("/livez").status_code == 200
        response = client.get("/readyz")
        assert response.status_code == 503
        assert "warming up kernels" in response.json()["reasons"]
        assert "Retry-After" in response.headers
        warm.set()
        wait_until_ready(client)


def test_a_failed_warm_up_is_the_reason(make_settings, monkeypatch):
    def fail(_backend):
        raise RuntimeError("no compiler")

    monkeypatch.setattr("real2sim_server.service.rendering.renderer.warm_up", fail)
    with TestClient(create_app(make_settings()), base_url="http://127.0.0.1") as client:
        deadline = time.monotonic() + 10
        while "no compiler" not in client.get("/readyz").text:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert client.get("/livez").status_code == 200


def test_a_job_that_does_not_end_stalls_the_worker(start_worker):
    client = start_worker(stall_seconds=0.2)
    wait_until_ready(client)
    engine, go_on = client.app.state.worker.engine, threading.Event()
    stuck = threading.Thread(target=engine.call_sync, args=(go_on.wait,), kwargs={"label": "stuck"})
    stuck.start()
    time.sleep(0.4)
    response = client.get("/livez")
    go_on.set()
    stuck.join()
    assert response.status_code == 503
    assert "'stuck'" in response.json()["reason"]


def test_a_lost_device_is_neither_live_nor_ready(client):
    wait_until_ready(client)

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


def test_two_workers_in_one_process_count_apart(start_worker, tmp_path):
    first, second = start_worker(), start_worker(data_dir=tmp_path / "other")
    first.get("/v1/server")
    name = "real2sim_http_request_duration_seconds_count/v1/server200GET"
    assert samples(first)[name] == 1
    assert name not in samples(second)


def test_a_store_that_cannot_be_opened_ends_the_start_and_leaves_no_thread(make_settings, tmp_path):
    (tmp_path / "data").write_text("a file where a folder should be")
    before = threading.active_count()
    app = create_app(make_settings())
    with pytest.raises(StoreError), TestClient(app):
        pass
    assert threading.active_count() <= before
