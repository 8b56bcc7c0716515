# Made from _async/reconnecting.py by scripts/unasync.py; edit that file, then run the script.
"""Connecting again where a connection was lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from .._session_state import MAX_RECONNECTS, backoff, is_transient
from ..errors import Real2SimError, StatusError
from .concurrency import sleep

A = TypeVar("A")


def outlast(ask: Callable[[], A], *, seconds: float, passes: Callable[[Real2SimError], bool]) -> A:
    """Ask again while the worker refuses for now; each time nothing has happened.

    Args:
        ask: sends the same request each time.
        seconds: within which the last try begins.
        passes: whether an error is one to wait for.

    Raises:
        Real2SimError: of the last try, or one that does not pass.
    """
    until = time.monotonic() + seconds
    for attempt in range(MAX_RECONNECTS):
        try:
            return ask()
        except Real2SimError as error:
            asked = error.retry_after if isinstance(error, StatusError) else None
            wait = backoff(attempt) if asked is None else asked
            if not passes(error) or time.monotonic() + wait > until:
                raise
            sleep(wait)
    return ask()


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
