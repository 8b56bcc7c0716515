"""A worker without a token answers this machine alone, whatever a web page tells its browser."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from real2sim_proto import ErrorCode

from .origins import FOREIGN_PAGE
from .problems import ServiceError


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class LoopbackOnly:
    """ASGI middleware that refuses requests which name another host.

    Any site may point a name of its own at 127.0.0.1 (DNS rebinding); ``Host`` tells.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "http":
            _check(Headers(scope=scope))
        elif scope["type"] == "websocket" and not _is_from_here(Headers(scope=scope)):
            await receive()
            await send({"type": "websocket.close", "code": FOREIGN_PAGE, "reason": "foreign host"})
            return
        await self._app(scope, receive, send)


def _check(headers: Headers) -> None:
    if _is_from_here(headers):
        return
    raise ServiceError(
        ErrorCode.UNAUTHORIZED,
        f"Host {headers.get('host')!r}: a worker without a token answers requests to localhost or "
        "a loopback address",
        hint="set REAL2SIM_TOKEN on the worker to let others in",
    )


def _is_from_here(headers: Headers) -> bool:
    return _names_loopback(f"//{headers.get('host', 'localhost')}")


def _names_loopback(address: str) -> bool:
    try:
        host = urlsplit(address).hostname
    except ValueError:
        return False
    return host is not None and is_loopback(host)
