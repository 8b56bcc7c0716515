"""Renaming, deleting and undeleting in the studio."""

from __future__ import annotations

from typing import Any

import pytest

import real2sim
from tests.waiting import wait_until

pytestmark = [pytest.mark.browser, pytest.mark.network]


@pytest.fixture
def client(running):
    with real2sim.connect(running.url) as opened:
        yield opened


def names(client) -> list[str]:
    return sorted(info.name for info in client.scenarios.list())


def answer(page: Any, text: str) -> None:
    page.once("dialog", lambda dialog: dialog.accept(text))


def test_scenarios_are_renamed_deleted_and_restored(page, client):
    kept = client.scenarios.create(scene="tiny", name="rain")
    client.scenarios.create(scene="tiny", name="snow")
    page.reload()
    card = page.locator(f"[data-scenario='{kept.scenario_id}']")
    answer(page, "hail")
    card.get_by_text("Rename").click()
    page.wait_for_selector("#scenario-list :text-is('hail')")
    assert names(client) == ["hail", "snow"]

    page.click("[aria-label='Delete snow']")
    page.wait_for_selector("[aria-label='Delete snow']", state="detached")
    page.click(".message button:text-is('Undo')")
    page.wait_for_selector("[aria-label='Delete snow']")
    page.click("[aria-label='Delete snow']")
    page.reload()
    page.wait_for_selector("[data-scenario]")
    assert page.locator("[data-scenario]").count() == 1
    wait_until(lambda: names(client) == ["hail"], "the others to go")

    card.get_by_text("hail").click()
    page.wait_for_selector("body[data-ready]")
    answer(page, "sun")
    page.click("#rename")
    page.wait_for_selector("#name:text-is('sun')")
    assert names(client) == ["sun"]


def test_an_asset_in_use_names_its_scenario_and_an_unused_one_is_restored(studio, client):
    for asset_id in ("used", "spare"):
        client.assets.cut(scene="tiny", object_id="post", asset_id=asset_id)
    (info,) = client.scenarios.list()
    client.scenarios.get(info.scenario_id).insert("used", position=(6.0, 2.0, 0.0))
    studio.reload()
    studio.wait_for_selector("body[data-ready]")
    studio.click("[data-tab=assets]")
    delete = "#assets .card:has-text('{}') button:text-is('Delete')"
    studio.click(delete.format("used"))
    studio.wait_for_selector(f".message.bad:has-text('{info.name}')")
    studio.click(delete.format("spare"))
    studio.wait_for_selector(delete.format("spare"), state="detached")
    studio.click(".message button:text-is('Undo')")
    studio.wait_for_selector(delete.format("spare"))
    assert sorted(asset.asset_id for asset in client.assets.list()) == ["spare", "used"]
