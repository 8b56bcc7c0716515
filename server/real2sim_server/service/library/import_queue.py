"""Imports wait for each other, and for nothing else."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError

T = TypeVar("T")

MAX_IMPORTS = 8
"""Imports that are received, wait or run; each may hold an upload on disk."""


class ImportQueue:
    """One import after the other, on a thread that nothing else uses. Belongs to the event loop.

    The reading is done by a process with limits, see :mod:`real2sim_server.scene.io.staging`; one
    at a time, so that these are the limits of all imports together.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="imports")
        self._taken = 0

    def close(self) -> None:
        """Begin no further import."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def place(self) -> Iterator[None]:
        """A place in the queue, taken before the upload is received.

        Raises:
            ServiceError: QUEUE_FULL.
        """
        if self._taken >= MAX_IMPORTS:
            raise ServiceError(
                ErrorCode.QUEUE_FULL,
                f"{self._taken} imports are under way; {MAX_IMPORTS} is the most",
                hint="send it again after Retry-After seconds",
            )
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1

    async def run(self, work: Callable[[], T]) -> T:
        """``work()`` once the imports before it are over."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)
