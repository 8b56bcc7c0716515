"""Driving in the studio, and its list of jobs."""

from __future__ import annotations

from typing import Any

import pytest

from tests.waiting import wait_until

from .hands import enter, field, kept, shown

RECORDED = ["car_red", "car_blue", "post"]
pytestmark = [pytest.mark.browser, pytest.mark.network]


def driven(page: Any, text: str) -> None:
    page.wait_for_selector(f"#drive-now:has-text('{text}')")


def test_a_planner_is_watched_held_and_replaced_by_hand_driving(studio):
    studio.click("[data-tab=drive]")
    studio.select_option("#drive-who", "follow_route")
    studio.select_option("#drive-pace", "0.25")
    studio.click("#drive-start")
    driven(studio, "plans in")
    assert "follow_route drives" in studio.inner_text("#drive-now")
    studio.wait_for_selector("#rate:text-is('live')")
    assert shown(studio, "model.live.plan.length") > 1

    studio.keyboard.press("Space")
    driven(studio, "held")
    held = shown(studio, "model.live.step")
    studio.click("#drive-step")
    driven(studio, f"step {held + 1} ")

    # Watching continues after a reload.
    studio.reload()
    studio.wait_for_selector("body[data-ready]")
    driven(studio, f"held · step {held + 1} ")

    studio.click("#drive-wheel")
    studio.keyboard.down("ArrowUp")
    studio.wait_for_selector("#drive-over")
    studio.keyboard.up("ArrowUp")
    assert studio.locator("#drive-figures div").count() > 3
    steps = shown(studio, "model.playback.steps.length")
    assert steps > held + 3
    ego = "(await import('/ui/model.js')).egoPoseAt(model.t).position[0]"
    began = shown(studio, ego)
    studio.evaluate(
        "async () => { const m = await import('/ui/model.js'); m.setTime(m.span().end_us); }"
    )
    assert shown(studio, ego) > began

    studio.click("[data-tab=work]")
    studio.wait_for_selector(".work.succeeded:has-text('by hand')")
    assert studio.locator(".work").count() == 2
    studio.click(".work:has-text('follow_route') button:text-is('Show')")
    studio.wait_for_selector("#drive-over")
    assert shown(studio, "model.playback.steps.length") < steps
    studio.click("#drive-leave")
    studio.wait_for_selector("#drive-start")


def test_jobs_are_listed_with_their_files_after_a_reload(studio):
    studio.click("[data-tab=work]")
    studio.wait_for_selector("#work:has-text('No jobs yet')")
    studio.click("#make-video")
    studio.wait_for_selector(".work.succeeded:has-text('Film')")
    studio.reload()
    studio.wait_for_selector(".work.succeeded:has-text('Film')")
    with studio.expect_download() as got:
        studio.click(".work button:text-is('Film')")
    assert got.value.suggested_filename.endswith(".webm")
    studio.click("[data-tab=drive]")
    studio.select_option("#drive-who", "other")
    studio.click("#drive-start")
    studio.wait_for_selector("#drive:has-text('real2sim drive --session')")
    studio.click("[data-tab=work]")
    studio.click(".work.running button:text-is('Cancel')")
    studio.wait_for_selector(".work.cancelled")
    studio.click(".work.cancelled button:text-is('Delete')")
    studio.wait_for_selector(".work.cancelled", state="detached")
    assert studio.locator(".work").count() == 1


def test_a_corner_case_is_applied_removed_and_restored(studio):
    studio.click("[data-tab=drive]")
    studio.select_option("#corner-case", "cut_in")
    studio.wait_for_selector("#drive:has-text('a car moves in from the left')")
    size = studio.evaluate(
        "async () => { const i = document.getElementById('corner-case-picture');"
        " await i.decode(); return i.naturalWidth / i.naturalHeight; }"
    )
    assert size == pytest.approx(3.0, abs=0.1)
    enter(studio, "case-gap", 8.0)
    studio.click("#take-case")
    studio.wait_for_selector("#corner-case-now:has-text('Cut-in')")
    kept(studio, 1)
    board = studio.evaluate(
        "async () => { const { model } = await import('/ui/model.js');"
        " return (await fetch(`/v1/scenarios/${model.scenario.scenario_id}/storyboard`)).json(); }"
    )
    assert board["parameters"]["gap"] == 8.0
    studio.click("#drop-case")
    studio.wait_for_selector("#corner-case-now", state="detached")
    kept(studio, 2)
    studio.keyboard.press("Control+z")
    studio.wait_for_selector("#corner-case-now:has-text('Cut-in')")


def held_drive(studio: Any) -> None:
    """Start a planner and hold it."""
    studio.click("[data-tab=drive]")
    studio.select_option("#drive-who", "follow_route")
    studio.select_option("#drive-pace", "0.25")
    studio.click("#drive-start")
    driven(studio, "plans in")
    studio.keyboard.press("Space")
    driven(studio, "held")


def test_the_mosaic_shows_all_cameras_of_the_live_drive(studio):
    held_drive(studio)
    asked: list[str] = []
    studio.on("request", lambda request: asked.append(request.url))
    studio.click("[data-camera='*']")
    studio.wait_for_selector("#mosaic figure[data-camera=left] img[src]")
    assert sum("/render" in url for url in asked) >= 2
    assert not any("/preview" in url for url in asked)
    # After another step, the images differ.
    source = "document.querySelector('#mosaic figure[data-camera=left] img').src"
    before = studio.evaluate(source)
    studio.click("#drive-step")
    studio.wait_for_function(f"before => {source} !== before", arg=before)


def test_edits_while_driving_change_the_drive_but_not_the_scenario(studio):
    held_drive(studio)
    studio.click("[data-tab=properties]")
    studio.click("#properties button:has-text('post')")
    before = field(studio, "pose-y")
    enter(studio, "pose-y", before + 2.0)
    place = "model.live.agents.find((a) => a.object_id === 'post').position[1]"
    wait_until(lambda: shown(studio, place) == pytest.approx(before + 2.0), "the post to move")
    assert field(studio, "pose-y") == pytest.approx(before + 2.0)
    studio.click("[data-action=duplicate]")
    studio.wait_for_selector("#selected-name:has-text('post_copy1')")
    studio.keyboard.press("Escape")
    assert studio.locator("#properties button:has-text('post_copy1')").count() == 1
    studio.keyboard.press("Control+z")
    studio.wait_for_selector("text=cannot be undone")
    kept(studio, 0)
    studio.click("[data-tab=drive]")
    studio.click("#drive-end")
    studio.wait_for_selector("#drive-over")
    assert shown(studio, "model.scenario.objects.map((o) => o.object_id)") == RECORDED


def test_storyboard_entities_are_in_the_list_and_on_the_map(studio):
    studio.click("[data-tab=drive]")
    studio.select_option("#corner-case", "cut_in")
    studio.click("#take-case")
    kept(studio, 1)
    held_drive(studio)
    brought = shown(studio, "model.live.agents.map((a) => a.object_id)")
    (entity,) = set(brought) - set(RECORDED)
    studio.click("[data-tab=properties]")
    studio.click(f"#properties button:has-text('{entity}')")
    studio.wait_for_selector(f"#selected-name:has-text('{entity}')")
    on_map = studio.evaluate("async () => (await import('/ui/map_view.js')).shown()")
    assert {o["object_id"] for o in on_map} == set(brought)
