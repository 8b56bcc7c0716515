"""Which role a request needs: each is all that the one before it is, and more.

``observe`` reads; ``drive`` has sessions and sweeps; ``edit`` makes scenarios, assets and jobs;
``administer`` adds scenes and moves them in and out of memory.
"""

from __future__ import annotations

import re

from starlette.requests import HTTPConnection

from real2sim_proto import ErrorCode

from ..token_file import ROLES, Role
from .problems import ServiceError

READING = frozenset({"GET", "HEAD", "OPTIONS"})

_NEEDED: tuple[tuple[re.Pattern[str], Role], ...] = (
    # Its body says what to draw; nothing is changed.
    (re.compile(r"/v1/scenes/[^/]+/render"), "observe"),
    (re.compile(r"/v1/scenes(/.*)?"), "administer"),
    (re.compile(r"/v1/sessions(/.*)?"), "drive"),
    (re.compile(r"/v1/sweeps"), "drive"),
)
"""Of requests that change something, by path; the first that fits counts."""


def needed_role(method: str, path: str) -> Role:
    """What a request needs.

    Args:
        method: of HTTP; ``WEBSOCKET`` for a socket.
        path: of the URL.
    """
    if method == "WEBSOCKET":
        return "drive" if path.startswith("/v1/sessions") else "observe"
    if method in READING:
        return "observe"
    return next((role for pattern, role in _NEEDED if pattern.fullmatch(path)), "edit")


def check_role(connection: HTTPConnection, role: Role, *, name: str) -> None:
    """Refuse what a token's role does not allow.

    Args:
        connection: request or socket.
        role: of the token.
        name: of the token.

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
