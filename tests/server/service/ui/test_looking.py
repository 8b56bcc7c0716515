"""Viewing a scene creates nothing. The first edit creates a scenario."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

import httpx2
import pytest

from real2sim_server.service import serve
from real2sim_server.service.app import create_app
from real2sim_server.service.serve import running_worker
from tests.waiting import wait_until

from .hands import address, behind, enter, field, kept, shown, wait_address

pytestmark = [pytest.mark.browser, pytest.mark.network]


def scenarios(running: Any) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = httpx2.get(f"{running.url}/v1/scenarios").json()["scenarios"]
    return listed


def test_viewing_creates_no_scenario_and_the_view_is_shareable(looking, visit, running):
    looking.wait_for_selector("#picture[data-seq]")
    assert looking.inner_text("#name") == "tiny"
    assert looking.inner_text("#saved") == "Nothing changed yet"
    looking.evaluate("async () => (await import('/ui/model.js')).select('car_red')")
    looking.click("#next")
    looking.keyboard.press("Control+z")
    wait_address(looking, selected="car_red")
    assert "scenario" not in address(looking)
    other = visit(looking.evaluate("location.href"))
    other.wait_for_selector("body[data-ready]")
    assert shown(other, "model.selected") == "car_red"
    assert shown(other, "model.t") == shown(looking, "model.t")
    assert scenarios(running) == []


def test_a_worker_without_scenes_offers_the_demo_street(visit, make_settings, tmp_path):
    (tmp_path / "nothing").mkdir()
    with running_worker(make_settings(scenes_dir=tmp_path / "nothing")) as worker:
        page = visit(f"{worker.url}/ui")
        page.click("text=Add the demo street")
        page.wait_for_selector("[data-scene=demo_street]")
        assert not page.is_visible("text=Add the demo street")


def test_the_first_edit_creates_the_scenario_and_updates_the_picture(looking, running):
    looking.wait_for_selector("#picture[data-seq]")
    looking.evaluate("async () => (await import('/ui/model.js')).select('car_red')")
    before = field(looking, "pose-x")
    enter(looking, "pose-x", before + 1)
    kept(looking, 1)
    (made,) = scenarios(running)
    assert (made["name"], made["revision"]) == ("tiny edit", 1)
    wait_address(looking, scenario=made["scenario_id"])
    assert looking.inner_text("#name") == "tiny edit"
    seq = looking.get_attribute("#picture", "data-seq")
    looking.click("#next")
    wait_until(lambda: looking.get_attribute("#picture", "data-seq") != seq, "the next picture")
    enter(looking, "pose-x", before + 2)
    kept(looking, 2)
    assert len(scenarios(running)) == 1
    assert not looking.is_visible("#gone")


def test_a_refused_edit_creates_no_scenario(looking, running):
    looking.evaluate(
        "async () => (await import('/ui/model.js')).edit([{ op: 'delete', object_id: 'nobody' }])"
    )
    looking.wait_for_selector("#messages:has-text('nobody')")
    wait_until(lambda: scenarios(running) == [], "the scenario to go")
    assert looking.inner_text("#saved") == "Nothing changed yet"
    looking.click("#next")
    wait_address(looking, t=str(shown(looking, "model.t")))
    assert "scenario" not in address(looking)
    assert not looking.is_visible("#gone")


def test_the_studio_works_below_the_path_of_a_proxy(visit, make_settings, monkeypatch):
    def create_behind_proxy(settings):
        app = create_app(settings)
        app.add_middleware(lambda inner: behind(inner, "/sim", forwarded=False))
        return app

    monkeypatch.setattr(serve, "create_app", create_behind_proxy)
    with running_worker(make_settings()) as worker:
        page = visit(f"{worker.url}/sim/")
        asked: list[str] = []
        page.on("request", lambda request: asked.append(urlsplit(request.url).path))
        page.on("websocket", lambda socket: asked.append(urlsplit(socket.url).path))
        page.click("[data-scene=tiny]")
        page.wait_for_selector("body[data-ready]")
        page.evaluate("async () => (await import('/sim/ui/model.js')).own()")
        kept(page, 0)
        page.wait_for_selector("#picture[data-seq]")
    assert any(path.startswith("/sim/v1/scenarios/") and path.endswith("/view") for path in asked)
    # Pictures have addresses of blobs, without a path.
    assert [path for path in asked if path.startswith("/") and not path.startswith("/sim/")] == []
