"""Responses: models as JSON, content negotiation, event streams, errors as RFC 9457 problems."""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from http import HTTPStatus
from typing import Any, ParamSpec, TypeVar

import structlog
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, RETRYABLE, ErrorCode, Problem
from real2sim_proto.base import invalid_reason
from real2sim_proto.errors import ProblemDetail, title_of

from ...datasets.drive import DatasetError
from ...edit import EditError
from ...physics.errors import PhysicsError
from ...render import RenderError
from ...scene import BundleError, SceneError, TimeOutOfRangeError, UnknownObjectError
from ...world import WorldError
from ...world.recording import RecordingError
from ..accounts import Limit, OverLimitError, RevokedError, seconds_to_wait
from ..engine import DeviceLostError, EngineStoppedError, QueueFullError
from ..storage.connection import (
    FencedError,
    StoreFullError,
    StoreReadOnlyError,
    StoreUnavailableError,
    is_full,
    is_refused,
)

# Problems. Routes and the classes below them raise :class:`ServiceError`; errors of lower packages
# are converted only here.

# --- Disconnects ---------------------------------------------------------------------------------

P = ParamSpec("P")
T = TypeVar("T")


class ClientDisconnectedError(Exception):
    """The client has closed the connection before its reply."""


async def cancel_on_disconnect(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of ``work``, which is cancelled when the client disconnects.

    This also drops its jobs in the engine's queue, so a client that gives up and retries does not
    fill the queue.

    Raises:
        ClientDisconnectedError: the client has disconnected.
    """
    working = asyncio.create_task(work)
    watching = asyncio.create_task(_wait_for_disconnect(request))
    try:
        await asyncio.wait({working, watching}, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise ClientDisconnectedError
    finally:
        for task in (working, watching):
            task.cancel()
        await asyncio.gather(working, watching, return_exceptions=True)


async def _wait_for_disconnect(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def uncancellable(
    method: Callable[P, Coroutine[Any, Any, T]],
) -> Callable[P, Coroutine[Any, Any, T]]:
    """A coroutine function that runs to completion even if its caller is cancelled.

    Use it for changes that are stored before they take effect in memory. If only one of the two
    happened, every later change would fail. The caller waits and keeps its locks.
    """

    @functools.wraps(method)
    async def whole(*args: P.args, **kwargs: P.kwargs) -> T:
        work = asyncio.create_task(method(*args, **kwargs))
        try:
            return await asyncio.shield(work)
        except asyncio.CancelledError:
            await asyncio.wait([work])
            raise

    return whole


MAX_DETAILS = 50
RETRY_AFTER_S = {ErrorCode.STORAGE_UNAVAILABLE: "2", ErrorCode.STORAGE_FULL: "5"}
REQUEST_ID_KEY = "real2sim.request_id"

log = structlog.get_logger(__name__)


class ServiceError(Exception):
    """A refused or failed request, with its stable code.

    Args:
        code: determines the HTTP status.
        detail: the given value and the allowed ones; sent to the client.
        hint: how to fix it.
        errors: invalid values by JSON pointer.
        extra: additional members of the problem document.
        headers: headers of the reply.
    """

    def __init__(
        self,
        code: ErrorCode,
        detail: str,
        *,
        hint: str | None = None,
        errors: Sequence[ProblemDetail] = (),
        extra: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail
        self.hint = hint
        self.errors = list(errors)
        self.extra = dict(extra or {})
        self.headers = dict(headers or {})
        if code in RETRYABLE:
            self.headers.setdefault("Retry-After", RETRY_AFTER_S.get(code, "1"))

    @property
    def status(self) -> int:
        """HTTP status."""
        return HTTP_STATUS[self.code]


_AGAIN = "send it again after Retry-After seconds; under an Idempotency-Key it takes effect once"

_KINDS: tuple[tuple[type[Exception], ErrorCode, str | None], ...] = (
    (QueueFullError, ErrorCode.QUEUE_FULL, "send it again after Retry-After seconds"),
    (StoreFullError, ErrorCode.STORAGE_FULL, "free space on the worker, and send it again"),
    (StoreReadOnlyError, ErrorCode.STORAGE_UNAVAILABLE, _AGAIN),
    (StoreUnavailableError, ErrorCode.STORAGE_UNAVAILABLE, _AGAIN),
    (EngineStoppedError, ErrorCode.DRAINING, None),
    (FencedError, ErrorCode.SESSION_ELSEWHERE, "connect again by the address that made it"),
    (RevokedError, ErrorCode.UNAUTHORIZED, "ask the operator for another token"),
    (TimeOutOfRangeError, ErrorCode.TIME_OUT_OF_RANGE, None),
    (UnknownObjectError, ErrorCode.UNKNOWN_OBJECT, None),
    (BundleError, ErrorCode.SCENE_BROKEN, None),
    (RenderError, ErrorCode.INVALID_REQUEST, None),
    (SceneError, ErrorCode.INVALID_OPERATION, None),
    (PhysicsError, ErrorCode.INVALID_REQUEST, None),
    (DatasetError, ErrorCode.INVALID_REQUEST, None),
    (RecordingError, ErrorCode.INVALID_REQUEST, None),
)
"""Errors of other packages whose messages are sent unchanged; the first match applies."""


def service_error(error: Exception, *, log_unexpected: bool = False) -> ServiceError:
    """The error for clients. Unexpected errors become INTERNAL, without details."""
    failure = _translated(error)
    if log_unexpected and failure.code is ErrorCode.INTERNAL:
        log.error("unexpected error", exc_info=error)
    return failure


def _translated(error: Exception) -> ServiceError:
    if isinstance(error, ServiceError):
        return error
    if isinstance(error, EditError):
        return _of_edit(error)
    if isinstance(error, WorldError):
        return ServiceError(error.code, str(error), hint=error.hint)
    for kind, code, hint in _KINDS:
        if isinstance(error, kind):
            return ServiceError(code, str(error), hint=hint)
    if (shortage := _of_shortage(error)) is not None:
        return shortage
    detail = "an unexpected error; it is in the worker's log under this request_id"
    if isinstance(error, DeviceLostError):
        detail = "the device was lost; the worker restarts"
    return ServiceError(ErrorCode.INTERNAL, detail)


CODE_OF_LIMIT = {
    Limit.REQUESTS: ErrorCode.TOO_MANY_REQUESTS,
    Limit.SESSIONS: ErrorCode.TOO_MANY_SESSIONS,
    Limit.JOBS: ErrorCode.TOO_MANY_JOBS,
}


def _of_limit(error: OverLimitError) -> ServiceError:
    seconds = seconds_to_wait(error)
    hint = f"send it again in {seconds} s"
    if error.limit is Limit.SESSIONS:
        hint = "end one of your sessions: DELETE /v1/sessions/{id}"
    if error.limit is Limit.JOBS:
        hint = "wait for one of your jobs, or cancel one: DELETE /v1/jobs/{id}"
    return ServiceError(
        CODE_OF_LIMIT[error.limit],
        str(error),
        hint=hint,
        headers={"Retry-After": str(seconds)},
    )


def _of_shortage(error: Exception) -> ServiceError | None:
    """The error for lack of disk space, memory or account limits."""
    if isinstance(error, OverLimitError):
        return _of_limit(error)
    if isinstance(error, OSError) and is_full(error):
        detail = "the worker has no space left for this"
        return ServiceError(ErrorCode.STORAGE_FULL, detail, hint="free space on the worker")
    if isinstance(error, OSError) and is_refused(error):
        log.error("files in trouble", reason=str(error))
        detail = f"the worker's files cannot be used just now: {error.strerror}"
        return ServiceError(ErrorCode.STORAGE_UNAVAILABLE, detail, hint=_AGAIN)
    # Compare torch's class by name to avoid importing torch.
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return ServiceError(
            ErrorCode.OUT_OF_MEMORY,
            "the device has no memory left for this",
            hint="ask for smaller or fewer images, or unload a scene",
        )
    return None


def _of_edit(error: EditError) -> ServiceError:
    errors = []
    if error.index is not None:
        errors = [ProblemDetail(pointer=f"/operations/{error.index}", message=str(error))]
    return ServiceError(error.code, str(error), hint=error.hint, errors=errors)


def problem_of(error: ServiceError, *, path: str, request_id: str | None) -> Problem:
    """The problem document of ``error``."""
    return Problem(
        type=f"urn:real2sim:problem:{error.code.value.lower().replace('_', '-')}",
        title=title_of(error.code),
        status=error.status,
        code=error.code,
        detail=error.detail,
        hint=error.hint,
        instance=path,
        request_id=request_id,
        retryable=error.code in RETRYABLE,
        errors=error.errors,
        **error.extra,
    )


def problem_response(error: ServiceError, *, path: str, request_id: str | None) -> Response:
    """The reply for ``error``."""
    problem = problem_of(error, path=path, request_id=request_id)
    return Response(
        json.dumps(problem.model_dump(mode="json", exclude_none=True)),
        status_code=error.status,
        media_type=PROBLEM_MEDIA_TYPE,
        headers=error.headers,
    )


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error of ``app`` with a problem document."""

    async def closed(_request: Request, _error: Exception) -> Response:
        # The client never receives it; proxies log this status.
        return Response(status_code=499)

    for gone in (ClientDisconnectedError, ClientDisconnect):
        app.add_exception_handler(gone, closed)

    async def respond(request: Request, error: Exception) -> Response:
        return problem_response(
            _of_framework(request, error),
            path=request.url.path,
            request_id=request.scope.get(REQUEST_ID_KEY),
        )

    for kind in (ServiceError, RequestValidationError, HTTPException):
        app.add_exception_handler(kind, respond)


def _of_framework(request: Request, error: Exception) -> ServiceError:
    if isinstance(error, RequestValidationError):
        return _of_validation(request, error)
    if isinstance(error, HTTPException):
        return _of_http(request, error)
    return service_error(error)


def _of_validation(request: Request, error: RequestValidationError) -> ServiceError:
    found = error.errors()
    details = [
        ProblemDetail(pointer=_pointer(e, error.body), message=_message(request, e))
        for e in found[:MAX_DETAILS]
    ]
    first = ": ".join(filter(None, (details[0].pointer, details[0].message)))
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return ServiceError(
        ErrorCode.INVALID_REQUEST,
        first + more,
        hint="see /docs for the request this call takes",
        errors=details,
    )


def _message(request: Request, error: Mapping[str, Any]) -> str:
    if error["type"] == "json_invalid":
        return f"not valid JSON: {error.get('ctx', {}).get('error', error['msg'])}"
    name = error["loc"][-1] if error["loc"] else ""
    if error["type"] == "extra_forbidden" and error["loc"] == ("body", name):
        asked = request.scope["route"].dependant.query_params
        if any(parameter.alias == name for parameter in asked):
            address = f"{request.method} {request.url.path}?{name}=..."
            return f"belongs in the address, not in the body: {address}"
    return invalid_reason(error)


def _pointer(error: Mapping[str, Any], body: Any) -> str:
    """JSON pointer (RFC 6901) into the body; other parts of the request keep their names."""
    parts = list(error["loc"])
    if error["type"] == "json_invalid":
        return ""
    if parts and parts[0] == "body":
        parts = list(_places(parts[1:], body))
    return "".join("/" + str(p).replace("~", "~0").replace("/", "~1") for p in parts)


def _places(parts: Sequence[int | str], body: Any) -> Iterator[int | str]:
    """Only the parts that are members of ``body``: pydantic also includes union tags."""
    for index, part in enumerate(parts):
        is_last = index == len(parts) - 1
        if isinstance(body, dict) and (part in body or is_last):
            body = body.get(part)
            yield part
        elif isinstance(body, list) and isinstance(part, int) and (part < len(body) or is_last):
            body = body[part] if part < len(body) else None
            yield part


def _allowed_methods(request: Request) -> list[str]:
    """Methods of the routes that match a request's path."""
    allowed = []
    for method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"):
        as_routed = "GET" if method == "HEAD" else method
        scope = dict(request.scope) | {"method": as_routed}
        if any(route.matches(scope)[0] is Match.FULL for route in request.app.routes):
            allowed.append(method)
    return allowed


_CODES = {
    HTTPStatus.UNAUTHORIZED: ErrorCode.UNAUTHORIZED,
    HTTPStatus.FORBIDDEN: ErrorCode.UNAUTHORIZED,
    HTTPStatus.NOT_FOUND: ErrorCode.NOT_FOUND,
    HTTPStatus.METHOD_NOT_ALLOWED: ErrorCode.METHOD_NOT_ALLOWED,
    HTTPStatus.NOT_ACCEPTABLE: ErrorCode.NOT_ACCEPTABLE,
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: ErrorCode.PAYLOAD_TOO_LARGE,
}


def _of_http(request: Request, error: HTTPException) -> ServiceError:
    headers = dict(error.headers or {})
    match error.status_code:
        case HTTPStatus.NOT_FOUND:
            detail = f"there is nothing at {request.url.path!r}; see /docs for the calls"
            return ServiceError(ErrorCode.NOT_FOUND, detail, headers=headers)
        case HTTPStatus.METHOD_NOT_ALLOWED:
            allowed = ", ".join(_allowed_methods(request))
            headers = {name: v for name, v in headers.items() if name.lower() != "allow"}
            headers["Allow"] = allowed
            detail = f"{request.method} is not allowed at {request.url.path!r}; allowed: {allowed}"
            return ServiceError(ErrorCode.METHOD_NOT_ALLOWED, detail, headers=headers)
    code = _CODES.get(HTTPStatus(error.status_code))
    if code is None:
        code = ErrorCode.INVALID_REQUEST if error.status_code < 500 else ErrorCode.INTERNAL
    return ServiceError(code, str(error.detail), headers=headers)


NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
"""Content security policy of replies that are not pages."""

SECURITY_HEADERS = {
    "Content-Security-Policy": NOTHING,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def secure(headers: MutableHeaders) -> None:
    """Add missing security headers; a page sets its own policy."""
    for name, value in SECURITY_HEADERS.items():
        headers.setdefault(name, value)


def choose_among(offered: Sequence[str], accept: str | None, *, of: str) -> str:
    """The item of ``offered``, best first, that the client prefers.

    Raises:
        ServiceError: NOT_ACCEPTABLE if it accepts none; ``of`` names the kind of item.
    """
    ranked = [(_quality(accept or "*/*", media_type), media_type) for media_type in offered]
    best = max(quality for quality, _ in ranked)
    if best <= 0:
        raise ServiceError(
            ErrorCode.NOT_ACCEPTABLE,
            f"Accept {accept!r} allows none of {', '.join(offered)} for {of}",
            hint="leave Accept out for " + offered[0],
        )
    return next(media_type for quality, media_type in ranked if quality == best)


def info_response(
    body: BaseModel, *, status: int = 200, headers: Mapping[str, str] | None = None
) -> Response:
    """A reply with a model that needs no second validation."""
    return Response(
        body.model_dump_json(),
        status_code=status,
        media_type="application/json",
        headers=dict(headers or {}),
    )


async def large_response(
    build: Callable[[], BaseModel],
    *,
    status: int = 200,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """A reply with a large model, built and encoded on another thread.

    It is encoded in parts. One call for all trajectories of a scene would hold the GIL for tens of
    milliseconds and block the event loop.
    """
    content = await asyncio.to_thread(lambda: json_in_pieces(build()))
    return Response(content, status, dict(headers or {}), "application/json")


def json_in_pieces(model: BaseModel) -> str:
    """The same JSON as ``model_dump_json``, with one call for each model in a list."""
    lists = {
        name: value
        for name, value in model
        if isinstance(value, list) and value and isinstance(value[0], BaseModel)
    }
    text = model.model_dump_json(exclude=set(lists))
    for name, items in lists.items():
        separator = "" if text == "{}" else ","
        joined = ",".join(map(json_in_pieces, items))
        text = f'{text[:-1]}{separator}"{name}":[{joined}]}}'
    return text


def etag(revision: int) -> str:
    """Value of ETag and If-Match for a revision."""
    return f'"r{revision}"'


def _quality(accept: str, media_type: str) -> float:
    """Quality of ``media_type`` in ``accept``: the q of the most specific matching range."""
    kind = media_type.split("/", maxsplit=1)[0]
    specificity = {media_type: 3, f"{kind}/*": 2, "*/*": 1}
    best, quality = 0, 0.0
    for part in accept.lower().split(","):
        name, *parameters = (piece.strip() for piece in part.split(";"))
        rank = specificity.get(name, 0)
        if rank > best:
            best, quality = rank, _q(parameters)
    return quality


def _q(parameters: list[str]) -> float:
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return min(1.0, max(0.0, float(parameter[2:])))
            except ValueError:
                return 0.0
    return 1.0


HEARTBEAT_S = 10.0
"""Interval of comments that keep proxies from closing an idle stream [s]."""


async def event_stream(events: AsyncIterator[tuple[int, str, str]]) -> AsyncIterator[bytes]:
    """An event stream of (id, name, data without line breaks), with heartbeats in between."""
    source = aiter(events)
    pending: asyncio.Future[tuple[int, str, str]] | None = None
    try:
        while True:
            pending = pending or asyncio.ensure_future(anext(source))
            done, _ = await asyncio.wait({pending}, timeout=HEARTBEAT_S)
            if not done:
                yield b": still here\n\n"
                continue
            try:
                number, name, data = pending.result()
            except StopAsyncIteration:
                return
            pending = None
            yield f"id: {number}\nevent: {name}\ndata: {data}\n\n".encode()
    finally:
        if pending is not None:
            pending.cancel()
