"""How long the worker's event loop keeps others waiting while it draws large pictures."""

from __future__ import annotations

import re
import time
from typing import Any

import httpx2
import numpy as np

from .drive_probe import DriveProbe
from .large_renders import large_renders

HEAVY_WIDTH = 1920
PING_EVERY_S = 0.005
IDLE_SECONDS = 3.0
BUCKET = re.compile(r'^real2sim_event_loop_lag_seconds_bucket{le="([^"]+)"} (\S+)', re.MULTILINE)


def loop_lag(
    probe: DriveProbe, url: str, *, scene: str, camera: str, seconds: float
) -> dict[str, Any]:
    """Lag with the worker idle and under load, seen from both sides.

    ``ping``: round trips of WebSocket pings [ms] of a lean probe, which the loop answers by itself;
    they hold the client's own wake-ups too. ``own``: the worker's histogram of how late its loop
    runs.
    """
    idle = _pings(probe, IDLE_SECONDS)
    before = _buckets(url)
    with large_renders(url, scene, camera, width=HEAVY_WIDTH) as pictures:
        loaded = _pings(probe, seconds)
    own = {le: count - before[le] for le, count in _buckets(url).items()}
    samples = own.get("+Inf", 0.0)
    within = own.get("0.005", 0.0) / samples if samples else float("nan")
    return {
        "heavy_picture_ms": float(np.mean(pictures)) if pictures else None,
        "pictures": len(pictures),
        "ping_idle_ms": _spread(idle),
        "ping_loaded_ms": _spread(loaded),
        "own_samples": int(samples),
        "own_share_within_5_ms": within,
        "own_p99_below_ms": _quantile_bound(own, 0.99),
    }


def _pings(probe: DriveProbe, seconds: float) -> list[float]:
    """Milliseconds of ping round trips."""
    trips = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        trips.append(probe.socket.ping(10) * 1e3)
        time.sleep(PING_EVERY_S)
    return trips


def _buckets(url: str) -> dict[str, float]:
    text = httpx2.get(f"{url}/metrics", timeout=10).text
    return {le: float(count) for le, count in BUCKET.findall(text)}


def _quantile_bound(buckets: dict[str, float], fraction: float) -> float | None:
    """Milliseconds of the first bucket that holds ``fraction`` of all samples."""
    total = buckets.get("+Inf", 0.0)
    for le, count in buckets.items():
        if total and count >= fraction * total:
            return float(le) * 1e3
    return None


def _spread(values: list[float]) -> dict[str, float]:
    p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
    return {"count": len(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}
