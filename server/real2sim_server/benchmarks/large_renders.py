"""Clients that ask a worker for large pictures, one after the other."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import httpx2

TIMEOUT_S = 120.0


@contextlib.contextmanager
def large_renders(
    url: str, scene: str, camera: str, *, width: int, clients: int = 1
) -> Iterator[list[float]]:
    """Pictures of ``width`` px for the length of the block; yields the milliseconds each took."""
    taken: list[float] = []
    stop = threading.Event()

    def work() -> None:
        query = {"camera": camera, "width": str(width)}
        with httpx2.Client(base_url=url, timeout=TIMEOUT_S) as client:
            while not stop.is_set():
                started = time.perf_counter()
                answer = client.get(f"/v1/scenes/{scene}/render", params=query)
                answer.raise_for_status()
                taken.append((time.perf_counter() - started) * 1e3)

    threads = [threading.Thread(target=work, name="render", daemon=True) for _ in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield taken
    finally:
        stop.set()
        for thread in threads:
            thread.join(TIMEOUT_S)
