"""Scenarios of a worker: edited under a lock each, on record before they take effect."""

from __future__ import annotations

import asyncio
import secrets
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import (
    History,
    HistoryEntry,
    OperationResult,
    ScenarioCreate,
    ScenarioInfo,
)

from ..edit import LogEntry, Planned, Scenario, ScenarioState
from ..scene.io import SceneSummary
from .idempotency import Once
from .metrics import Metrics
from .problems import ServiceError
from .residency import Residency
from .store import ConflictError, ScenarioRow, Store, now_us
from .views import edited_objects, etag

KEPT_IN_MEMORY = 256
"""Scenarios kept ready; others are rebuilt from the store when they are asked for."""


@dataclass
class _Held:
    """A scenario in memory.

    Attributes:
        lock: one edit at a time; readers need none, for states are immutable.
    """

    row: ScenarioRow
    scenario: Scenario
    summary: SceneSummary
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


@dataclass(frozen=True, eq=False)
class ScenarioView:
    """A scenario at one revision: for answers, previews and new sessions. Never changes."""

    row: ScenarioRow
    summary: SceneSummary
    state: ScenarioState
    revision: int
    can_undo: bool
    can_redo: bool

    def info(self, *, tracks: bool = True) -> ScenarioInfo:
        """What the wire says about it; takes milliseconds where there are many trajectories."""
        return ScenarioInfo(
            **_head(self.row, self.revision),
            can_undo=self.can_undo,
            can_redo=self.can_redo,
            objects=edited_objects(self.state.visible, self.summary, tracks=tracks),
        )


class Scenarios:
    """All scenarios of a worker. Belongs to the event loop."""

    def __init__(self, store: Store, residency: Residency, metrics: Metrics) -> None:
        self._store = store
        self._residency = residency
        self._metrics = metrics
        self._held: OrderedDict[str, _Held] = OrderedDict()
        self._opening: dict[str, asyncio.Lock] = {}

    # --- life -------------------------------------------------------------------------------

    async def create(self, request: ScenarioCreate, *, once: Once) -> ScenarioInfo:
        """A new scenario, stored. Raises ServiceError: UNKNOWN_SCENE or SCENE_BROKEN."""
        summary = await self._residency.summary(request.scene)
        row = ScenarioRow(
            scenario_id=f"sc_{secrets.token_hex(8)}",
            name=request.name,
            scene=request.scene,
            scene_hash=summary.content_hash,
            created_us=now_us(),
        )
        scenario = await asyncio.to_thread(_replay, row, summary, [])
        held = _Held(row, scenario, summary)
        info = _view(held).info(tracks=False)
        reply = once.reply(info, status=201, headers=created_headers(info))
        await self._store.create_scenario(row, reply=reply)
        self._keep(held)
        return info

    async def delete(self, scenario_id: str) -> None:
        """Remove a scenario and its history. Raises ServiceError: UNKNOWN_SCENARIO."""
        async with self._exclusive(scenario_id):
            self._held.pop(scenario_id, None)
            await self._store.delete_scenario(scenario_id)

    # --- reading ----------------------------------------------------------------------------

    async def list(self) -> list[ScenarioInfo]:
        """All scenarios, oldest first, without their objects; those of missing scenes too."""
        kinds = await self._store.scenario_kinds()
        rows = await self._store.scenarios()
        return [_listed(row, kinds.get(row.scenario_id, [])) for row in rows]

    async def view(self, scenario_id: str) -> ScenarioView:
        """The scenario as it is now. Raises ServiceError: UNKNOWN_SCENARIO or SCENE_BROKEN."""
        return _view(await self._hold(scenario_id))

    async def history(self, scenario_id: str, *, after: int = 0) -> History:
        """Revisions behind ``after``, oldest first."""
        scenario = (await self._hold(scenario_id)).scenario
        return History(
            revision=scenario.revision,
            can_undo=scenario.can_undo,
            can_redo=scenario.can_redo,
            entries=[_history_entry(e) for e in scenario.entries[max(0, after) :]],
        )

    # --- editing ----------------------------------------------------------------------------

    async def edit(
        self,
        scenario_id: str,
        operations: Sequence[Operation],
        *,
        expected: int | None,
        dry_run: bool,
        once: Once,
    ) -> OperationResult:
        """Apply operations, all or none.

        Args:
            scenario_id: of the scenario.
            operations: in order.
            expected: revision they were made for; None for any.
            dry_run: check and answer, change nothing.
            once: what the answer is stored under.

        Raises:
            ServiceError: UNKNOWN_SCENARIO; STALE_REVISION, with the missed entries as member
                ``missed``; UNKNOWN_OBJECT or INVALID_OPERATION.
        """
        result = await self._change(
            scenario_id, lambda s: s.plan_edit(operations), expected, dry_run=dry_run, once=once
        )
        if not dry_run:
            for op, count in Counter(o.op for o in operations).items():
                self._metrics.edits.labels(op).inc(count)
        return result

    async def undo(self, scenario_id: str, *, expected: int | None, once: Once) -> OperationResult:
        """Take back the last edit in effect. Raises as :meth:`edit`, or NOTHING_TO_UNDO."""
        result = await self._change(scenario_id, Scenario.plan_undo, expected, once=once)
        self._metrics.edits.labels("undo").inc()
        return result

    async def redo(self, scenario_id: str, *, expected: int | None, once: Once) -> OperationResult:
        """Bring back the last undone edit. Raises as :meth:`edit`, or NOTHING_TO_REDO."""
        result = await self._change(scenario_id, Scenario.plan_redo, expected, once=once)
        self._metrics.edits.labels("redo").inc()
        return result

    # --- inside -----------------------------------------------------------------------------

    async def _change(
        self,
        scenario_id: str,
        plan: Callable[[Scenario], Planned],
        expected: int | None,
        *,
        dry_run: bool = False,
        once: Once,
    ) -> OperationResult:
        async with self._exclusive(scenario_id) as held:
            scenario = held.scenario
            if expected is not None and expected != scenario.revision:
                self._metrics.edit_conflicts.inc()
                raise _stale(scenario, expected)
            # Overlap checks of large batches take milliseconds; they need no device.
            planned = await asyncio.to_thread(plan, scenario)
            if dry_run:
                return _result(planned, revision=scenario.revision, dry_run=True)
            result = _result(planned, revision=planned.entry.revision)
            await self._record(held, planned, once.reply(result, status=200, headers=tag(result)))
            scenario.commit(planned)
            return result

    async def _record(self, held: _Held, planned: Planned, reply: Any) -> None:
        entry = planned.entry
        scenario_id = held.row.scenario_id
        try:
            await self._store.append_scenario_entry(
                scenario_id,
                entry.revision,
                _history_entry(entry).model_dump(mode="json"),
                created_us=now_us(),
                reply=reply,
            )
        except BaseException as error:
            # Cancelled or refused: only the store knows whether the entry is in the log.
            self._held.pop(scenario_id, None)
            if isinstance(error, ConflictError):
                raise ServiceError(
                    ErrorCode.STALE_REVISION,
                    f"another worker has changed scenario {scenario_id!r}",
                    hint="read its operations and send the edit again",
                ) from error
            raise

    @asynccontextmanager
    async def _exclusive(self, scenario_id: str) -> AsyncIterator[_Held]:
        while True:
            held = await self._hold(scenario_id)
            async with held.lock:
                # Whoever had the lock before may have dropped or deleted it.
                if self._held.get(scenario_id) is held:
                    yield held
                    return

    async def _hold(self, scenario_id: str) -> _Held:
        held = self._held.get(scenario_id)
        if held is None:
            lock = self._opening.setdefault(scenario_id, asyncio.Lock())
            try:
                async with lock:
                    held = self._held.get(scenario_id) or await self._rebuild(scenario_id)
                    self._keep(held)
            finally:
                if not lock.locked():
                    self._opening.pop(scenario_id, None)
        self._held.move_to_end(scenario_id)
        return held

    async def _rebuild(self, scenario_id: str) -> _Held:
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
        entries = await self._store.scenario_entries(scenario_id)
        return _Held(row, await asyncio.to_thread(_replay, row, summary, entries), summary)

    def _keep(self, held: _Held) -> None:
        self._held[held.row.scenario_id] = held
        if len(self._held) > KEPT_IN_MEMORY:
            for key in [k for k, h in self._held.items() if not h.lock.locked()][:-KEPT_IN_MEMORY]:
                del self._held[key]


def created_headers(info: ScenarioInfo) -> dict[str, str]:
    """Headers of the answer to a creation."""
    return {"Location": f"/v1/scenarios/{info.scenario_id}", "ETag": info.etag}


def tag(result: OperationResult) -> dict[str, str]:
    """Headers of the answer to a change."""
    return {"ETag": result.etag}


def _replay(row: ScenarioRow, summary: SceneSummary, entries: list[dict[str, Any]]) -> Scenario:
    log = [HistoryEntry.model_validate(entry) for entry in entries]
    return Scenario.replay(
        ScenarioState.of(summary),
        [LogEntry(e.revision, e.kind, tuple(e.operations), e.target, e.created_at) for e in log],
        scene=row.scene,
        scene_hash=row.scene_hash,
    )


def _history_entry(entry: LogEntry) -> HistoryEntry:
    return HistoryEntry(
        revision=entry.revision,
        kind=entry.kind,
        operations=list(entry.operations),
        target=entry.target,
        created_at=entry.created_at,
    )


def _result(planned: Planned, *, revision: int, dry_run: bool = False) -> OperationResult:
    return OperationResult(
        revision=revision,
        etag=etag(revision),
        created=list(planned.outcome.created),
        inverse=list(planned.outcome.inverse),
        warnings=list(planned.outcome.warnings),
        dry_run=dry_run,
    )


def _stale(scenario: Scenario, expected: int) -> ServiceError:
    entries = scenario.entries[max(0, expected) :]
    missed = [_history_entry(e).model_dump(mode="json") for e in entries]
    return ServiceError(
        ErrorCode.STALE_REVISION,
        f"the edit was made for revision {expected}; the scenario is at {scenario.revision}",
        hint="look at the missed entries and send the edit again with the new revision",
        extra={"revision": scenario.revision, "missed": missed},
        headers={"ETag": etag(scenario.revision)},
    )


def _view(held: _Held) -> ScenarioView:
    scenario = held.scenario
    return ScenarioView(
        row=held.row,
        summary=held.summary,
        state=scenario.state,
        revision=scenario.revision,
        can_undo=scenario.can_undo,
        can_redo=scenario.can_redo,
    )


def _listed(row: ScenarioRow, kinds: Sequence[str]) -> ScenarioInfo:
    done = undone = 0
    for kind in kinds:
        match kind:
            case "edit":
                done, undone = done + 1, 0
            case "undo":
                done, undone = done - 1, undone + 1
            case _:
                done, undone = done + 1, undone - 1
    return ScenarioInfo(**_head(row, len(kinds)), can_undo=done > 0, can_redo=undone > 0)


def _head(row: ScenarioRow, revision: int) -> dict[str, Any]:
    created = datetime.fromtimestamp(row.created_us / 1e6, UTC)
    return {
        "scenario_id": row.scenario_id,
        "name": row.name,
        "scene": row.scene,
        "scene_hash": row.scene_hash,
        "revision": revision,
        "etag": etag(revision),
        "created_at": created.isoformat(timespec="milliseconds"),
    }
