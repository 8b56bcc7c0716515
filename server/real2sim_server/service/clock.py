"""The worker's clock, in one module so that tests can replace it.

Call these through the module, ``clock.monotonic()``, so that a replacement applies everywhere.
"""

from __future__ import annotations

import asyncio
import threading
import time


def monotonic() -> float:
    """Monotonic time [s]; only differences are meaningful."""
    return time.monotonic()


async def sleep_until(at: float) -> None:
    """Return once :func:`monotonic` has reached ``at`` [s]."""
    await asyncio.sleep(max(at - monotonic(), 0.0))


def now_us() -> int:
    """Wall-clock time [us] since 1970 UTC; never decreases within a process.

    Rows of the store are listed in the order of these times, even when the clock is set back.
    """
    return _wall.read()


class _WallClock:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def read(self) -> int:
        with self._lock:
            self._last = max(self._last + 1, time.time_ns() // 1000)
            return self._last


_wall = _WallClock()
