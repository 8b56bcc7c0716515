"""Times at which things are stored."""

from __future__ import annotations

import threading
import time


def now_us() -> int:
    """Wall-clock time [us] since 1970 UTC; never less than before in this process.

    What is stored is listed in the order of these times, also when the clock is set back.
    """
    return _clock.read()


class _Clock:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def read(self) -> int:
        with self._lock:
            self._last = max(self._last + 1, time.time_ns() // 1000)
            return self._last


_clock = _Clock()
