"""A user edits a scene with the mouse."""

from __future__ import annotations

import pytest

from .hands import drag, field, kept, place, shown, wait_address

pytestmark = [pytest.mark.browser, pytest.mark.network]


def test_a_user_edits_simulates_and_reloads(page):
    page.click("[data-scene=tiny]")
    page.wait_for_selector("body[data-ready]")
    page.wait_for_selector("#picture[data-seq]")
    target = shown(page, "model.scenario.objects[0].object_id")

    page.mouse.click(*place(page, "#stage", "camera_view.js", f"stagePlace('{target}')"))
    page.wait_for_selector(f"#selected-name:text-is('{target}')")

    x = field(page, "pose-x")
    drag(page, place(page, "#map", "map.js", f"screenOf('{target}')"), (36, -18))
    kept(page, 1)
    assert field(page, "pose-x") > x + 1

    heading = field(page, "heading")
    drag(page, place(page, "#map", "map.js", "handleAt()"), (-6, -30))
    kept(page, 2)
    turned = field(page, "heading")
    assert turned > heading + 5

    page.click("#undo")
    kept(page, 3)
    assert field(page, "heading") == pytest.approx(heading, abs=0.01)
    page.click("#redo")
    kept(page, 4)
    assert field(page, "heading") == pytest.approx(turned, abs=0.01)

    page.click("[data-action=duplicate]")
    kept(page, 5)
    twin = page.inner_text("#selected-name")
    assert twin != target

    page.fill("#velocity-x", "4")
    page.press("#velocity-x", "Enter")
    kept(page, 6)

    page.click("[data-tab=physics]")
    page.fill("#duration", "0.3")
    page.click("#run")
    page.wait_for_selector("#energy")
    page.click("#play")
    page.wait_for_selector("#play:text-is('Play')")
    page.click("#leave-run")

    wait_address(page, selected=twin, scenario=shown(page, "model.scenario.scenario_id"))
    page.reload()
    page.wait_for_selector("body[data-ready]")
    kept(page, 6)
    assert page.inner_text("#selected-name") == twin
    assert field(page, "velocity-x") == 4
    page.click("[data-tab=log]")
    assert page.locator(".entry").count() == 4
