"""What a person does in the studio, and reads there."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

STEP_MS = 60_000


def place(page: Any, canvas: str, module: str, call: str) -> tuple[float, float]:
    """Where something is on the page, as a module of the studio tells [px]."""
    inside = page.evaluate(f"async () => (await import('/ui/{module}')).{call}")
    box = page.locator(canvas).bounding_box()
    return box["x"] + inside[0], box["y"] + inside[1]


def drag(page: Any, start: tuple[float, float], by: tuple[float, float]) -> None:
    """Take, move, let go."""
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + by[0], start[1] + by[1], steps=5)
    page.mouse.up()


def kept(page: Any, revision: int) -> None:
    """Wait until the page shows this revision."""
    page.wait_for_selector(f"#saved:text-is('kept · r{revision}')")


def field(page: Any, name: str) -> float:
    """A number in a field."""
    return float(page.input_value(f"#{name}"))


def enter(page: Any, name: str, value: float) -> None:
    """Type a number into a field."""
    page.fill(f"#{name}", f"{value:g}")
    page.press(f"#{name}", "Enter")


def shown(page: Any, expression: str) -> Any:
    """A value of what the studio shows, as JavaScript on its ``model``."""
    return page.evaluate(
        f"async () => {{ const {{ model }} = await import('/ui/model.js'); return {expression}; }}"
    )


def until(condition: Callable[[], bool]) -> None:
    """Wait until it holds.

    Raises:
        TimeoutError: it did not.
    """
    give_up = time.monotonic() + STEP_MS / 1e3
    while not condition():
        if time.monotonic() > give_up:
            raise TimeoutError(f"{condition} did not become true")
        time.sleep(0.05)
