"""Scenarios as the wire and the store have them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, overload

from real2sim_proto import ErrorCode
from real2sim_proto.operations import (
    OPERATIONS,
    Insert,
    Operation,
    Replace,
    Spawn,
    stored_operations,
)
from real2sim_proto.scenarios import HistoryEntry, OperationResult, ScenarioInfo

from ...edit import AssetLookup, LogEntry, PlannedEntry, Scenario, ScenarioState
from ...scene.io import SceneSummary
from ..http.problems import ServiceError
from ..http.responses import etag
from ..library.views import edited_objects
from ..storage.store import ScenarioRow


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
    """Headers of the answer to a creation."""
    return {"Location": f"/v1/scenarios/{info.scenario_id}", "ETag": info.etag}


def tag(result: OperationResult) -> dict[str, str]:
    """Headers of the answer to a change."""
    return {"ETag": result.etag}


class StoredOperations(Sequence[Operation]):
    """Operations as the store has them, made into models when one is looked at.

    They were checked when they were written; of a long log most are never looked at again.
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
        return OPERATIONS.validate_python(stored_operations(self._stored))


def stored_entry(stored: Mapping[str, Any]) -> LogEntry:
    """One revision as the store has it."""
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
    """The scenario that a log leads to. Raises EditError where it does not fit its scene."""
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
    """One revision as the wire has it."""
    return HistoryEntry(
        revision=entry.revision,
        kind=entry.kind,
        operations=list(entry.operations),
        target=entry.target,
        who=entry.who,
        created_at=entry.created_at,
    )


def asset_hashes(entries: Iterable[LogEntry], assets: AssetLookup | None) -> dict[str, str]:
    """Content hash of every asset that a log names, by id."""
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
    """The answer to a change."""
    return OperationResult(
        revision=revision,
        etag=etag(revision),
        created=list(planned.outcome.created),
        inverse=list(planned.outcome.inverse),
        warnings=list(planned.outcome.warnings),
        dry_run=dry_run,
    )


def stale_revision(scenario: Scenario, expected: int) -> ServiceError:
    """The refusal of a change made for another revision, with what was missed."""
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
    """The refusal of a change that another worker was faster than."""
    return ServiceError(
        ErrorCode.STALE_REVISION,
        f"another worker has changed scenario {scenario_id!r}",
        hint="read its operations and send the edit again",
    )


def listed_info(row: ScenarioRow, kinds: Sequence[str]) -> ScenarioInfo:
    """What a list says of a scenario, from the kinds of its log entries."""
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
    """The fields that every answer about a scenario has."""
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
    """An instant as the wire has it: UTC, ISO 8601."""
    return datetime.fromtimestamp(instant_us / 1e6, UTC).isoformat(timespec="milliseconds")
