"""Effects of the studio's panels on a scenario."""

from __future__ import annotations

import math
import subprocess
from typing import Any

import pytest

import real2sim
from real2sim_server.service.serve import running_worker
from tests.waiting import wait_until

from .hands import drag, enter, field, kept, place, shown

pytestmark = [pytest.mark.browser, pytest.mark.network]


def first(page: Any) -> str:
    target = shown(page, "model.scenario.objects[0].object_id")
    page.click(f".object-list button:has-text('{target}')")
    return target


def at(page: Any, share: float) -> None:
    page.evaluate(
        "async (share) => { const { model, setTime } = await import('/ui/model.js');"
        " const { start_us: a, end_us: b } = model.scenario; setTime(a + share * (b - a)); }",
        share,
    )


def test_a_move_from_now_on_does_not_change_earlier_poses(studio):
    first(studio)
    at(studio, 0)
    before = field(studio, "pose-y")
    at(studio, 0.8)
    studio.select_option("#when", "on")
    assert "from now on" in studio.inner_text("#when-mode")
    moved = field(studio, "pose-y") + 2
    enter(studio, "pose-y", moved)
    kept(studio, 1)
    assert field(studio, "pose-y") == pytest.approx(moved, abs=0.02)
    at(studio, 0)
    assert field(studio, "pose-y") == pytest.approx(before, abs=0.02)
    studio.click("#fit")
    studio.keyboard.press("Escape")
    studio.locator(".object-list button").nth(1).click()
    assert studio.input_value("#when") == "always"
    assert not studio.is_visible("#when-mode")


def test_the_shown_speed_is_the_current_one_and_an_object_can_start_later(studio):
    first(studio)
    enter(studio, "retime-speed", 2)
    kept(studio, 1)
    assert field(studio, "retime-speed") == 2
    lasts = "model.scenario.objects[0].end_us - model.scenario.objects[0].start_us"
    half = shown(studio, lasts)
    enter(studio, "retime-speed", 2)
    enter(studio, "retime-speed", 1)
    kept(studio, 2)
    assert shown(studio, lasts) == pytest.approx(2 * half, abs=2)
    start = shown(studio, "model.scenario.objects[0].start_us")
    enter(studio, "begins", field(studio, "begins") + 0.5)
    kept(studio, 3)
    assert shown(studio, "model.scenario.objects[0].start_us") == start + 500_000


def test_the_heading_of_a_moving_object_turns_its_path(studio):
    studio.click(".object-list button:has-text('car_blue')")
    at(studio, 0.4)
    place_then = field(studio, "pose-x"), field(studio, "pose-y")
    enter(studio, "heading", 42)
    kept(studio, 1)
    assert (field(studio, "pose-x"), field(studio, "pose-y")) == pytest.approx(place_then, abs=0.02)
    ends = []
    for share in (0.0, 1.0):
        at(studio, share)
        ends.append((field(studio, "pose-x"), field(studio, "pose-y")))
        assert field(studio, "heading") == pytest.approx(42, abs=0.1)
    (x0, y0), (x1, y1) = ends
    assert math.degrees(math.atan2(y1 - y0, x1 - x0)) == pytest.approx(42, abs=0.5)


def test_keys_act_on_the_focused_control(studio):
    target = first(studio)
    studio.focus("[data-tab='properties'], [role=tab] >> nth=0")
    studio.keyboard.press("Delete")
    before = shown(studio, "model.t")
    studio.focus("#next")
    studio.keyboard.press("Space")
    wait_until(lambda: shown(studio, "model.t") > before, "the next frame")
    assert studio.inner_text("#play") == "Play"
    studio.click("[data-tab='work']")
    ticked = studio.is_checked("#work-of-all")
    studio.focus("#work-of-all")
    studio.keyboard.press("Space")
    assert studio.is_checked("#work-of-all") != ticked
    assert studio.inner_text("#play") == "Play"
    # Nothing was deleted, and letter shortcuts still work.
    assert shown(studio, "model.scenario.revision") == 0
    assert shown(studio, f"model.scenario.objects.some((o) => o.object_id === '{target}')")
    studio.focus("#next")
    studio.keyboard.press("m")
    wait_until(
        lambda: studio.evaluate("document.querySelectorAll('#mosaic img[src]').length") == 2,
        "the pictures of all cameras",
    )


def test_a_control_of_the_work_list_keeps_the_focus_when_the_list_is_drawn_again(studio):
    studio.click("[data-tab='work']")
    studio.focus("#work-of-all")
    studio.evaluate("async () => await (await import('/ui/work.js')).listWork()")
    assert studio.evaluate("document.activeElement.id") == "work-of-all"


def test_fields_are_tabbed_through_and_typing_triggers_no_shortcuts(studio):
    target = first(studio)
    studio.click("#pose-x")
    studio.keyboard.type("5")
    for _ in range(3):
        studio.keyboard.press("Tab")
    kept(studio, 1)
    assert studio.evaluate("document.activeElement.id") == "heading"
    studio.keyboard.press("Delete")
    studio.keyboard.press("Tab")
    # This edit is stored after anything those keys might have done.
    enter(studio, "pose-x", 6)
    kept(studio, 2)
    assert field(studio, "pose-x") == 6
    assert shown(studio, f"model.scenario.objects.some((o) => o.object_id === '{target}')")
    assert shown(studio, "model.scenario.revision") == 2
    # Two fields edited at once are both applied.
    studio.evaluate(
        """() => ['x', 'y'].forEach((axis, k) => {
          const input = document.getElementById(`pose-${axis}`);
          input.value = String(3 + k);
          input.dispatchEvent(new Event('change'));
        })"""
    )
    kept(studio, 4)
    assert [field(studio, f"pose-{axis}") for axis in "xy"] == [3, 4]


def test_a_pose_typed_while_a_run_is_shown_is_applied(studio):
    first(studio)
    enter(studio, "velocity-x", 4)
    kept(studio, 1)
    studio.click("[data-tab=physics]")
    studio.fill("#duration", "0.3")
    studio.click("#run")
    studio.wait_for_selector("#energy")
    studio.evaluate(
        "async () => { const { span, setTime } = await import('/ui/model.js');"
        " setTime(span().end_us); }"
    )
    studio.click("[data-tab=properties]")
    studio.wait_for_url("**run=**")  # the URL updates within a quarter of a second
    link = studio.url
    enter(studio, "pose-x", 30)
    kept(studio, 2)
    assert field(studio, "pose-x") == 30
    studio.goto(link)
    studio.wait_for_selector("body[data-ready]")
    assert plotted(studio, "energy")


def plotted(page: Any, canvas: str) -> bool:
    """Whether the plot is not empty."""
    return page.evaluate(
        """id => { const c = document.getElementById(id);
          const { data } = c.getContext('2d').getImageData(0, 0, c.width, c.height);
          return data.some(Boolean); }""",
        canvas,
    )


def test_a_box_erases_and_collides_and_is_removed(studio):
    enter(studio, "box-x", 21)
    studio.click("#erase")
    kept(studio, 1)
    assert shown(studio, "model.scenario.erased[0].pose.position[0]") == 21
    studio.click("#collide")
    kept(studio, 2)
    assert shown(studio, "model.scenario.colliders[0].shape.position[0]") == 21
    studio.click("#plane")
    kept(studio, 3)
    assert studio.locator("[data-remove]").count() == 3
    studio.locator("[data-remove]").first.click()
    kept(studio, 4)
    assert shown(studio, "model.scenario.erased.length") == 0


def test_the_box_is_dragged_on_the_map_and_the_end_time_is_set(studio):
    x = field(studio, "box-x")
    drag(studio, place(studio, "#map", "map.js", "screenOfBox()"), (45, 0))
    assert field(studio, "box-x") > x + 1
    studio.click("#erase")
    kept(studio, 1)
    erased = shown(studio, "model.scenario.erased[0].pose.position[0]")
    assert erased == field(studio, "box-x")
    end = shown(studio, "model.scenario.end_us")
    enter(studio, "clock-end", end / 2e6)
    kept(studio, 2)
    assert shown(studio, "model.scenario.end_us") == end / 2


def test_an_object_saved_as_an_asset_is_inserted_and_replaces_another(studio):
    target = first(studio)
    studio.click("[data-tab=assets]")
    studio.click("button:has-text('as asset')")
    studio.click(".card button:has-text('Insert')")
    kept(studio, 1)
    assert shown(studio, "model.scenario.objects.length") == 4
    studio.click("[data-tab=properties]")
    studio.keyboard.press("Escape")
    studio.click(f".object-list button:not(:has-text('{target}')) >> nth=0")
    studio.click("[data-tab=assets]")
    studio.click(".card button:has-text('Replace')")
    kept(studio, 2)
    replaced = shown(studio, "model.scenario.objects.filter((o) => o.asset_id).length")
    assert replaced == 2


def test_a_worker_with_a_token_asks_for_it(visit, make_settings):
    with running_worker(make_settings(token="correct horse")) as running:
        page = visit(f"{running.url}/ui")
        page.wait_for_selector("#token[open]")
        page.fill("#token input", "correct horse")
        page.click("#token button")
        page.click("[data-scene=tiny]")
        page.wait_for_selector("#picture[data-seq]")


def test_copied_python_and_curl_scripts_recreate_the_scenario(studio, running):
    edited(studio)
    studio.click("[data-tab=log]")
    studio.click("#copy-python")
    script = studio.evaluate("navigator.clipboard.readText()")
    exec(compile(script, "copied", "exec"), {})
    studio.click("#copy-curl")
    script = studio.evaluate("navigator.clipboard.readText()")
    subprocess.run(["bash", "-ec", script], check=True, capture_output=True)
    with real2sim.connect(running.url) as sim:
        old, *new = (sim.scenarios.get(s.scenario_id).info for s in sim.scenarios.list())
    assert [made.objects for made in new] == [old.objects] * 2
    assert new[-1].revision == old.revision


def test_an_edit_by_another_client_updates_the_panels(studio, running):
    target = first(studio)
    x = field(studio, "pose-x")
    scenario = shown(studio, "model.scenario.scenario_id")
    with real2sim.connect(running.url) as sim:
        sim.scenarios.get(scenario).objects[target].translate(x=3)
    at(studio, 0.5)
    wait_until(lambda: shown(studio, "model.scenario.revision") == 1, "the edit")
    at(studio, 0)
    assert field(studio, "pose-x") == pytest.approx(x + 3, abs=0.02)


def edited(page: Any) -> None:
    first(page)
    enter(page, "pose-x", field(page, "pose-x") + 3)
    kept(page, 1)
    enter(page, "p-mass", 1200)
    kept(page, 2)


def test_a_fork_evolves_independently(studio):
    edited(studio)
    address = studio.url
    studio.click("#fork")
    studio.wait_for_url(lambda url: url.split("&")[0] != address.split("&")[0])
    studio.wait_for_selector("body[data-ready]")
    assert studio.inner_text("#name").endswith("(fork)")
    studio.click("#undo")
    kept(studio, 3)
    studio.goto(address)
    studio.wait_for_selector("body[data-ready]")
    kept(studio, 2)


@pytest.mark.slow
def test_a_data_set_is_estimated_created_and_previewed(studio):
    studio.click('[data-tab="datasets"]')
    enter(studio, "dataset-period", 1.0)
    enter(studio, "dataset-width", 96)
    studio.click("#estimate-dataset")
    studio.wait_for_selector("#dataset-told")
    assert "3 frames, 6 images" in studio.inner_text("#dataset-told")
    studio.click("#make-dataset")
    studio.wait_for_selector(".dataset-entry[open] .sheets img")
    width = "document.querySelector('.sheets img').naturalWidth"
    wait_until(lambda: studio.evaluate(width), "a picture")
    rows = studio.inner_text(".dataset-entry[open] table")
    assert "car\t6" in rows
    assert studio.locator(".shares").count() >= 3
    studio.locator(".sheets img").first.click()
    assert studio.evaluate("document.getElementById('sheet').open")
