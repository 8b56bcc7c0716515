"""Names, times and progress of the stages of a reconstruction."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

OnProgress = Callable[[str, int, int], None]
"""Called with the name of a stage, how many of its steps are done, and how many it has."""
ReportStep = Callable[[int, int], None]


class Stages:
    """Times stages into ``timing_s`` and passes on their progress.

    Args:
        on_progress: called when a stage begins, goes on and ends; may be None.
        timing_s: seconds by stage, written; may be None.
    """

    def __init__(self, on_progress: OnProgress | None, timing_s: dict[str, float] | None) -> None:
        self._on_progress = on_progress
        self._timing_s = timing_s if timing_s is not None else {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[ReportStep]:
        """Run a stage; yields a function that takes steps done and steps in all."""

        def report_step(done: int, total: int) -> None:
            if self._on_progress is not None:
                self._on_progress(name, done, total)

        start = time.perf_counter()
        report_step(0, 1)
        yield report_step
        self._timing_s[name] = time.perf_counter() - start
        report_step(1, 1)
