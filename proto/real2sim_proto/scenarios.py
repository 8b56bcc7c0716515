"""REST models of scenarios: a scene and an append-only log of operations."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .base import Identifier, Model
from .operations import Operation
from .scenes import ObjectInfo, Reply

MAX_OPERATIONS_PER_REQUEST = 256


class ScenarioCreate(Model):
    """Body of `POST /v1/scenarios`."""

    scene: Identifier
    name: str = Field(default="", max_length=200)


class ScenarioInfo(Reply):
    """A scenario and what it looks like after all its operations."""

    scenario_id: str
    name: str
    scene: str
    scene_hash: str
    revision: int = Field(description="grows by one with every batch, undo and redo")
    etag: str = Field(description='value for If-Match, e.g. "r41" with its quotes')
    created_at: str = Field(description="UTC, ISO 8601")
    can_undo: bool
    can_redo: bool
    objects: list[ObjectInfo] = Field(default_factory=list)


class ScenarioList(Reply):
    """All scenarios of a worker."""

    scenarios: list[ScenarioInfo]


class OperationBatch(Model):
    """Body of `POST /v1/scenarios/{id}/operations`; all of them apply, or none."""

    operations: list[Operation] = Field(min_length=1, max_length=MAX_OPERATIONS_PER_REQUEST)
    dry_run: bool = Field(default=False, description="check and answer, change nothing")


class EditWarning(Reply):
    """Something a person should look at; the operation took effect all the same."""

    code: Literal["overlap", "off_ground", "outside_map"]
    object_id: str
    message: str


class OperationResult(Reply):
    """Answer to a batch, an undo or a redo."""

    revision: int
    etag: str
    created: list[str] = Field(default_factory=list, description="ids of new objects")
    inverse: list[Operation] = Field(default_factory=list, description="what takes it back")
    warnings: list[EditWarning] = Field(default_factory=list)
    dry_run: bool = False


class HistoryEntry(Reply):
    """One revision."""

    revision: int
    kind: Literal["edit", "undo", "redo"]
    operations: list[Operation] = Field(
        default_factory=list, description="of an edit; an undo or redo names `target` instead"
    )
    target: int | None = Field(default=None, description="revision of the edit undone or redone")
    created_at: str


class History(Reply):
    """Answer of `GET /v1/scenarios/{id}/operations`, oldest first."""

    revision: int
    can_undo: bool
    can_redo: bool
    entries: list[HistoryEntry]
