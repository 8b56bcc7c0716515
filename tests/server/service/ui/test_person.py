"""A person edits a scene with the mouse; needs Playwright and a Chromium of the system."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

from real2sim_server.service.serve import running_worker

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.network,
    pytest.mark.skipif(not BROWSER, reason="no chromium on the PATH"),
]
STEP_MS = 60_000


@pytest.fixture
def page(make_settings) -> Iterator:
    with running_worker(make_settings()) as running, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.set_default_timeout(STEP_MS)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"{running.url}/ui")
        yield page
        browser.close()
        assert errors == []


def place(page, canvas: str, module: str, call: str) -> tuple[float, float]:
    inside = page.evaluate(f"async () => (await import('/ui/{module}')).{call}")
    box = page.locator(canvas).bounding_box()
    return box["x"] + inside[0], box["y"] + inside[1]


def drag(page, start: tuple[float, float], by: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + by[0], start[1] + by[1], steps=5)
    page.mouse.up()


def kept(page, revision: int) -> None:
    sync_api.expect(page.locator("#saved")).to_have_text(f"kept · r{revision}", timeout=STEP_MS)


def field(page, name: str) -> float:
    return float(page.input_value(f"#{name}"))


def test_a_person_edits_runs_and_finds_everything_again(page):
    page.click("[data-scene=tiny]")
    page.wait_for_selector("body[data-ready]")
    page.wait_for_selector("#picture[data-seq]")
    target = page.evaluate(
        "async () => { const { model } = await import('/ui/model.js');"
        " return model.scenario.objects[0].object_id; }"
    )

    page.mouse.click(*place(page, "#stage", "camera_view.js", f"stagePlace('{target}')"))
    sync_api.expect(page.locator("#selected-name")).to_have_text(target)

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
    sync_api.expect(page.locator("#play")).to_have_text("Play", timeout=STEP_MS)
    page.click("#leave-run")

    page.wait_for_timeout(500)  # the address follows within a quarter of a second
    page.reload()
    page.wait_for_selector("body[data-ready]")
    kept(page, 6)
    assert page.inner_text("#selected-name") == twin
    assert field(page, "velocity-x") == 4
    page.click("[data-tab=log]")
    assert page.locator(".entry").count() == 4
