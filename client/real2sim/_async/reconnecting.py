"""Connecting again where a connection was lost."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable

from .._session_state import MAX_RECONNECTS, TRANSIENT_ERRORS, backoff
from .concurrency import sleep


async def reconnect(
    close: Callable[[], Awaitable[None]], connect: Callable[[], Awaitable[None]], *, seconds: float
) -> None:
    """Close what is left of a connection and connect again; the worker may be restarting.

    Args:
        close: ends the connection as it is.
        connect: makes the next one.
        seconds: within which the last try begins.

    Raises:
        UnreachableError, CapacityError, ReplyTimeoutError: of the last try.
    """
    until = time.monotonic() + seconds
    for attempt in range(MAX_RECONNECTS):
        await close()
        try:
            return await connect()
        except TRANSIENT_ERRORS:
            wait = backoff(attempt)
            if time.monotonic() + wait > until:
                raise
            await sleep(wait)
    return None
