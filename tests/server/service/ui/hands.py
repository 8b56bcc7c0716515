"""User actions in the studio, and values read from it."""

from __future__ import annotations

from typing import Any
from urllib.parse import parse_qs, urlsplit

from tests.waiting import LIMIT_S, wait_until

STEP_MS = LIMIT_S * 1e3


def place(page: Any, canvas: str, module: str, call: str) -> tuple[float, float]:
    """Page position of something, computed by a module of the studio [px]."""
    inside = page.evaluate(f"async () => (await import('/ui/{module}')).{call}")
    box = page.locator(canvas).bounding_box()
    return box["x"] + inside[0], box["y"] + inside[1]


def drag(page: Any, start: tuple[float, float], by: tuple[float, float]) -> None:
    """Press, move and release the mouse."""
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + by[0], start[1] + by[1], steps=5)
    page.mouse.up()


def kept(page: Any, revision: int) -> None:
    """Wait until the page shows this revision."""
    page.wait_for_selector(f"#saved:text-is('kept · r{revision}')")


def field(page: Any, name: str) -> float:
    """Value of a number field."""
    return float(page.input_value(f"#{name}"))


def enter(page: Any, name: str, value: float) -> None:
    """Type a number into a field."""
    page.fill(f"#{name}", f"{value:g}")
    page.press(f"#{name}", "Enter")


def shown(page: Any, expression: str) -> Any:
    """A value of the studio's state, as a JavaScript expression on its ``model``."""
    return page.evaluate(
        f"async () => {{ const {{ model }} = await import('/ui/model.js'); return {expression}; }}"
    )


def address(page: Any) -> dict[str, str]:
    """State in the page's URL, which updates within a quarter of a second."""
    return {k: v[0] for k, v in parse_qs(urlsplit(page.evaluate("location.href")).query).items()}


def wait_address(page: Any, **values: str) -> None:
    """Wait until the URL has this state."""
    wait_until(lambda: values.items() <= address(page).items(), lambda: f"{values} in {page.url}")


def behind(app: Any, prefix: str, *, forwarded: bool) -> Any:
    """The application as seen through a proxy that removes a prefix from paths.

    Args:
        app: ASGI application.
        prefix: path without a slash at its end; only ``/readyz`` is found outside of it.
        forwarded: whether the proxy sends ``X-Forwarded-Prefix``.
    """

    async def proxy(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan" or scope["path"] == "/readyz":
            await app(scope, receive, send)
            return
        inside = scope["path"].startswith(prefix + "/")
        path = scope["path"].removeprefix(prefix) if inside else "/outside"
        headers = [*scope["headers"]]
        if forwarded:
            headers.append((b"x-forwarded-prefix", f"{prefix}/".encode()))
        changes = {"path": path, "raw_path": path.encode(), "headers": headers}
        await app({**scope, **changes}, receive, send)

    return proxy
