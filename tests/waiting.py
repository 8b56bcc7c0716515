"""Wait for other threads or processes."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

T = TypeVar("T")

LIMIT_S = 120.0
"""Much longer than any wait takes, even on a busy machine [s]."""

POLL_S = 0.01


def wait_until(
    holds: Callable[[], T], what: str | Callable[[], str], *, seconds: float = LIMIT_S
) -> T:
    """Wait until ``holds()`` is true, and return its result.

    Args:
        holds: the condition, checked every 10 ms.
        what: named in the error. A function is only called for the error.
        seconds: time limit [s]. Leave it out: a limit that can be reached makes a test flaky.

    Raises:
        AssertionError: the time limit has passed.
    """
    for _ in _polls(what, seconds):
        if result := holds():
            return result
        time.sleep(POLL_S)
    raise AssertionError


async def wait_until_async(
    holds: Callable[[], T], what: str | Callable[[], str], *, seconds: float = LIMIT_S
) -> T:
    """:func:`wait_until` on an event loop, which keeps running."""
    for _ in _polls(what, seconds):
        if result := holds():
            return result
        await asyncio.sleep(POLL_S)
    raise AssertionError


def _polls(what: str | Callable[[], str], seconds: float) -> Iterator[None]:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield
    told = what if isinstance(what, str) else what()
    raise AssertionError(f"waited {seconds:g} s for {told}")
