"""Requests that may be sent twice and take effect once (header ``Idempotency-Key``)."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated

from fastapi import Header, Response
from pydantic import BaseModel
from starlette.requests import Request

from real2sim_proto import ErrorCode

from ..storage.store import Store, StoredReply
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
        replay: the answer given before; send it and do nothing.
    """

    key: str | None = None
    fingerprint: str = ""
    replay: Response | None = None

    def reply(
        self, body: BaseModel, *, status: int, headers: Mapping[str, str] | None = None
    ) -> StoredReply | None:
        """What to store together with the effect; None without a key."""
        if self.key is None:
            return None
        content = body.model_dump_json().encode()
        return StoredReply(self.key, self.fingerprint, status, dict(headers or {}), content)


class Idempotency:
    """Answers given under keys, shared by all routes of a worker.

    The answer is stored in the transaction of the effect, so that a crash leaves both or neither.
    Refusals are not stored: the same request may succeed later. A request that comes while the
    first one under its key is still under way waits for that one's answer.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._locks: dict[str, tuple[asyncio.Lock, int]] = {}

    @asynccontextmanager
    async def guard(self, request: Request, key: str | None) -> AsyncIterator[IdempotentRequest]:
        """The request's :class:`IdempotentRequest`, held until the block ends.

        Raises:
            ServiceError: IDEMPOTENCY_CONFLICT when the key was used for another request.
        """
        if key is None:
            yield IdempotentRequest()
            return
        scoped = f"{request.method} {request.url.path} {key}"
        full_key = hashlib.sha256(scoped.encode()).hexdigest()
        fingerprint = _fingerprint(request, await request.body())
        async with self._exclusive(full_key):
            stored = await self._store.reply(full_key)
            if stored is not None and stored.fingerprint != fingerprint:
                raise ServiceError(
                    ErrorCode.IDEMPOTENCY_CONFLICT,
                    f"Idempotency-Key {key!r} was used for another request to this call",
                    hint="make a new key for every new request",
                )
            yield IdempotentRequest(full_key, fingerprint, _response(stored) if stored else None)

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


def _fingerprint(request: Request, body: bytes) -> str:
    digest = hashlib.sha256()
    for part in (
        request.url.query.encode(),
        request.headers.get("If-Match", "").encode(),
        body,
    ):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def _response(stored: StoredReply) -> Response:
    return Response(
        stored.body,
        status_code=stored.status,
        media_type="application/json",
        headers=dict(stored.headers) | {REPLAY_HEADER: "true"},
    )
