"""Who may call: one bearer token for the worker, and no open door beyond this machine."""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection

from real2sim_proto import ErrorCode

from .problems import ServiceError

_bearer = HTTPBearer(auto_error=False, description="the worker's token; none where it has none")


class OpenBindError(ValueError):
    """An address that others can reach, without a token."""


def check_bind(host: str, token: str | None) -> None:
    """Refuse to listen beyond this machine without a token.

    Raises:
        OpenBindError: saying what to do.
    """
    if token or is_loopback(host):
        return
    raise OpenBindError(
        f"refusing to listen on {host!r} without a token: anyone who reaches it could drive and "
        "edit. Set REAL2SIM_TOKEN (for example to the output of `openssl rand -hex 16`), or listen "
        "on 127.0.0.1"
    )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def secrets_equal(given: str | None, expected: str) -> bool:
    """Compare in a time that does not depend on where the two differ."""
    return hmac.compare_digest((given or "").encode(), expected.encode())


def matches_any_secret(given: str | None, *secrets: str | None) -> bool:
    """Whether ``given`` is one of ``secrets``; None is no secret."""
    # All are compared, so that the duration reveals nothing.
    matches = [secrets_equal(given, secret) for secret in secrets if secret is not None]
    return any(matches)


async def require_token(
    _credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
    connection: HTTPConnection,
) -> None:
    """Dependency of every route that is not open.

    Raises:
        ServiceError: UNAUTHORIZED.
    """
    check_token(connection)


def check_token(connection: HTTPConnection) -> None:
    """Raises ServiceError: UNAUTHORIZED, unless a request carries the worker's token."""
    worker = connection.app.state.worker
    secret = worker.settings.token
    if secret is None:
        return
    given = bearer_token(connection)
    if not secrets_equal(given, secret.get_secret_value()):
        worker.metrics.auth_failures.labels("http").inc()
        if given is None:
            raise unauthorized("this worker wants a bearer token")
        raise unauthorized("the bearer token is not this worker's")


def bearer_token(connection: HTTPConnection) -> str | None:
    """What stands behind ``Authorization: Bearer``; None where nothing does."""
    scheme, _, given = connection.headers.get("Authorization", "").partition(" ")
    return given.strip() or None if scheme.lower() == "bearer" else None


class TokenRoute(APIRoute):
    """A route that checks the worker's token before anything of the request is read."""

    async def check(self, request: Request) -> None:
        """Raises ServiceError: UNAUTHORIZED."""
        check_token(request)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """FastAPI's handler, behind the check."""
        handle = super().get_route_handler()

        async def checked(request: Request) -> Response:
            await self.check(request)
            return await handle(request)

        return checked


def unauthorized(detail: str) -> ServiceError:
    """UNAUTHORIZED, with the header that RFC 9110 asks for."""
    return ServiceError(
        ErrorCode.UNAUTHORIZED,
        detail,
        hint="send 'Authorization: Bearer <token>' with the worker's REAL2SIM_TOKEN",
        headers={"WWW-Authenticate": "Bearer"},
    )
