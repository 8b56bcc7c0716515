"""Requests and replies, collections, and reconnecting."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, Generic, TypeVar

import httpx2

from .._calls import Call, Reply, Request
from .._http import Attempts, Target, accepted_reply, client_options, http_errors, request_options
from .._session_state import MAX_RECONNECTS, backoff, is_transient
from ..errors import Real2SimError, StatusError
from .concurrency import Lookup, sleep

T = TypeVar("T")


class AsyncTransport:
    """Connection to one worker."""

    def __init__(
        self, target: Target, *, transport: httpx2.AsyncBaseTransport | None = None
    ) -> None:
        self.target = target
        self._http = httpx2.AsyncClient(transport=transport, **client_options(target))

    async def send(self, call: Call[T]) -> T:
        """Send a request and return the parsed reply; retries if that is safe.

        Raises:
            Real2SimError: there is no reply, or the worker refuses the request.
        """
        attempts = Attempts(self.target.policy, call.request)
        while True:
            try:
                return call.parse(await self._exchange(call.request))
            except Real2SimError as error:
                delay = attempts.delay_after(error)
                if delay is None:
                    # Keep the caller's traceback; the frames below it are always the same.
                    raise error.with_traceback(None) from error.__cause__
            await sleep(delay)

    async def _exchange(self, request: Request) -> Reply:
        with http_errors(self.target, request), request_options(self.target, request) as options:
            response = await self._http.request(request.method, request.path, **options)
        return accepted_reply(response, request)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


# Collections: scenes, scenarios, assets, jobs, sessions.


class AsyncCollection(Lookup, Generic[T]):
    """Lists a kind of object of the worker; iterating over it sends one request.

    Examples:
        >>> client = real2sim.connect_async()
        >>> [info.scene async for info in client.scenes]
        ['street']
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    if TYPE_CHECKING:

        async def list(self) -> Sequence[T]: ...

    async def __aiter__(self) -> AsyncIterator[T]:
        for one in await self.list():
            yield one

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.target})"


# Reconnecting after a lost connection.

A = TypeVar("A")


async def outlast(
    ask: Callable[[], Awaitable[A]], *, seconds: float, passes: Callable[[Real2SimError], bool]
) -> A:
    """Retry while the worker refuses temporarily; a refused request has no effect.

    Args:
        ask: sends the same request each time.
        seconds: period in which retries start.
        passes: whether an error is temporary.

    Raises:
        Real2SimError: from the last attempt, or not temporary.
    """
    until = time.monotonic() + seconds
    for attempt in range(MAX_RECONNECTS):
        try:
            return await ask()
        except Real2SimError as error:
            asked = error.retry_after if isinstance(error, StatusError) else None
            wait = backoff(attempt) if asked is None else asked
            if not passes(error) or time.monotonic() + wait > until:
                raise
            await sleep(wait)
    return await ask()


async def reconnect(
    close: Callable[[], Awaitable[None]], connect: Callable[[], Awaitable[None]], *, seconds: float
) -> None:
    """Close the old connection and connect again; the worker may be restarting.

    Args:
        close: ends the current connection.
        connect: opens the next one.
        seconds: period in which retries start.

    Raises:
        UnreachableError, CapacityError, ReplyTimeoutError: from the last attempt.
        Real2SimError: the worker refuses.
    """
    until = time.monotonic() + seconds
    for attempt in range(MAX_RECONNECTS):
        await close()
        try:
            return await connect()
        except Real2SimError as error:
            wait = backoff(attempt)
            if not is_transient(error) or time.monotonic() + wait > until:
                raise
            await sleep(wait)
    return None
