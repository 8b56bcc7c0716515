"""Scenarios of a worker: one lock per scenario, edits stored before they take effect."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections import Counter
from collections.abc import Callable, Sequence

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import (
    History,
    HistoryEntry,
    OperationResult,
    ScenarioCreate,
    ScenarioDocument,
    ScenarioFork,
    ScenarioInfo,
)

from ..edit import AssetLookup, EditError, LogEntry, PlannedEntry, Scenario, ScenarioState
from ..scene.io import SceneSummary
from .clock import now_us
from .http.requests import IdempotentRequest
from .http.responses import ServiceError, uncancellable
from .http.telemetry import Metrics
from .library.scenes import BUNDLE_SUFFIX, SceneCache
from .scenario_cache import (
    CachedScenario,
    ScenarioCache,
    ScenarioView,
    Snapshots,
    asset_hashes,
    changed_elsewhere,
    check_made,
    created_headers,
    history_entry,
    iso_time,
    listed_info,
    operation_result,
    replayed,
    stale_revision,
    tag,
)
from .storage.store import ConflictError, ScenarioRow, Store, StoredReply

__all__ = ["ScenarioView", "Scenarios", "created_headers", "tag"]

MAX_RACES = 8
"""Attempts of one change if other workers change the same scenario."""


class Scenarios:
    """All scenarios of a worker, for use on the event loop."""

    def __init__(
        self,
        store: Store,
        scene_cache: SceneCache,
        metrics: Metrics,
        *,
        assets: AssetLookup | None = None,
    ) -> None:
        self._store = store
        self._assets = assets
        self._scene_cache = scene_cache
        self._metrics = metrics
        self._snapshots = Snapshots(store)
        self._scenarios_cache = ScenarioCache(store, scene_cache, self._snapshots, assets)

    # --- life -------------------------------------------------------------------------------

    async def create(
        self, request: ScenarioCreate, *, idempotent: IdempotentRequest
    ) -> ScenarioInfo:
        """Create and store a scenario. Raises ServiceError: UNKNOWN_SCENE or SCENE_BROKEN."""
        summary = await self._scene_cache.summary(request.scene)
        return await self._create(request.name, request.scene, summary, [], idempotent=idempotent)

    async def fork(
        self, scenario_id: str, request: ScenarioFork, *, idempotent: IdempotentRequest
    ) -> ScenarioInfo:
        """Create a scenario with the same history, up to a revision.

        Raises:
            ServiceError: UNKNOWN_SCENARIO, or INVALID_REQUEST for a missing revision.
        """
        cached = await self._scenarios_cache.get(scenario_id)
        entries = list(cached.scenario.entries)
        revision = len(entries) if request.revision is None else request.revision
        if revision > len(entries):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"scenario {scenario_id!r} has {len(entries)} revisions; there is no {revision}",
                hint="leave revision out to fork the current one",
            )
        name = cached.row.name if request.name is None else request.name
        log = [history_entry(e) for e in entries[:revision]]
        return await self._create(
            name, cached.row.scene, cached.summary, log, idempotent=idempotent
        )

    async def export(self, scenario_id: str) -> ScenarioDocument:
        """The scenario as one file. Raises ServiceError: UNKNOWN_SCENARIO or SCENE_BROKEN."""
        cached = await self._scenarios_cache.get(scenario_id)
        return ScenarioDocument(
            name=cached.row.name,
            scene=cached.row.scene,
            scene_hash=cached.row.scene_hash,
            assets=asset_hashes(cached.scenario.entries, self._assets),
            entries=[history_entry(e) for e in cached.scenario.entries],
            exported_at=iso_time(now_us()),
        )

    async def import_(
        self, document: ScenarioDocument, *, idempotent: IdempotentRequest
    ) -> ScenarioInfo:
        """Create a scenario from a file, on the scene with the file's scene hash.

        Raises:
            ServiceError: UNKNOWN_SCENE or UNKNOWN_ASSET if the file refers to missing ones;
                INVALID_OPERATION for a log that does not fit its scene.
        """
        summary = await self._summary_of(document)
        for asset_id, content_hash in document.assets.items():
            found = self._assets(asset_id) if self._assets else None
            if found is None or getattr(found, "content_hash", "") != content_hash:
                raise ServiceError(
                    ErrorCode.UNKNOWN_ASSET,
                    f"the scenario uses asset {asset_id!r} with hash {content_hash[:12]}; it is "
                    "not in this library",
                    hint="add it with POST /v1/assets under that id first",
                )
        scene = summary.path.name.removesuffix(BUNDLE_SUFFIX)
        return await self._create(
            document.name, scene, summary, document.entries, idempotent=idempotent
        )

    async def rename(self, scenario_id: str, name: str) -> ScenarioView:
        """Rename a scenario. Raises ServiceError: UNKNOWN_SCENARIO, or INVALID_OPERATION for a
        recording."""
        check_made(scenario_id)
        await self._store.rename_scenario(scenario_id, name)
        return await self.view(scenario_id)

    async def delete(self, scenario_id: str) -> None:
        """Remove a scenario and its history. Raises ServiceError: UNKNOWN_SCENARIO."""
        async with self._scenarios_cache.locked(scenario_id):
            self._scenarios_cache.evict(scenario_id)
            self._snapshots.discard(scenario_id)
            await self._store.delete_scenario(scenario_id)

    async def flush(self) -> None:
        """Wait for snapshots that are still being written; no calls may follow."""
        await self._snapshots.flush()

    # --- reading ----------------------------------------------------------------------------

    async def list(self) -> list[ScenarioInfo]:
        """All scenarios, oldest first, without their objects; including those of missing scenes."""
        kinds = await self._store.scenario_kinds()
        rows = await self._store.scenarios()
        return [listed_info(row, kinds.get(row.scenario_id, [])) for row in rows]

    async def view(self, scenario_id: str) -> ScenarioView:
        """The current scenario. Raises ServiceError: UNKNOWN_SCENARIO or SCENE_BROKEN."""
        return _view(await self._scenarios_cache.get(scenario_id))

    async def state_at(self, scenario_id: str, revision: int) -> ScenarioState:
        """The scenario at a revision. Raises ServiceError: UNKNOWN_SCENARIO."""
        cached = await self._scenarios_cache.get(scenario_id)
        if revision == cached.scenario.revision:
            return cached.scenario.state
        log = [history_entry(e) for e in cached.scenario.entries[:revision]]
        earlier = await asyncio.to_thread(replayed, cached.row, cached.summary, log, self._assets)
        return earlier.state

    async def history(self, scenario_id: str, *, after: int = 0) -> History:
        """Revisions after ``after``, oldest first."""
        scenario = (await self._scenarios_cache.get(scenario_id)).scenario
        return History(
            revision=scenario.revision,
            can_undo=scenario.can_undo,
            can_redo=scenario.can_redo,
            entries=[history_entry(e) for e in scenario.entries[max(0, after) :]],
        )

    async def using_asset(self, asset_id: str) -> Sequence[str]:
        """Ids of the scenarios whose history refers to an asset, including edits in progress."""
        await self._scenarios_cache.wait_for_changes()
        return await self._store.scenarios_naming(asset_id)

    @property
    def assets(self) -> AssetLookup | None:
        """Lookup of inserted assets."""
        return self._assets

    # --- editing ----------------------------------------------------------------------------

    async def edit(
        self,
        scenario_id: str,
        operations: Sequence[Operation],
        *,
        expected: int | None,
        dry_run: bool,
        idempotent: IdempotentRequest,
        who: str = "",
    ) -> OperationResult:
        """Apply operations, all or none.

        Args:
            scenario_id: the scenario.
            operations: operations, in order.
            expected: revision that they are based on; None for any.
            dry_run: validate and reply without changes.
            idempotent: stores the reply.
            who: name for the history.

        Raises:
            ServiceError: UNKNOWN_SCENARIO; STALE_REVISION, with the missed entries as member
                ``missed``; UNKNOWN_OBJECT or INVALID_OPERATION.
        """
        result = await self._change(
            scenario_id,
            lambda s: s.plan_edit(operations, who=who),
            expected,
            dry_run=dry_run,
            idempotent=idempotent,
        )
        if not dry_run:
            for op, count in Counter(o.op for o in operations).items():
                self._metrics.edits.labels(op).inc(count)
        return result

    async def undo(
        self,
        scenario_id: str,
        *,
        expected: int | None,
        idempotent: IdempotentRequest,
        who: str = "",
    ) -> OperationResult:
        """Undo the last edit in effect. Raises like :meth:`edit`; also NOTHING_TO_UNDO."""
        result = await self._change(
            scenario_id, lambda s: s.plan_undo(who=who), expected, idempotent=idempotent
        )
        self._metrics.edits.labels("undo").inc()
        return result

    async def redo(
        self,
        scenario_id: str,
        *,
        expected: int | None,
        idempotent: IdempotentRequest,
        who: str = "",
    ) -> OperationResult:
        """Redo the last undone edit. Raises like :meth:`edit`; also NOTHING_TO_REDO."""
        result = await self._change(
            scenario_id, lambda s: s.plan_redo(who=who), expected, idempotent=idempotent
        )
        self._metrics.edits.labels("redo").inc()
        return result

    # --- inside -----------------------------------------------------------------------------

    async def _create(
        self,
        name: str,
        scene: str,
        summary: SceneSummary,
        log: Sequence[HistoryEntry],
        *,
        idempotent: IdempotentRequest,
    ) -> ScenarioInfo:
        row = ScenarioRow(
            scenario_id=f"sc_{secrets.token_hex(8)}",
            name=name,
            scene=scene,
            scene_hash=summary.content_hash,
            created_us=now_us(),
        )
        scenario = await asyncio.to_thread(replayed, row, summary, log, self._assets)
        cached = CachedScenario(row, scenario, summary)
        info = _view(cached).info(tracks=False)
        reply = idempotent.reply(info, status=201, headers=created_headers(info))
        entries = [entry.model_dump(mode="json") for entry in log]
        await self._store.create_scenario(row, entries=entries, reply=reply)
        self._scenarios_cache.put(cached)
        return info

    async def _summary_of(self, document: ScenarioDocument) -> SceneSummary:
        for listing in (await self._scene_cache.refresh()).values():
            if listing.summary and listing.summary.content_hash == document.scene_hash:
                return listing.summary
        raise ServiceError(
            ErrorCode.UNKNOWN_SCENE,
            f"the scenario was made on scene {document.scene!r} with hash "
            f"{document.scene_hash[:12]}; no scene here has it",
            hint="put that bundle into the scene folder, or POST /v1/scenes to import it",
        )

    @uncancellable
    async def _change(
        self,
        scenario_id: str,
        plan: Callable[[Scenario], PlannedEntry],
        expected: int | None,
        *,
        dry_run: bool = False,
        idempotent: IdempotentRequest,
    ) -> OperationResult:
        for _ in range(MAX_RACES):
            # If another worker is faster, the change is planned again on top of its entry.
            with contextlib.suppress(ConflictError):
                return await self._change_once(
                    scenario_id, plan, expected, dry_run=dry_run, idempotent=idempotent
                )
        raise changed_elsewhere(scenario_id)

    async def _change_once(
        self,
        scenario_id: str,
        plan: Callable[[Scenario], PlannedEntry],
        expected: int | None,
        *,
        dry_run: bool,
        idempotent: IdempotentRequest,
    ) -> OperationResult:
        """Store a change based on the newest revision. Raises ConflictError if it is outdated."""
        async with self._scenarios_cache.locked(scenario_id) as cached:
            scenario = cached.scenario
            if expected is not None and expected != scenario.revision:
                self._metrics.edit_conflicts.inc()
                raise stale_revision(scenario, expected)

            def change() -> tuple[PlannedEntry, OperationResult]:
                # Overlap checks of large batches take milliseconds and need no device.
                planned = plan(scenario)
                revision = scenario.revision if dry_run else planned.entry.revision
                result = operation_result(planned, revision=revision, dry_run=dry_run)
                if not dry_run:
                    reply = idempotent.reply(result, status=200, headers=tag(result))
                    self._record(scenario_id, planned.entry, reply)
                return planned, result

            try:
                planned, result = await asyncio.to_thread(change)
            except (EditError, ConflictError):
                raise
            except Exception:
                # Only the store can tell whether the entry is in the log.
                self._scenarios_cache.evict(scenario_id)
                raise
            if not dry_run:
                scenario.commit(planned)
                self._snapshots.save_if_due(scenario_id, scenario.revision, scenario.state)
            return result

    def _record(self, scenario_id: str, entry: LogEntry, reply: StoredReply | None) -> None:
        fields = history_entry(entry).model_dump(mode="json")
        self._store.record_revision(
            scenario_id, entry.revision, fields, created_us=now_us(), reply=reply
        )


def _view(cached: CachedScenario) -> ScenarioView:
    scenario = cached.scenario
    return ScenarioView(
        row=cached.row,
        summary=cached.summary,
        state=scenario.state,
        revision=scenario.revision,
        can_undo=scenario.can_undo,
        can_redo=scenario.can_redo,
    )
