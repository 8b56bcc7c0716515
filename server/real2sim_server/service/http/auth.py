"""Who may call: one bearer token for the worker, and no open door beyond this machine."""

from __future__ import annotations

import hmac
import ipaddress
from typing import Annotated

from fastapi import Depends
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
    connection: HTTPConnection,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> None:
    """Dependency of every route that is not open.

    Raises:
        ServiceError: UNAUTHORIZED.
    """
    secret = connection.app.state.worker.settings.token
    if secret is None:
        return
    if credentials is None:
        raise unauthorized("this worker wants a bearer token")
    if not secrets_equal(credentials.credentials, secret.get_secret_value()):
        raise unauthorized("the bearer token is not this worker's")


def unauthorized(detail: str) -> ServiceError:
    """UNAUTHORIZED, with the header that RFC 9110 asks for."""
    return ServiceError(
        ErrorCode.UNAUTHORIZED,
        detail,
        hint="send 'Authorization: Bearer <token>' with the worker's REAL2SIM_TOKEN",
        headers={"WWW-Authenticate": "Bearer"},
    )
