"""A browser with a worker. Needs Playwright and a system Chromium."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from real2sim_server.service.serve import RunningWorker, running_worker

from .hands import STEP_MS, kept

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""Lightest first."""
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), "")


@pytest.fixture(scope="module")
def browser_args() -> list[str]:
    """Command-line arguments of the browser."""
    return ["--no-sandbox"]


@pytest.fixture(scope="module")
def chromium(browser_args: list[str]) -> Iterator[Any]:
    """A headless browser. Skips if there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not BROWSER:
        pytest.skip("no chromium on the PATH")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=browser_args)
        yield browser
        browser.close()


@pytest.fixture
def running(make_settings) -> Iterator[RunningWorker]:
    """A worker with the tiny scene."""
    with running_worker(make_settings()) as worker:
        yield worker


@pytest.fixture
def visit(chromium) -> Iterator[Callable[[str], Any]]:
    """Open pages. At the end of the test, no page may have raised an error."""
    errors: list[str] = []
    with ExitStack() as stack:

        def open_page(url: str) -> Any:
            context = chromium.new_context(
                viewport={"width": 1440, "height": 900},
                permissions=["clipboard-read", "clipboard-write"],
            )
            stack.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(STEP_MS)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(url)
            return page

        yield open_page
    assert errors == []


@pytest.fixture
def page(visit, running) -> Any:
    """The start page of the studio."""
    return visit(f"{running.url}/ui")


@pytest.fixture
def looking(page) -> Any:
    """The studio with the recorded tiny scene."""
    page.click("[data-scene=tiny]")
    page.wait_for_selector("body[data-ready]")
    return page


@pytest.fixture
def studio(looking) -> Any:
    """The studio with a new scenario on the tiny scene."""
    looking.evaluate("async () => (await import('/ui/model.js')).own()")
    kept(looking, 0)
    return looking
