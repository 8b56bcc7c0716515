"""How often the machine itself stops a program: the floor of every latency measured on it."""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

MIN_PAUSE_S = 1e-3
"""Shorter ones are the ordinary ticks of a kernel."""
START_S = 1.0
"""Long enough that no program that is up already takes the place of one that starts."""


def pauses(seconds: float) -> dict[str, Any]:
    """What happens to a program that only reads the clock, one on every core.

    Returns:
        ``cores``; ``per_second``: pauses above 1 ms of one core; ``longest_ms``.
    """
    cores = os.cpu_count() or 1
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(cores, mp_context=spawn) as pool:
        # Nobody reads before all have started, which keeps every core busy.
        list(pool.map(time.sleep, [START_S] * cores))
        found = list(pool.map(_read_the_clock, [seconds] * cores))
    pauses_seen = [pause for of_core in found for pause in of_core]
    return {
        "cores": cores,
        "per_second": len(pauses_seen) / (cores * seconds),
        "longest_ms": 1e3 * max(pauses_seen, default=0.0),
    }


def _read_the_clock(seconds: float) -> list[float]:
    """Pauses above ``MIN_PAUSE_S`` [s]."""
    pauses_seen = []
    before = time.perf_counter()
    end = before + seconds
    while before < end:
        now = time.perf_counter()
        if now - before > MIN_PAUSE_S:
            pauses_seen.append(now - before)
        before = now
    return pauses_seen
