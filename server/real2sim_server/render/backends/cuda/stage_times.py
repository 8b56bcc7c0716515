"""Milliseconds of the stages of a picture, by events on the device's own queue."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class StageTimes:
    """Times stages without waiting for each.

    Where the device has events its own times are read, after all stages were queued. Elsewhere, and
    while pictures carry gradients, it is the time that queuing took: training waits for nothing.

    Args:
        device: on which the stages run.
        waits: whether :meth:`read` may wait for the device.
    """

    def __init__(self, device: torch.device, *, waits: bool) -> None:
        self._device = device
        self._has_events = waits and device.type == "cuda"
        self._queued_ms: dict[str, float] = {}
        self._events: dict[str, tuple[torch.cuda.Event, torch.cuda.Event]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """The stage ``name`` is queued within."""
        if self._has_events:
            events = (
                torch.cuda.Event(enable_timing=True),
                torch.cuda.Event(enable_timing=True),
            )
            events[0].record(torch.cuda.current_stream(self._device))
            yield
            events[1].record(torch.cuda.current_stream(self._device))
            self._events[name] = events
            return
        start = time.perf_counter()
        yield
        self._queued_ms[name] = (time.perf_counter() - start) * 1e3

    def read(self) -> dict[str, float]:
        """Milliseconds by stage; waits once for the last of them."""
        if not self._events:
            return dict(self._queued_ms)
        list(self._events.values())[-1][1].synchronize()
        return {name: first.elapsed_time(last) for name, (first, last) in self._events.items()}
