"""Scenarios in memory: rebuilt from the store on demand, one change at a time each."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace

from real2sim_proto import ErrorCode

from ...edit import AssetLookup, Scenario
from ...scene.io import SceneSummary
from ..http.problems import ServiceError
from ..library.scene_cache import SceneCache
from ..storage.store import ScenarioRow, Store
from .recorded import check_made, recorded_hash, recorded_row
from .replies import replayed, stored_entry
from .snapshots import Snapshots

MAX_CACHED_SCENARIOS = 256
"""Scenarios in memory; others are rebuilt from the store on demand."""


@dataclass
class CachedScenario:
    """A scenario in memory.

    Attributes:
        row: replaced where its name has changed.
        scenario: replaced, under the lock, by a longer one when others have added to its log.
        lock: one edit at a time; readers need none, for states are immutable.
    """

    row: ScenarioRow
    scenario: Scenario
    summary: SceneSummary
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class ScenarioCache:
    """The most recently used scenarios. Belongs to the event loop."""

    def __init__(
        self,
        store: Store,
        scene_cache: SceneCache,
        snapshots: Snapshots,
        assets: AssetLookup | None,
    ) -> None:
        self._store = store
        self._scene_cache = scene_cache
        self._snapshots = snapshots
        self._assets = assets
        self._cached: OrderedDict[str, CachedScenario] = OrderedDict()
        self._opening: dict[str, asyncio.Lock] = {}

    def evict(self, scenario_id: str) -> None:
        """Forget it; the next request reads it from the store."""
        self._cached.pop(scenario_id, None)

    async def wait_for_changes(self) -> None:
        """Wait for the changes that are under way."""
        for cached in list(self._cached.values()):
            async with cached.lock:
                pass

    @asynccontextmanager
    async def locked(self, scenario_id: str) -> AsyncIterator[CachedScenario]:
        """The scenario while nobody else changes it.

        Raises:
            ServiceError: as :meth:`get`, or INVALID_OPERATION for what was recorded.
        """
        check_made(scenario_id)
        while True:
            cached = await self.get(scenario_id)
            async with cached.lock:
                # The previous holder of the lock may have evicted or deleted it.
                if self._cached.get(scenario_id) is cached:
                    yield cached
                    return

    async def get(self, scenario_id: str) -> CachedScenario:
        """The scenario with all that is in its log, by whichever worker; a scene as it was
        recorded has none.

        Raises:
            ServiceError: UNKNOWN_SCENARIO, or SCENE_BROKEN where its scene has changed.
        """
        if (wanted := recorded_hash(scenario_id)) is not None:
            return await self._recorded(scenario_id, wanted)
        while (cached := self._cached.get(scenario_id)) is not None:
            if await self._is_current(scenario_id, cached):
                return cached
        lock = self._opening.setdefault(scenario_id, asyncio.Lock())
        try:
            async with lock:
                cached = self._cached.get(scenario_id) or await self._rebuild(scenario_id)
                self.put(cached)
        finally:
            if not lock.locked():
                self._opening.pop(scenario_id, None)
        return cached

    async def _recorded(self, scenario_id: str, wanted: str) -> CachedScenario:
        """A scene as it was recorded; only memory has it."""
        cached = self._cached.get(scenario_id)
        if cached is not None:
            there = await self._scene_cache.summary(cached.row.scene)
            if there.content_hash == wanted:
                self._cached.move_to_end(scenario_id)
                return cached
            self.evict(scenario_id)
        for scene, listing in (await self._scene_cache.refresh()).items():
            summary = listing.summary
            if summary is not None and summary.content_hash == wanted:
                row = recorded_row(scene, summary)
                scenario = await asyncio.to_thread(replayed, row, summary, [], self._assets)
                cached = CachedScenario(row, scenario, summary)
                self.put(cached)
                return cached
        raise _unknown(scenario_id)

    async def _is_current(self, scenario_id: str, cached: CachedScenario) -> bool:
        """Whether a scenario in memory is, by now, what the log says; evicts it where it is not.

        The log is asked each time, because other workers on the same store may have written to it.
        """
        known = cached.scenario.revision
        newest = await self._store.newest_of_scenario(scenario_id)
        if newest is None:
            self.evict(scenario_id)
            raise _unknown(scenario_id)
        stored, name = newest
        if name != cached.row.name:
            cached.row = replace(cached.row, name=name)
        if stored < known:
            # The store has been put back to an earlier day.
            self.evict(scenario_id)
            return False
        if stored > cached.scenario.revision:
            # What a change of our own has written takes effect before its lock is free.
            async with cached.lock:
                await self._catch_up(scenario_id, cached)
        if self._cached.get(scenario_id) is not cached:
            return False
        self._cached.move_to_end(scenario_id)
        return True

    async def _catch_up(self, scenario_id: str, cached: CachedScenario) -> None:
        """Apply what others have added to the log; the scenario's lock is held."""
        scenario = cached.scenario
        missed = await self._store.scenario_entries(scenario_id, after=scenario.revision)
        if missed:
            entries = [stored_entry(entry) for entry in missed]
            cached.scenario = await asyncio.to_thread(scenario.extended, entries)

    async def _rebuild(self, scenario_id: str) -> CachedScenario:
        row = await self._store.scenario(scenario_id)
        if row is None:
            raise _unknown(scenario_id)
        summary = await self._scene_cache.summary(row.scene)
        if summary.content_hash != row.scene_hash:
            raise ServiceError(
                ErrorCode.SCENE_BROKEN,
                f"scenario {scenario_id!r} was made on scene {row.scene!r} with hash "
                f"{row.scene_hash[:12]}; the bundle now has {summary.content_hash[:12]}",
                hint="put the old bundle back, or start a new scenario",
            )
        scenario = await self._snapshots.load(row, summary, self._assets)
        return CachedScenario(row, scenario, summary)

    def put(self, cached: CachedScenario) -> None:
        """Add a scenario and evict the least recently used, unless they are being edited."""
        self._cached[cached.row.scenario_id] = cached
        if len(self._cached) > MAX_CACHED_SCENARIOS:
            for key in [k for k, h in self._cached.items() if not h.lock.locked()][
                :-MAX_CACHED_SCENARIOS
            ]:
                del self._cached[key]


def _unknown(scenario_id: str) -> ServiceError:
    return ServiceError(
        ErrorCode.UNKNOWN_SCENARIO,
        f"no scenario {scenario_id!r}",
        hint="GET /v1/scenarios lists them",
    )
