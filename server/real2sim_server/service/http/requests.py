"""Middleware of every request: id, log line, duration, uncaught errors, HEAD, idempotency."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import re
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import structlog
from fastapi import FastAPI, Header, Response
from pydantic import BaseModel
from starlette.datastructures import FormData, Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from real2sim_proto import ErrorCode

from ..accounts import DEFAULT_NAME, sealed, unsealed
from ..storage.store import Store, StoredReply, StoreError
from .auth import account_of
from .responses import REQUEST_ID_KEY, ServiceError, problem_response, secure, service_error

if TYPE_CHECKING:
    from .telemetry import Metrics


CLIENT_HEADER = "X-Real2Sim-Client"

ClientName = Annotated[
    str,
    Header(
        alias=CLIENT_HEADER,
        max_length=80,
        pattern=r"^[ -~]*$",
        description="name of the client, written to the history of changes",
        examples=["alice"],
    ),
]


REQUEST_ID_HEADER = "X-Request-Id"
_REQUEST_ID = re.compile(r"[A-Za-z0-9_.\-]{1,80}")
_CLIENT_NAME = re.compile(r"[ -~]{1,80}")
_QUIET = ("/livez", "/readyz", "/metrics")

log = structlog.get_logger(__name__)


class RequestContext:
    """The outermost ASGI middleware of the worker.

    Takes the request id from ``X-Request-Id`` or creates one, returns it, and binds it and the
    client for logs. Also measures the request, answers HEAD as GET without a body, and sends
    INTERNAL for uncaught errors.

    Args:
        app: the application.
        metrics: metrics of the worker.
        on_end: called after each request: scope, method, status, request id.
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
                if headers.get("Location", "").startswith("/"):
                    headers["Location"] = forwarded_prefix(scope) + headers["Location"]
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
            if status:  # the reply has begun; the server must abort it
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


_PREFIX = re.compile(r"(/[A-Za-z0-9._~-]+)+")


def forwarded_prefix(scope: Scope) -> str:
    """Path below which a proxy serves the worker, such as ``/sim``; empty for none."""
    given = Headers(scope=scope).get("X-Forwarded-Prefix", "").rstrip("/")
    return given if _PREFIX.fullmatch(given) else ""


def base_url(connection: HTTPConnection) -> str:
    """Address of the worker for the client, without a slash at its end."""
    return str(connection.base_url).rstrip("/") + forwarded_prefix(connection.scope)


class BodyLimit:
    """ASGI middleware that refuses request bodies above a size, whether announced or streamed.

    Args:
        app: the application.
        limit: limit for all requests [bytes].
        uploads: limit for multipart forms to these paths [bytes].
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
    """The session of a request, for logs."""
    found = (scope.get("path_params") or {}).get("session_id")
    return {"session_id": str(found)} if found else {}


def _client(scope: Scope, headers: Headers) -> dict[str, str]:
    """Address of the client, and the name it sends, for logs."""
    address = scope.get("client")
    found = {"client": address[0]} if address else {}
    name = headers.get(CLIENT_HEADER, "")
    if _CLIENT_NAME.fullmatch(name):
        found["client_name"] = name
    return found


# Idempotency: a repeated request with the same ``Idempotency-Key`` takes effect once.

REPLAY_HEADER = "Idempotent-Replayed"

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="any unique value; a request repeated with the same value takes effect once",
    ),
]


@dataclass
class IdempotentRequest:
    """One request with its idempotency key.

    Attributes:
        key: key of the client; None if it sent none, and then nothing is stored.
        secret: the key as sent. The store has only its hash, and seals replies with it.
        replay: the stored reply; if set, send it and skip the work.
    """

    key: str | None = None
    fingerprint: str = ""
    secret: str = ""
    replay: Response | None = None

    @property
    def claim(self) -> str | None:
        """Unique name of this request; None without a key."""
        return None if self.key is None else f"{self.key} {self.fingerprint}"

    def reply(
        self, body: BaseModel, *, status: int, headers: Mapping[str, str] | None = None
    ) -> StoredReply | None:
        """The reply to store together with the effect; None without a key."""
        if self.key is None:
            return None
        return self.reply_bytes(body.model_dump_json().encode(), status=status, headers=headers)

    def reply_bytes(
        self, content: bytes, *, status: int, headers: Mapping[str, str] | None = None
    ) -> StoredReply | None:
        """The same, for encoded JSON."""
        if self.key is None:
            return None
        body = sealed(content, self.secret)
        return StoredReply(self.key, self.fingerprint, status, dict(headers or {}), body)


class ReplyConflict(Exception):
    """Another worker has already answered the same request; this attempt is discarded.

    Args:
        answer: the other worker's reply.
    """

    def __init__(self, answer: Response) -> None:
        super().__init__("answered by another worker")
        self.answer = answer


class Idempotency:
    """Replies by idempotency key, shared by all routes of a worker.

    A reply is stored in the transaction of its effect, so a crash leaves both or neither. Refusals
    are not stored: the same request may succeed later. A request that arrives while another with
    the same key is in progress waits for its reply. If the other request is in progress at another
    worker with the same store, the store refuses this one, and the client receives that worker's
    reply.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._locks: dict[str, tuple[asyncio.Lock, int]] = {}

    @asynccontextmanager
    async def guard(
        self, request: Request, key: str | None, *, content: bytes | None = None
    ) -> AsyncIterator[IdempotentRequest]:
        """The request's :class:`IdempotentRequest`, held until the block ends.

        Args:
            request: the request.
            key: key of the client; None disables the guard.
            content: identifies the body; None for the body itself. The boundary of a form varies,
                so use :func:`form_digest` for forms.

        Raises:
            ServiceError: IDEMPOTENCY_CONFLICT if the key was used for another request.
            ReplyConflict: another worker has already answered.
        """
        if key is None:
            yield IdempotentRequest()
            return
        account = account_of(request.scope)
        holder = "" if account is None or account.name == DEFAULT_NAME else f"{account.name} "
        scoped = f"{holder}{request.method} {request.url.path} {key}"
        full_key = hashlib.sha256(scoped.encode()).hexdigest()
        content = await request.body() if content is None else content
        fingerprint = _fingerprint(request, content)
        async with self._exclusive(full_key):
            given = partial(self._given, full_key, fingerprint, scoped, key)
            replay = await given()
            try:
                yield IdempotentRequest(full_key, fingerprint, scoped, replay)
            except Exception as error:
                with contextlib.suppress(StoreError):
                    if replay is None and (elsewhere := await given()) is not None:
                        raise ReplyConflict(elsewhere) from error
                raise

    async def _given(
        self, full_key: str, fingerprint: str, secret: str, key: str
    ) -> Response | None:
        """The reply stored under a key. Raises ServiceError: IDEMPOTENCY_CONFLICT."""
        stored = await self._store.reply(full_key)
        if stored is None:
            return None
        if stored.fingerprint != fingerprint:
            raise ServiceError(
                ErrorCode.IDEMPOTENCY_CONFLICT,
                f"Idempotency-Key {key!r} was used for another request to this call",
                hint="make a new key for every new request",
            )
        return _response(stored, secret)

    async def store(self, reply: StoredReply | None) -> None:
        """Store the reply of an effect outside the store, after the effect.

        A crash in between leaves only the effect; the effect therefore carries the request's claim.
        """
        if reply is not None:
            await self._store.write(reply=reply)

    @asynccontextmanager
    async def _exclusive(self, key: str) -> AsyncIterator[None]:
        lock, users = self._locks.get(key, (asyncio.Lock(), 0))
        self._locks[key] = (lock, users + 1)
        try:
            async with lock:
                yield
        finally:
            lock, users = self._locks[key]
            if users == 1:
                del self._locks[key]
            else:
                self._locks[key] = (lock, users - 1)


def install_replay_handler(app: FastAPI, replayed: Callable[[Response], Response]) -> None:
    """Answer a ReplyConflict with the other worker's reply, passed through ``replayed``."""

    async def respond(_request: Request, error: Exception) -> Response:
        assert isinstance(error, ReplyConflict)
        return replayed(error.answer)

    app.add_exception_handler(ReplyConflict, respond)


async def form_digest(form: FormData) -> bytes:
    """Digest of a form's parts, independent of its boundary; reads uploaded files from the
    start."""
    digest = hashlib.sha256()
    for name, value in form.multi_items():
        _update(digest, name.encode("utf-8", "surrogateescape"))
        if isinstance(value, str):
            _update(digest, value.encode("utf-8", "surrogateescape"))
        else:
            _update(digest, (value.filename or "").encode("utf-8", "surrogateescape"))
            file = value.file
            content = await asyncio.to_thread(hashlib.file_digest, file, "sha256")  # type: ignore[arg-type]
            await value.seek(0)
            _update(digest, content.digest())
    return digest.digest()


def _update(digest: hashlib._Hash, part: bytes) -> None:
    digest.update(len(part).to_bytes(8, "little") + part)


def _fingerprint(request: Request, body: bytes) -> str:
    digest = hashlib.sha256()
    for part in (
        request.url.query.encode(),
        request.headers.get("If-Match", "").encode(),
        body,
    ):
        _update(digest, part)
    return digest.hexdigest()


def _response(stored: StoredReply, secret: str) -> Response:
    return Response(
        unsealed(stored.body, secret),
        status_code=stored.status,
        media_type="application/json",
        headers=dict(stored.headers) | {REPLAY_HEADER: "true"},
    )
