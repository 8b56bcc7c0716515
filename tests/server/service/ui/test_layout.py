"""Layout, sizes, keyboard and touch on large and small screens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from real2sim_server.service.serve import running_worker
from tests.waiting import wait_until

from .hands import kept, shown, wait_address

pytestmark = [pytest.mark.browser, pytest.mark.network]

AXE = Path(__file__).parents[4] / "node_modules/axe-core/axe.min.js"
PHONE = {"width": 390, "height": 844}


def size(page: Any, selector: str) -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    return box["width"], box["height"]


def test_the_picture_fills_most_of_the_page_and_panel_sizes_persist(studio):
    studio.set_viewport_size({"width": 1920, "height": 1080})
    width, height = size(studio, "#stage")
    assert width * height > 0.6 * 1920 * 1080
    before = size(studio, "#side")[0]
    box = studio.locator("#split-side").bounding_box()
    studio.mouse.move(box["x"] + 2, 500)
    studio.mouse.down()
    studio.mouse.move(box["x"] - 98, 500, steps=4)
    studio.mouse.up()
    assert size(studio, "#side")[0] == pytest.approx(before + 100, abs=6)
    studio.focus("#split-map")
    low = size(studio, "#map-panel")[1]
    studio.keyboard.press("ArrowUp")
    assert size(studio, "#map-panel")[1] == pytest.approx(low + 24, abs=1)
    given = size(studio, "#side"), size(studio, "#map-panel")
    wait_address(studio, scenario=shown(studio, "model.scenario.scenario_id"))
    studio.reload()
    studio.wait_for_selector("body[data-ready]")
    assert (size(studio, "#side"), size(studio, "#map-panel")) == given
    studio.keyboard.press("x")
    assert size(studio, "#map")[0] > 1000
    assert size(studio, "#stage")[0] < 600


def test_tabs_follow_arrow_keys_and_cameras_are_sorted_by_direction(studio):
    studio.focus("[role=tab][aria-selected=true]")
    for _ in range(2):
        studio.keyboard.press("ArrowDown")
    assert studio.evaluate("document.activeElement.dataset.tab") == "physics"
    assert studio.locator("[role=tabpanel]:visible").get_attribute("id") == "physics"
    studio.keyboard.press("End")
    assert studio.locator("[role=tab][aria-selected=true]").count() == 1
    visible = studio.locator("[role=tabpanel]:visible").get_attribute("aria-labelledby")
    assert visible == studio.evaluate("document.activeElement.id")
    order = studio.evaluate(
        "[...document.querySelectorAll('#cameras button')].map(b => b.dataset.camera)"
    )
    angles = shown(
        studio,
        "Object.fromEntries(model.scene.cameras.map((c) =>"
        " [c.name, Math.atan2(c.T_vehicle_camera[1][2], c.T_vehicle_camera[0][2])]))",
    )
    ahead = [angles[name] for name in order[:-1] if abs(angles[name]) <= 1.6]
    assert ahead == sorted(ahead, reverse=True)


def test_axe_finds_no_serious_issue_in_any_panel(studio):
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: npm ci")
    studio.evaluate(AXE.read_text())
    found = []
    for tab in studio.locator("[data-tab]").all():
        tab.click()
        found += studio.evaluate(
            "async () => (await axe.run()).violations"
            ".filter((v) => ['serious', 'critical'].includes(v.impact))"
            ".map((v) => [v.id, v.nodes[0].html])"
        )
    assert found == []


def test_every_panel_fits_a_phone(studio):
    studio.set_viewport_size(PHONE)
    wide = "document.documentElement.scrollWidth"
    assert studio.evaluate(wide) == PHONE["width"]
    assert size(studio, "#stage")[0] == PHONE["width"]
    for tab in studio.locator("[data-tab]").all():
        tab.click()
        assert size(studio, "[role=tabpanel]:visible")[1] > 200
    assert not studio.is_visible("#map")
    studio.click("#swap")
    assert size(studio, "#map")[0] == PHONE["width"]


PINCH = """() => {
  const map = document.getElementById('map');
  map.setPointerCapture = () => {};
  const box = map.getBoundingClientRect();
  const send = (kind, id, x) => map.dispatchEvent(new PointerEvent(kind, {
    pointerId: id, pointerType: 'touch', bubbles: true,
    clientX: box.left + x, clientY: box.top + 60 }));
  send('pointerdown', 1, 100);
  send('pointerdown', 2, 140);
  send('pointermove', 1, 80);
  send('pointermove', 2, 160);
  send('pointerup', 1, 80);
  send('pointerup', 2, 160);
}"""


def test_pinching_zooms_the_map_and_a_cancelled_drag_changes_nothing(studio):
    scale = "async () => (await import('/ui/map_view.js')).view.scale"
    before = studio.evaluate(scale)
    studio.evaluate(PINCH)
    assert studio.evaluate(scale) == pytest.approx(2 * before, rel=0.05)
    studio.click("#fit")
    studio.evaluate(
        """async () => {
          const { screenOf } = await import('/ui/map.js');
          const { model } = await import('/ui/model.js');
          const map = document.getElementById('map');
          map.setPointerCapture = () => {};
          const box = map.getBoundingClientRect();
          const [x, y] = screenOf(model.scenario.objects[0].object_id);
          const send = (kind, by) => map.dispatchEvent(new PointerEvent(kind, {
            pointerId: 1, pointerType: 'touch', bubbles: true,
            clientX: box.left + x + by, clientY: box.top + y }));
          send('pointerdown', 0);
          send('pointermove', 40);
          send('pointercancel', 40);
        }"""
    )
    assert shown(studio, "model.draft") is None
    kept(studio, 0)


def test_a_broken_link_shows_a_page_that_leads_back(visit, running):
    page = visit(f"{running.url}/ui/?scenario=sc_nothing")
    page.wait_for_selector("#lost a")
    assert "sc_nothing" in page.inner_text("#lost")
    page.click("#lost a")
    page.wait_for_selector("[data-scene=tiny]")


def test_an_unreachable_worker_is_reported(visit, make_settings):
    with running_worker(make_settings()) as running:
        page = visit(f"{running.url}/ui")
        page.click("[data-scene=tiny]")
        page.wait_for_selector("#picture[data-seq]")
        assert not page.is_visible("#gone")
    wait_until(lambda: page.is_visible("#gone"), "the message")
