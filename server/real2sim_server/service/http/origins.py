"""Pages of other sites may not use a browser to call a worker, with a token or without one.

Browsers say where a request comes from: ``Sec-Fetch-Site`` (W3C Fetch Metadata) on every request to
a trustworthy address, ``Origin`` on those that may change something and on sockets. Programs send
neither, and are not concerned.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from real2sim_proto import ErrorCode

from .problems import ServiceError

FOREIGN_PAGE = 4403
"""Code with which sockets of other sites' pages are closed."""
PAGES = ("/", "/ui", "/ui/", "/docs")
"""What a link on another site may lead to."""
OWN = ("same-origin", "none")
"""Requests of our own pages, and of persons who type an address."""


class OwnPagesOnly:
    """ASGI middleware that refuses requests and sockets of other sites' pages."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] in ("http", "websocket"):
            headers = Headers(scope=scope)
            refusal = _refusal(scope, headers)
            if refusal is not None:
                if scope["type"] == "http":
                    raise ServiceError(ErrorCode.FOREIGN_PAGE, refusal, hint=_HINT)
                await receive()
                closing = {"type": "websocket.close", "code": FOREIGN_PAGE}
                await send(closing | {"reason": "pages of other sites may not call"})
                return
        await self._app(scope, receive, send)


def same_origin(origin: str, host: str | None) -> bool:
    """Whether a page of this worker asks; its scheme may be that of a proxy."""
    try:
        return host is not None and urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False


_HINT = (
    "call from a program, or from a page that the worker itself serves; a proxy has to pass on the "
    "Host that the browser sent"
)


def _refusal(scope: Scope, headers: Headers) -> str | None:
    """Why a request is refused; None where it is not."""
    origin, host = headers.get("origin"), headers.get("host")
    if origin is not None and not same_origin(origin, host):
        return f"a page of {origin[:200]!r} called a worker at {(host or '')[:200]!r}"
    site = headers.get("sec-fetch-site")
    if site is None or site in OWN or _is_link(scope, headers):
        return None
    return f"a page of another site called (Sec-Fetch-Site: {site[:40]})"


def _is_link(scope: Scope, headers: Headers) -> bool:
    """Whether a person follows a link to one of our pages, in a window of its own."""
    return (
        scope["type"] == "http"
        and scope["method"] in ("GET", "HEAD")
        and scope["path"] in PAGES
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
    )
