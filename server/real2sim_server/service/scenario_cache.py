"""Scenarios in memory: rebuilt from the store on demand, changed one edit at a time."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from typing import Any, overload

import structlog
from sqlalchemy.exc import SQLAlchemyError

from real2sim_proto import ErrorCode
from real2sim_proto.operations import (
    OPERATIONS,
    Insert,
    Operation,
    Replace,
    Spawn,
)
from real2sim_proto.scenarios import HistoryEntry, OperationResult, ScenarioInfo

from ..edit import (
    AssetLookup,
    EditError,
    LogEntry,
    PlannedEntry,
    Scenario,
    ScenarioState,
    pack_state,
    unpack_state,
)
from ..scene.io import SceneSummary
from .http.responses import ServiceError, etag
from .library.scenes import SceneCache
from .library.views import edited_objects
from .storage.store import ScenarioRow, SnapshotRow, Store, StoreError

# REST models and stored forms of scenarios.


@dataclass(frozen=True, eq=False)
class ScenarioView:
    """An immutable scenario at one revision: for replies, previews and new sessions."""

    row: ScenarioRow
    summary: SceneSummary
    state: ScenarioState
    revision: int
    can_undo: bool
    can_redo: bool

    def info(self, *, tracks: bool = True) -> ScenarioInfo:
        """The info for clients; takes milliseconds with many trajectories."""
        return ScenarioInfo(
            **scenario_head(self.row, self.revision),
            can_undo=self.can_undo,
            can_redo=self.can_redo,
            start_us=self.state.clock[0],
            end_us=self.state.clock[1],
            objects=edited_objects(self.state.visible, self.summary, tracks=tracks),
            erased=list(self.state.erased),
            colliders=list(self.state.standing_colliders),
            storyboard=self.state.storyboard,
        )


def created_headers(info: ScenarioInfo) -> dict[str, str]:
    """Headers of the reply to a creation."""
    return {"Location": f"/v1/scenarios/{info.scenario_id}", "ETag": info.etag}


def tag(result: OperationResult) -> dict[str, str]:
    """Headers of the reply to a change."""
    return {"ETag": result.etag}


class StoredOperations(Sequence[Operation]):
    """Stored operations, parsed on access.

    They were validated when written; most entries of a long log are never accessed again.
    """

    def __init__(self, stored: Sequence[Mapping[str, Any]]) -> None:
        self._stored = stored

    def __len__(self) -> int:
        return len(self._stored)

    @overload
    def __getitem__(self, index: int) -> Operation: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Operation]: ...
    def __getitem__(self, index: int | slice) -> Operation | Sequence[Operation]:
        return self._models[index]

    @cached_property
    def _models(self) -> list[Operation]:
        return OPERATIONS.validate_python(self._stored)


def stored_entry(stored: Mapping[str, Any]) -> LogEntry:
    """One stored revision."""
    return LogEntry(
        revision=stored["revision"],
        kind=stored["kind"],
        operations=StoredOperations(stored["operations"]),
        target=stored["target"],
        created_at=stored["created_at"],
        who=stored["who"],
    )


def replayed(
    row: ScenarioRow,
    summary: SceneSummary,
    log: Sequence[HistoryEntry],
    assets: AssetLookup | None,
) -> Scenario:
    """The scenario of a log. Raises EditError if the log does not fit its scene."""
    return Scenario.replay(
        ScenarioState.of(summary, assets=assets),
        [
            LogEntry(e.revision, e.kind, tuple(e.operations), e.target, e.created_at, e.who)
            for e in log
        ],
        scene=row.scene,
        scene_hash=row.scene_hash,
    )


def history_entry(entry: LogEntry) -> HistoryEntry:
    """One revision as a protocol model."""
    return HistoryEntry(
        revision=entry.revision,
        kind=entry.kind,
        operations=list(entry.operations),
        target=entry.target,
        who=entry.who,
        created_at=entry.created_at,
    )


def asset_hashes(entries: Iterable[LogEntry], assets: AssetLookup | None) -> dict[str, str]:
    """Content hash of every asset in a log, by id."""
    named = {
        operation.asset_id
        for entry in entries
        for operation in entry.operations
        if isinstance(operation, Insert | Replace | Spawn) and operation.asset_id is not None
    }
    found = {name: assets(name) if assets else None for name in sorted(named)}
    return {name: getattr(asset, "content_hash", "") for name, asset in found.items() if asset}


def operation_result(
    planned: PlannedEntry, *, revision: int, dry_run: bool = False
) -> OperationResult:
    """The reply to a change."""
    return OperationResult(
        revision=revision,
        etag=etag(revision),
        created=list(planned.outcome.created),
        inverse=list(planned.outcome.inverse),
        warnings=list(planned.outcome.warnings),
        dry_run=dry_run,
    )


def stale_revision(scenario: Scenario, expected: int) -> ServiceError:
    """The refusal of a change for another revision, with the missed entries."""
    entries = scenario.entries[max(0, expected) :]
    missed = [history_entry(e).model_dump(mode="json") for e in entries]
    return ServiceError(
        ErrorCode.STALE_REVISION,
        f"the edit was made for revision {expected}; the scenario is at {scenario.revision}",
        hint="look at the missed entries and send the edit again with the new revision",
        extra={"revision": scenario.revision, "missed": missed},
        headers={"ETag": etag(scenario.revision)},
    )


def changed_elsewhere(scenario_id: str) -> ServiceError:
    """The refusal of a change because another worker's change was faster."""
    return ServiceError(
        ErrorCode.STALE_REVISION,
        f"another worker has changed scenario {scenario_id!r}",
        hint="read its operations and send the edit again",
    )


def listed_info(row: ScenarioRow, kinds: Sequence[str]) -> ScenarioInfo:
    """Info of a scenario in a list, from the kinds of its log entries."""
    done = undone = 0
    for kind in kinds:
        match kind:
            case "edit":
                done, undone = done + 1, 0
            case "undo":
                done, undone = done - 1, undone + 1
            case _:
                done, undone = done + 1, undone - 1
    return ScenarioInfo(**scenario_head(row, len(kinds)), can_undo=done > 0, can_redo=undone > 0)


def scenario_head(row: ScenarioRow, revision: int) -> dict[str, Any]:
    """The fields of every reply about a scenario."""
    return {
        "scenario_id": row.scenario_id,
        "name": row.name,
        "scene": row.scene,
        "scene_hash": row.scene_hash,
        "revision": revision,
        "etag": etag(revision),
        "created_at": iso_time(row.created_us),
    }


def iso_time(instant_us: int) -> str:
    """A time as in replies: UTC, ISO 8601."""
    return datetime.fromtimestamp(instant_us / 1e6, UTC).isoformat(timespec="milliseconds")


# --- Snapshots -----------------------------------------------------------------------------------

# With a snapshot, only the end of a long log is replayed.

INTERVAL = 128
"""Revisions between snapshots. A snapshot adds a few milliseconds after one edit in this many, and
opening a scenario applies fewer than this many edits."""

FORMAT = 1

log = structlog.get_logger(__name__)


class Snapshots:
    """Snapshots of all scenarios of a worker, for use on the event loop.

    Snapshots are optional: they are written after the reply, in the background, and ignored if
    invalid.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._made_by = f"{FORMAT} {version('real2sim')}"
        self._revisions: dict[str, int] = {}
        self._writing: set[asyncio.Task[None]] = set()

    async def load(
        self, row: ScenarioRow, summary: SceneSummary, assets: AssetLookup | None
    ) -> Scenario:
        """Load a scenario from its snapshot, if any, and its log, which is authoritative."""
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
        """Save ``state`` in the background if the last snapshot is old."""
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
        """A revision and its state; None without a usable snapshot."""
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
            # The scenario was deleted, or the worker is stopping; the log is sufficient.
            log.info("snapshot not kept", scenario_id=scenario_id, reason=str(error))


# --- Recorded scenes -----------------------------------------------------------------------------

# A recorded scene is available as a read-only scenario.

PREFIX = "recorded."
"""Id prefix of recordings, before the content hash of the scene. No other id has it."""


def recorded_hash(scenario_id: str) -> str | None:
    """Content hash of the scene whose recording has this id; None for other scenarios."""
    return scenario_id.removeprefix(PREFIX) if scenario_id.startswith(PREFIX) else None


def recorded_row(scene: str, summary: SceneSummary) -> ScenarioRow:
    """The row of a recorded scenario, which is not stored."""
    return ScenarioRow(
        scenario_id=f"{PREFIX}{summary.content_hash}",
        name="",
        scene=scene,
        scene_hash=summary.content_hash,
        created_us=0,
    )


def check_made(scenario_id: str) -> None:
    """Raises ServiceError: INVALID_OPERATION for a recording, which is read-only."""
    if recorded_hash(scenario_id) is not None:
        raise ServiceError(
            ErrorCode.INVALID_OPERATION,
            f"{scenario_id!r} is a scene as it was recorded and cannot be changed",
            hint="make a scenario of it: POST /v1/scenarios, or fork it",
        )


MAX_CACHED_SCENARIOS = 256
"""Scenarios in memory; others are rebuilt from the store on demand."""


@dataclass
class CachedScenario:
    """A scenario in memory.

    Attributes:
        row: row of the scenario; replaced when its name changes.
        scenario: current scenario; replaced, under the lock, when others have extended its log.
        lock: serializes edits; readers need no lock, because states are immutable.
    """

    row: ScenarioRow
    scenario: Scenario
    summary: SceneSummary
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class ScenarioCache:
    """The most recently used scenarios, for use on the event loop."""

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
        """Drop a scenario from the cache; the next request reads it from the store."""
        self._cached.pop(scenario_id, None)

    async def wait_for_changes(self) -> None:
        """Wait for the changes in progress."""
        for cached in list(self._cached.values()):
            async with cached.lock:
                pass

    @asynccontextmanager
    async def locked(self, scenario_id: str) -> AsyncIterator[CachedScenario]:
        """Lock a scenario against other changes during the block.

        Raises:
            ServiceError: see :meth:`get`; also INVALID_OPERATION for a recording.
        """
        check_made(scenario_id)
        while True:
            cached = await self.get(scenario_id)
            async with cached.lock:
                # The previous holder of the lock may have evicted or deleted the scenario.
                if self._cached.get(scenario_id) is cached:
                    yield cached
                    return

    async def get(self, scenario_id: str) -> CachedScenario:
        """The scenario with all log entries of all workers; a recorded scene has no log.

        Raises:
            ServiceError: UNKNOWN_SCENARIO, or SCENE_BROKEN if its scene has changed.
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
        """A recorded scene, which is not stored."""
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
        """Whether a cached scenario matches the log; evicts it if not.

        The log is checked each time, because other workers with the same store may have written to
        it.
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
            # The store was restored from an earlier backup.
            self.evict(scenario_id)
            return False
        if stored > cached.scenario.revision:
            # This worker's own changes take effect before their lock is released.
            async with cached.lock:
                await self._catch_up(scenario_id, cached)
        if self._cached.get(scenario_id) is not cached:
            return False
        self._cached.move_to_end(scenario_id)
        return True

    async def _catch_up(self, scenario_id: str, cached: CachedScenario) -> None:
        """Apply entries that others have added to the log; the scenario's lock is held."""
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
        """Add a scenario and evict the least recently used ones that are not being edited."""
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
