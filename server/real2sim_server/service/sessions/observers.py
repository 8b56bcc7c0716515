"""Observations that are still to be sent to observers."""

from __future__ import annotations

import asyncio
from collections import deque

from .wire import EncodedMessage

KEPT = 4
"""Observations that wait for a slow observer; older ones are dropped."""


class ObserverQueue:
    """A few observations on their way to one observer. Putting one in never waits.

    Attributes:
        dropped: observations that the observer was too slow for.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[EncodedMessage] = deque(maxlen=KEPT)
        self._filled = asyncio.Event()

    def put(self, message: EncodedMessage) -> None:
        """Add the newest observation; the oldest makes room."""
        if len(self._waiting) == KEPT:
            self.dropped += 1
        self._waiting.append(message)
        self._filled.set()

    async def take(self) -> EncodedMessage:
        """The oldest that waits."""
        await self._filled.wait()
        message = self._waiting.popleft()
        if not self._waiting:
            self._filled.clear()
        return message
