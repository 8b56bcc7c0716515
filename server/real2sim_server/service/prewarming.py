"""Scenes that many drive in are loaded by a second worker before anybody is sent there.

A proxy sends new sessions to the worker that has their scene, until that one has half as many
again as the others; the next then finds the scene in memory, and does not wait for it to be loaded.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import structlog

from .http.problems import ServiceError
from .library.scene_cache import SceneCache
from .storage.errors import StoreError
from .storage.leases import Leases, WorkerRow

LOOK_S = 5.0
"""Between looks at what the fleet drives in."""

log = structlog.get_logger(__name__)


class Prewarming:
    """Loads what other workers are busy with, where this one is next in turn.

    Args:
        leases: tell of the workers.
        scene_cache: gets the scenes; they leave it again when memory is needed.
        worker_id: of this one.
        hot: sessions in a scene, over all workers, from which on two of them have it.
    """

    def __init__(
        self, leases: Leases, scene_cache: SceneCache, *, worker_id: str, hot: int
    ) -> None:
        self._leases = leases
        self._scene_cache = scene_cache
        self._worker_id = worker_id
        self._hot = hot

    async def run(self) -> None:
        """Look again and again, for ever."""
        while self._hot:
            await asyncio.sleep(LOOK_S)
            try:
                await self.look()
            except StoreError:
                continue  # it tells of its trouble itself
            except ServiceError as error:
                log.info("scene not loaded ahead", reason=str(error))

    async def look(self) -> None:
        """Load the scenes that are this worker's to load.

        Raises:
            StoreError: of the database.
            ServiceError: a scene cannot be loaded.
        """
        for scene in loads_of(self._worker_id, await self._leases.workers(), hot=self._hot):
            log.info("scene loaded ahead", scene=scene)
            await self._scene_cache.get(scene)


def loads_of(worker_id: str, workers: Sequence[WorkerRow], *, hot: int) -> list[str]:
    """Hot scenes that one worker alone has, and that ``worker_id`` is the one to load.

    All workers find the same, from what each has told of itself: of those without the scene the
    first in an order that differs from scene to scene.
    """
    living = {w.worker_id: w.document for w in workers if w.alive and takes_work(w.document)}
    driven: Counter[str] = Counter()
    for document in living.values():
        driven.update(document.get("scene_sessions", {}))
    found = []
    for scene in sorted(scene for scene, many in driven.items() if many >= hot):
        without = [name for name, about in living.items() if scene not in about.get("scenes", ())]
        if len(living) - len(without) == 1 and without:
            first = min(without, key=lambda name: _order(scene, name))
            found += [scene] * (first == worker_id)
    return found


def _order(scene: str, worker_id: str) -> bytes:
    return hashlib.sha256(f"{scene} {worker_id}".encode()).digest()


def takes_work(document: Mapping[str, Any]) -> bool:
    """Whether a worker that tells this of itself takes new sessions and jobs."""
    return bool(document.get("ready")) and not document.get("draining")
