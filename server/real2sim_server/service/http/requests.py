"""What surrounds every request: its id, its log line, its duration, uncaught errors, HEAD."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated

import structlog
from fastapi import Header
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from real2sim_proto import ErrorCode

from .auth import account_of
from .problems import REQUEST_ID_KEY, ServiceError, problem_response, service_error
from .responses import secure

if TYPE_CHECKING:
    from .metrics import Metrics


CLIENT_HEADER = "X-Real2Sim-Client"

ClientName = Annotated[
    str,
    Header(
        alias=CLIENT_HEADER,
        max_length=80,
        pattern=r"^[ -~]*$",
        description="who is calling; goes into the history of what is changed",
        examples=["alice"],
    ),
]


REQUEST_ID_HEADER = "X-Request-Id"
_REQUEST_ID = re.compile(r"[A-Za-z0-9_.\-]{1,80}")
_CLIENT_NAME = re.compile(r"[ -~]{1,80}")
_QUIET = ("/livez", "/readyz", "/metrics")

log = structlog.get_logger(__name__)


class RequestContext:
    """ASGI middleware, outermost of ours.

    Takes the request id from ``X-Request-Id`` or makes one, sends it back, binds it and the client
    for logs, measures the request, answers HEAD as GET without its body, and INTERNAL for uncaught
    errors.

    Args:
        app: the application.
        metrics: of the worker.
        on_end: told of each request: scope, method, status, request id.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        metrics: Metrics,
        on_end: Callable[[Scope, str, int, str], None] | None = None,
    ) -> None:
        self._app = app
        self._metrics = metrics
        self._on_end = on_end

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        request_id = _request_id(headers)
        scope[REQUEST_ID_KEY] = request_id
        with structlog.contextvars.bound_contextvars(
            request_id=request_id, **_client(scope, headers)
        ):
            if scope["type"] == "http":
                await self._serve(scope, receive, send, request_id)
            else:
                await self._app(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send, request_id: str) -> None:
        started, method = time.perf_counter(), scope["method"]
        status, ended = 0, False
        if method == "HEAD":
            scope["method"] = "GET"

        async def send_with_id(message: Message) -> None:
            nonlocal status, ended
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID_HEADER] = request_id
                secure(headers)
            elif method == "HEAD":
                if ended:
                    return
                ended, message = True, {"type": "http.response.body"}
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        except Exception as error:
            failure = service_error(error, log_unexpected=True)
            if status:  # the answer is under way; the server must cut it short
                raise
            response = problem_response(failure, path=scope["path"], request_id=request_id)
            await response(scope, receive, send_with_id)
        finally:
            self._note(scope, method, status, time.perf_counter() - started)
            if self._on_end is not None:
                self._on_end(scope, method, status, request_id)

    def _note(self, scope: Scope, method: str, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", None) or "unmatched"
        self._metrics.observe_request(method, route, status, seconds)
        account = account_of(scope)
        write = log.debug if scope["path"] in _QUIET else log.info
        write(
            "request",
            method=method,
            path=scope["path"],
            status=status,
            **({"account": account.name} if account is not None else {}),
            **_session(scope),
            ms=round(seconds * 1e3, 2),
        )


class BodyLimit:
    """ASGI middleware that refuses request bodies above a size, whether announced or streamed.

    Args:
        app: the application.
        limit: of all requests [bytes].
        uploads: of multipart forms to these paths instead [bytes].
    """

    def __init__(self, app: ASGIApp, *, limit: int, uploads: Mapping[str, int]) -> None:
        self._app = app
        self._limit = limit
        self._uploads = dict(uploads)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = self._limit
        if headers.get("Content-Type", "").startswith("multipart/form-data"):
            limit = self._uploads.get(scope["path"], limit)
        announced = headers.get("Content-Length", "")
        if announced.isdecimal() and int(announced) > limit:
            raise _too_large(int(announced), limit)
        received = 0

        async def receive_limited() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, f"more than the allowed {limit} bytes were sent")
            return message

        await self._app(scope, receive_limited, send)


def _too_large(size: int, limit: int) -> ServiceError:
    return ServiceError(
        ErrorCode.PAYLOAD_TOO_LARGE, f"the request has {size} bytes; this call takes {limit}"
    )


def _request_id(headers: Headers) -> str:
    given = headers.get(REQUEST_ID_HEADER, "")
    return given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex


def _session(scope: Scope) -> dict[str, str]:
    """The session that a request is about, for logs."""
    found = (scope.get("path_params") or {}).get("session_id")
    return {"session_id": str(found)} if found else {}


def _client(scope: Scope, headers: Headers) -> dict[str, str]:
    """Where a request comes from, and the name that the client gives itself, for logs."""
    address = scope.get("client")
    found = {"client": address[0]} if address else {}
    name = headers.get(CLIENT_HEADER, "")
    if _CLIENT_NAME.fullmatch(name):
        found["client_name"] = name
    return found
