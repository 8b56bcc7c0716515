# Made from _async/reconnecting.py by scripts/unasync.py; edit that file, then run the script.
"""Connecting again where a connection was lost."""

from __future__ import annotations

import time
from collections.abc import Callable

from .._session_state import MAX_RECONNECTS, backoff, is_transient
from ..errors import Real2SimError
from .concurrency import sleep


def reconnect(close: Callable[[], None], connect: Callable[[], None], *, seconds: float) -> None:
    """Close what is left of a connection and connect again; the worker may be restarting.

    Args:
        close: ends the connection as it is.
        connect: makes the next one.
        seconds: within which the last try begins.

    Raises:
        UnreachableError, CapacityError, ReplyTimeoutError: of the last try.
        Real2SimError: the worker refuses.
    """
    until = time.monotonic() + seconds
    for attempt in range(MAX_RECONNECTS):
        close()
        try:
            return connect()
        except Real2SimError as error:
            wait = backoff(attempt)
            if not is_transient(error) or time.monotonic() + wait > until:
                raise
            sleep(wait)
    return None
