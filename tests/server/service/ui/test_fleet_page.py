"""The fleet page."""

from __future__ import annotations

from pathlib import Path

import httpx2
import pytest

from real2sim_server.service.serve import running_worker

pytestmark = [pytest.mark.browser, pytest.mark.network]

AXE = Path(__file__).parents[4] / "node_modules/axe-core/axe.min.js"


@pytest.fixture
def fleet(visit, running):
    page = visit(f"{running.url}/ui/fleet.html")
    page.wait_for_selector("[data-worker]")
    return page


def test_each_worker_has_a_row_that_updates(fleet, running):
    line = fleet.locator("[data-worker]")
    assert line.count() == 1
    assert "ready" in line.inner_text()
    assert "0 of" in line.inner_text()
    made = httpx2.post(f"{running.url}/v1/sessions", params={"scene": "tiny"}, json={"reset": {}})
    assert made.status_code == 201
    fleet.wait_for_selector("[data-worker]:has-text('tiny (1)')")
    assert "1 of" in line.inner_text()
    assert fleet.inner_text("#summary") == "Workers there: 1 of 1. Sessions: 1."


def test_a_narrow_page_scrolls_to_every_column(fleet):
    fleet.set_viewport_size({"width": 390, "height": 800})
    table = fleet.locator("#fleet")
    assert table.evaluate("e => e.scrollWidth > e.clientWidth")
    table.evaluate("e => { e.scrollLeft = e.scrollWidth; }")
    last = fleet.locator("thead th").last.bounding_box()
    assert 0 < last["x"] < last["x"] + last["width"] <= 390 + 16
    fleet.set_viewport_size({"width": 1440, "height": 800})
    assert table.evaluate("e => e.scrollWidth <= e.clientWidth")


def test_the_page_sends_a_token_to_a_worker_that_requires_one(visit, make_settings):
    with running_worker(make_settings(token="correct horse")) as worker:
        page = visit(f"{worker.url}/ui/fleet.html")
        page.wait_for_selector("#token[open]")
        page.fill("#token input", "correct horse")
        page.click("#token button")
        page.wait_for_selector("[data-worker]:has-text('ready')")


def test_axe_finds_no_serious_issue(fleet):
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: npm ci")
    fleet.evaluate(AXE.read_text())
    for scheme in ("dark", "light"):
        fleet.emulate_media(color_scheme=scheme)
        found = fleet.evaluate(
            "async () => (await axe.run()).violations"
            ".filter((v) => ['serious', 'critical'].includes(v.impact))"
            ".map((v) => [v.id, v.nodes[0].html])"
        )
        assert found == []
