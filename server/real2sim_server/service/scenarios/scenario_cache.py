"""Scenarios in memory: rebuilt from the store when asked for, changed by one at a time."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from real2sim_proto import ErrorCode

from ...edit import AssetLookup, Scenario
from ...scene.io import SceneSummary
from ..http.problems import ServiceError
from ..library.scene_cache import SceneCache
from ..storage.snapshots import Snapshots
from ..storage.store import ScenarioRow, Store

KEPT_IN_MEMORY = 256
"""Scenarios kept ready; others are rebuilt from the store when they are asked for."""


@dataclass
class HeldScenario:
    """A scenario in memory.

    Attributes:
        lock: one edit at a time; readers need none, for states are immutable.
    """

    row: ScenarioRow
    scenario: Scenario
    summary: SceneSummary
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class HeldScenarios:
    """The scenarios asked for last. Belongs to the event loop."""

    def __init__(
        self,
        store: Store,
        residency: SceneCache,
        snapshots: Snapshots,
        assets: AssetLookup | None,
    ) -> None:
        self._store = store
        self._residency = residency
        self._snapshots = snapshots
        self._assets = assets
        self._held: OrderedDict[str, HeldScenario] = OrderedDict()
        self._opening: dict[str, asyncio.Lock] = {}

    def drop(self, scenario_id: str) -> None:
        """Hold it no more; who asks for it next gets it from the store."""
        self._held.pop(scenario_id, None)

    async def settled(self) -> None:
        """Wait for the changes that are under way."""
        for held in list(self._held.values()):
            async with held.lock:
                pass

    @asynccontextmanager
    async def exclusive(self, scenario_id: str) -> AsyncIterator[HeldScenario]:
        """The scenario while nobody else changes it. Raises as :meth:`get`."""
        while True:
            held = await self.get(scenario_id)
            async with held.lock:
                # Whoever had the lock before may have dropped or deleted it.
                if self._held.get(scenario_id) is held:
                    yield held
                    return

    async def get(self, scenario_id: str) -> HeldScenario:
        """The scenario, from the store where it is not in memory.

        Raises:
            ServiceError: UNKNOWN_SCENARIO, or SCENE_BROKEN where its scene has changed.
        """
        held = self._held.get(scenario_id)
        if held is None:
            lock = self._opening.setdefault(scenario_id, asyncio.Lock())
            try:
                async with lock:
                    held = self._held.get(scenario_id) or await self._rebuild(scenario_id)
                    self.keep(held)
            finally:
                if not lock.locked():
                    self._opening.pop(scenario_id, None)
        self._held.move_to_end(scenario_id)
        return held

    async def _rebuild(self, scenario_id: str) -> HeldScenario:
        row = await self._store.scenario(scenario_id)
        if row is None:
            raise ServiceError(
                ErrorCode.UNKNOWN_SCENARIO,
                f"no scenario {scenario_id!r}",
                hint="GET /v1/scenarios lists them",
            )
        summary = await self._residency.summary(row.scene)
        if summary.content_hash != row.scene_hash:
            raise ServiceError(
                ErrorCode.SCENE_BROKEN,
                f"scenario {scenario_id!r} was made on scene {row.scene!r} with hash "
                f"{row.scene_hash[:12]}; the bundle now has {summary.content_hash[:12]}",
                hint="put the old bundle back, or start a new scenario",
            )
        scenario = await self._snapshots.opened(row, summary, self._assets)
        return HeldScenario(row, scenario, summary)

    def keep(self, held: HeldScenario) -> None:
        """Hold a scenario; the ones not asked for the longest go, unless they are being edited."""
        self._held[held.row.scenario_id] = held
        if len(self._held) > KEPT_IN_MEMORY:
            for key in [k for k, h in self._held.items() if not h.lock.locked()][:-KEPT_IN_MEMORY]:
                del self._held[key]
