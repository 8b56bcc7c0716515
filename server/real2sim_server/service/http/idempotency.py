"""Requests that may be sent twice and take effect once (header ``Idempotency-Key``)."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated

from fastapi import FastAPI, Header, Response
from pydantic import BaseModel
from starlette.datastructures import FormData
from starlette.requests import Request

from real2sim_proto import ErrorCode

from ..storage.store import Store, StoredReply, StoreError
from ..tokens import DEFAULT_NAME, sealed, unsealed
from .auth import account_of
from .problems import ServiceError

REPLAY_HEADER = "Idempotent-Replayed"

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="a value of your own; the same request sent again with it takes effect once",
    ),
]


@dataclass
class IdempotentRequest:
    """One request under its key.

    Attributes:
        key: None where the client sent none; then nothing is remembered.
        secret: the key as the client sent it; the store has only its hash, and answers sealed.
        replay: the answer given before; send it and do nothing.
    """

    key: str | None = None
    fingerprint: str = ""
    secret: str = ""
    replay: Response | None = None

    @property
    def claim(self) -> str | None:
        """Names this request and no other; None without a key."""
        return None if self.key is None else f"{self.key} {self.fingerprint}"

    def reply(
        self, body: BaseModel, *, status: int, headers: Mapping[str, str] | None = None
    ) -> StoredReply | None:
        """What to store together with the effect; None without a key."""
        if self.key is None:
            return None
        return self.reply_bytes(body.model_dump_json().encode(), status=status, headers=headers)

    def reply_bytes(
        self, content: bytes, *, status: int, headers: Mapping[str, str] | None = None
    ) -> StoredReply | None:
        """The same for JSON that is written already."""
        if self.key is None:
            return None
        body = sealed(content, self.secret)
        return StoredReply(self.key, self.fingerprint, status, dict(headers or {}), body)


class AnsweredElsewhereError(Exception):
    """Another worker has answered the same request meanwhile; what was begun here came too late.

    Args:
        answer: that of the other worker.
    """

    def __init__(self, answer: Response) -> None:
        super().__init__("answered by another worker")
        self.answer = answer


class Idempotency:
    """Answers given under keys, shared by all routes of a worker.

    The answer is stored in the transaction of the effect, so that a crash leaves both or neither.
    Refusals are not stored: the same request may succeed later. A request that comes while the
    first one under its key is still under way waits for that one's answer; one that is under way at
    another worker with the same store is refused by it, and gets that worker's answer.
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
            request: what is asked for.
            key: of the client; None guards nothing.
            content: what stands for the body; None for the body itself. A form, whose boundary
                differs each time, is told by its parts: :func:`form_digest`.

        Raises:
            ServiceError: IDEMPOTENCY_CONFLICT when the key was used for another request.
            AnsweredElsewhereError: another worker was faster.
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
                        raise AnsweredElsewhereError(elsewhere) from error
                raise

    async def _given(
        self, full_key: str, fingerprint: str, secret: str, key: str
    ) -> Response | None:
        """The answer given under a key. Raises ServiceError: IDEMPOTENCY_CONFLICT."""
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
        """Store an answer whose effect is not in the store, once it is there.

        A crash in between leaves the effect alone, which therefore bears the claim of its request.
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
    """Answer what another worker was faster with by its answer, which passes ``replayed``."""

    async def respond(_request: Request, error: Exception) -> Response:
        assert isinstance(error, AnsweredElsewhereError)
        return replayed(error.answer)

    app.add_exception_handler(AnsweredElsewhereError, respond)


async def form_digest(form: FormData) -> bytes:
    """What a form says, whatever its boundary; reads uploaded files from their beginning."""
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
