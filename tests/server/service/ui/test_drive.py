"""Driving in the studio, and the work that it lists."""

from __future__ import annotations

from typing import Any

import pytest

from .hands import enter, kept, shown

pytestmark = [pytest.mark.browser, pytest.mark.network]


def driven(page: Any, text: str) -> None:
    page.wait_for_selector(f"#drive-now:has-text('{text}')")


def test_a_planner_is_watched_held_and_relieved_and_the_drive_is_read_afterwards(studio):
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

    # A reload goes on watching.
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


def test_work_shows_what_is_left_and_is_found_again_after_a_reload(studio):
    studio.click("[data-tab=work]")
    studio.wait_for_selector("#work:has-text('No work yet')")
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


def test_a_corner_case_is_chosen_by_its_picture_taken_over_undone_and_dropped(studio):
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
