"""States kept beside the logs, so that opening a long-edited scenario replays only its end."""

from __future__ import annotations

import asyncio
from importlib.metadata import version

import structlog
from sqlalchemy.exc import SQLAlchemyError

from ...edit import AssetLookup, EditError, Scenario, ScenarioState, pack_state, unpack_state
from ...scene.io import SceneSummary
from ..storage.store import ScenarioRow, SnapshotRow, Store, StoreError
from .replies import stored_entry

INTERVAL = 128
"""Revisions between snapshots: each takes a few milliseconds off the back of one edit in so many,
and opening applies fewer than this many edits."""

FORMAT = 1

log = structlog.get_logger(__name__)


class Snapshots:
    """Snapshots of all scenarios of a worker. Belongs to the event loop.

    They are a convenience: written after the answer, never waited for, and passed over when
    anything is odd about them.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._made_by = f"{FORMAT} {version('real2sim')}"
        self._revisions: dict[str, int] = {}
        self._writing: set[asyncio.Task[None]] = set()

    async def load(
        self, row: ScenarioRow, summary: SceneSummary, assets: AssetLookup | None
    ) -> Scenario:
        """A scenario from its log, which is what counts, and from a snapshot where there is one."""
        stored = await self._store.scenario_entries(row.scenario_id)
        initial = await asyncio.to_thread(ScenarioState.of, summary, assets=assets)
        known = await self._read(row.scenario_id, initial, revisions=len(stored))

        def replay() -> Scenario:
            log = map(stored_entry, stored)
            return Scenario.replay(
                initial, log, scene=row.scene, scene_hash=row.scene_hash, known=known
            )

        scenario = await asyncio.to_thread(replay)
        self.save_if_due(row.scenario_id, scenario.revision, scenario.state)
        return scenario

    def save_if_due(self, scenario_id: str, revision: int, state: ScenarioState) -> None:
        """Save ``state`` in the background when the last snapshot is old."""
        if revision - self._revisions.get(scenario_id, 0) < INTERVAL:
            return
        self._revisions[scenario_id] = revision
        task = asyncio.create_task(self._write(scenario_id, revision, state))
        self._writing.add(task)
        task.add_done_callback(self._writing.discard)

    def discard(self, scenario_id: str) -> None:
        """Forget the revision of a deleted scenario."""
        self._revisions.pop(scenario_id, None)

    async def flush(self) -> None:
        """Wait until everything is saved."""
        await asyncio.gather(*self._writing)

    async def _read(
        self, scenario_id: str, initial: ScenarioState, *, revisions: int
    ) -> tuple[int, ScenarioState] | None:
        """A revision and the state after it; None where there is none of use."""
        row = await self._store.snapshot(scenario_id) if revisions >= INTERVAL else None
        if row is None or row.made_by != self._made_by or row.revision > revisions:
            return None
        try:
            state = await asyncio.to_thread(unpack_state, initial, row.state)
        except EditError as error:
            log.warning("snapshot passed over", scenario_id=scenario_id, reason=str(error))
            return None
        self._revisions[scenario_id] = row.revision
        return row.revision, state

    async def _write(self, scenario_id: str, revision: int, state: ScenarioState) -> None:
        try:
            packed = await asyncio.to_thread(pack_state, state)
            row = SnapshotRow(scenario_id, revision, self._made_by, packed)
            await self._store.save_snapshot(row)
        except (StoreError, SQLAlchemyError, RuntimeError) as error:
            # Deleted meanwhile, or the worker is stopping: the log is all that counts.
            log.info("snapshot not kept", scenario_id=scenario_id, reason=str(error))
