"""Authorisation: bearer tokens, their roles, and protection of workers without a token.

Each role includes the previous ones: ``observe`` reads; ``drive`` uses sessions and sweeps;
``edit`` creates scenarios, assets and jobs; ``administer`` adds scenes and loads or unloads
them.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Callable, Coroutine
from typing import Annotated, Any
from urllib.parse import urlsplit

from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from real2sim_proto import ErrorCode

from ..accounts import ACCOUNT, ROLES, Account, Role
from .responses import ServiceError

FOREIGN_PAGE = 4403
"""Close code for sockets of other sites' pages."""
PAGES = ("/", "/ui", "/ui/", "/docs")
"""Pages that other sites may link to."""
OWN = ("same-origin", "none")
"""Values of Sec-Fetch-Site for the worker's own pages, and for addresses typed by the user."""


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
    """Whether a page of this worker sent the request; a proxy may have changed the scheme."""
    try:
        return host is not None and urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False


_HINT = (
    "call from a program, or from a page that the worker itself serves; a proxy has to pass on the "
    "Host that the browser sent"
)


def _refusal(scope: Scope, headers: Headers) -> str | None:
    """Reason for refusing a request, or None."""
    origin, host = headers.get("origin"), headers.get("host")
    if origin is not None and not same_origin(origin, host):
        return f"a page of {origin[:200]!r} called a worker at {(host or '')[:200]!r}"
    site = headers.get("sec-fetch-site")
    if site is None or site in OWN or _is_link(scope, headers):
        return None
    return f"a page of another site called (Sec-Fetch-Site: {site[:40]})"


def _is_link(scope: Scope, headers: Headers) -> bool:
    """Whether the user follows a link to a page of the worker in a top-level window."""
    return (
        scope["type"] == "http"
        and scope["method"] in ("GET", "HEAD")
        and scope["path"] in PAGES
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
    )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class LoopbackOnly:
    """ASGI middleware that refuses requests for another host.

    Any site can resolve its own name to 127.0.0.1 (DNS rebinding); the ``Host`` header reveals it.
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


WORKER_SCHEME, SESSION_SCHEME = "WorkerToken", "SessionToken"
"""Names of the security schemes in the OpenAPI document."""

_bearer = HTTPBearer(
    auto_error=False,
    scheme_name=WORKER_SCHEME,
    description=(
        "`Authorization: Bearer` with a token of the worker: `REAL2SIM_TOKEN`, or a "
        "named token of `REAL2SIM_TOKENS_FILE`. A worker without tokens needs none. It "
        "also opens every session."
    ),
)


class OpenBindError(ValueError):
    """A public address, without a token."""


def check_bind(host: str, token: object) -> None:
    """Refuse to listen on public interfaces without a token or a token file.

    Raises:
        OpenBindError: the address is public; the message states the remedy.
    """
    if token or is_loopback(host):
        return
    raise OpenBindError(
        f"refusing to listen on {host!r} without a token: anyone who reaches it could drive and "
        "edit. Set REAL2SIM_TOKEN (for example to the output of `openssl rand -hex 16`) or "
        "REAL2SIM_TOKENS_FILE (see `real2sim token`), or listen on 127.0.0.1"
    )


def secrets_equal(given: str | None, expected: str) -> bool:
    """Compare in constant time."""
    return hmac.compare_digest((given or "").encode(), expected.encode())


async def require_token(
    _credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
    connection: HTTPConnection,
) -> None:
    """Dependency of every protected route.

    Raises:
        ServiceError: UNAUTHORIZED.
    """
    check_token(connection)


def check_token(connection: HTTPConnection) -> None:
    """Find the account of a request with a token of the worker, and admit the request.

    Raises:
        ServiceError: UNAUTHORIZED.
        OverLimitError: the account's request limit is reached.
    """
    if account_of(connection.scope) is not None:
        return  # Its route has already checked the token.
    worker = connection.app.state.worker
    given = bearer_token(connection)
    account: Account | None = worker.accounts.of_token(given)
    if account is None:
        worker.metrics.auth_failures.labels("http").inc()
        if given is None:
            raise unauthorized("this worker requires a bearer token")
        raise unauthorized("the bearer token is not this worker's")
    act_for(connection, account)


def bearer_token(connection: HTTPConnection) -> str | None:
    """The token of ``Authorization: Bearer``, or None."""
    scheme, _, given = connection.headers.get("Authorization", "").partition(" ")
    return given.strip() or None if scheme.lower() == "bearer" else None


class TokenRoute(APIRoute):
    """A route that checks the worker's token before reading the request."""

    async def check(self, request: Request) -> None:
        """Raises ServiceError: UNAUTHORIZED."""
        check_token(request)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """FastAPI's handler, after the check."""
        handle = super().get_route_handler()

        async def checked(request: Request) -> Response:
            await self.check(request)
            return await handle(request)

        return checked


def unauthorized(detail: str) -> ServiceError:
    """UNAUTHORIZED, with the header that RFC 9110 requires."""
    return ServiceError(
        ErrorCode.UNAUTHORIZED,
        detail,
        hint="send 'Authorization: Bearer <token>' with a token of the worker's operator",
        headers={"WWW-Authenticate": "Bearer"},
    )


_ACCOUNT_KEY = "real2sim.account"


def account_of(scope: Scope) -> Account | None:
    """The account of a request or a socket; None until its token is checked."""
    account: Account | None = scope.get(_ACCOUNT_KEY)
    return account


def act_for(connection: HTTPConnection, account: Account) -> None:
    """Charge the running task to ``account``.

    Raises:
        RevokedError: the account's token has been removed.
        OverLimitError: the account's request limit is reached.
        ServiceError: FORBIDDEN: the account's role does not allow the request.
    """
    connection.scope[_ACCOUNT_KEY] = account
    check_role(connection, account.role, name=account.name)
    account.admit()
    ACCOUNT.set(account)


READING = frozenset({"GET", "HEAD", "OPTIONS"})

_NEEDED: tuple[tuple[re.Pattern[str], Role], ...] = (
    # POST because the body selects the view; the call changes nothing.
    (re.compile(r"/v1/scenes/[^/]+/render"), "observe"),
    (re.compile(r"/v1/scenes(/.*)?"), "administer"),
    (re.compile(r"/v1/sessions(/.*)?"), "drive"),
    (re.compile(r"/v1/sweeps"), "drive"),
)
"""Roles of requests that change something, by path; the first match applies."""


def needed_role(method: str, path: str) -> Role:
    """The role that a request requires.

    Args:
        method: HTTP method; ``WEBSOCKET`` for a socket.
        path: path of the URL.
    """
    if method == "WEBSOCKET":
        return "drive" if path.startswith("/v1/sessions") else "observe"
    if method in READING:
        return "observe"
    return next((role for pattern, role in _NEEDED if pattern.fullmatch(path)), "edit")


def check_role(connection: HTTPConnection, role: Role, *, name: str) -> None:
    """Refuse a request that a token's role does not allow.

    Args:
        connection: request or socket.
        role: role of the token.
        name: name of the token.

    Raises:
        ServiceError: FORBIDDEN.
    """
    scope = connection.scope
    method = str(scope.get("method", "WEBSOCKET"))
    needed = needed_role(method, str(scope["path"]))
    if ROLES.index(role) >= ROLES.index(needed):
        return
    raise ServiceError(
        ErrorCode.FORBIDDEN,
        f"the token {name!r} may {role}; this needs a token that may {needed}",
        hint=f"ask the operator for one: `real2sim token add NAME --role {needed}`",
    )
