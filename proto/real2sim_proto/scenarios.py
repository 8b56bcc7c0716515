"""REST models of scenarios: a scene and an append-only log of operations."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .base import Identifier, Model, Named, one_of
from .operations import AddCollider, EraseRegion, Operation
from .scenes import ObjectInfo, Reply
from .storyboard import Storyboard
from .storyboard_values import Name

MAX_OPERATIONS_PER_REQUEST = 256


class ScenarioCreate(Model):
    """Body of `POST /v1/scenarios`."""

    scene: Identifier
    name: str = Field(default="", max_length=200)


class ScenarioRename(Model):
    """Body of `PATCH /v1/scenarios/{id}`."""

    name: str = Field(min_length=1, max_length=200)


class ScenarioInfo(Reply):
    """A scenario, and the scene after all its operations."""

    scenario_id: str
    name: str
    scene: str
    scene_hash: str
    revision: int = Field(description="increases by one with every batch, undo and redo")
    etag: str = Field(description='value for If-Match, e.g. "r41" with its quotes')
    created_at: str = Field(description="UTC, ISO 8601")
    can_undo: bool
    can_redo: bool
    start_us: int | None = Field(default=None, description="start time; single views only")
    end_us: int | None = Field(default=None, description="end time; single views only")
    objects: Named[ObjectInfo] = Field(default_factory=Named)
    erased: list[EraseRegion] = Field(
        default_factory=list, description="erased regions of the background"
    )
    colliders: list[AddCollider] = Field(default_factory=list)
    storyboard: Storyboard | None = Field(
        default=None, description="storyboard of its sessions; single views only"
    )


class ScenarioFork(Model):
    """Body of `POST /v1/scenarios/{id}/fork`: create a scenario with the same history."""

    name: str | None = Field(default=None, max_length=200, description="default: the same")
    revision: int | None = Field(
        default=None, ge=0, description="last revision to copy; default: the newest"
    )


class ScenarioList(Reply):
    """All scenarios of a worker."""

    scenarios: list[ScenarioInfo]


class OperationBatch(Model):
    """Body of `POST /v1/scenarios/{id}/operations`; all operations apply, or none."""

    operations: list[Operation] = Field(min_length=1, max_length=MAX_OPERATIONS_PER_REQUEST)
    dry_run: bool = Field(default=False, description="validate without applying")


class EditWarning(Reply):
    """A warning for the user; the operation took effect."""

    code: str = one_of(
        Literal["overlap", "off_ground", "outside_map", "sideways", "unseen_sides", "unseen_ground"]
    )
    object_id: str
    message: str


class OperationResult(Reply):
    """Answer to a batch, an undo or a redo."""

    revision: int
    etag: str
    created: list[str] = Field(default_factory=list, description="ids of new objects")
    inverse: list[Operation] = Field(default_factory=list, description="operations that reverse it")
    warnings: list[EditWarning] = Field(default_factory=list)
    dry_run: bool = False


class StoryboardResult(OperationResult):
    """Answer to an OpenSCENARIO file."""

    notes: list[str] = Field(
        default_factory=list, description="parts of the file without effect, one sentence each"
    )


class CornerCaseInfo(Reply):
    """A predefined corner case of the gallery."""

    name: str
    title: str = Field(description="description in one sentence")
    family: str
    parameters: dict[str, float] = Field(description="default values; [m], [m/s], [s]")
    picture: str = Field(
        default="", description="path of a top-down picture: an SVG document, 3 by 1"
    )


class Gallery(Reply):
    """Answer of `GET /v1/gallery`."""

    cases: list[CornerCaseInfo]


class CornerCaseChoice(Model):
    """Body of `POST /v1/scenarios/{id}/corner-case`."""

    name: Name = Field(description="name in the gallery, for example cut_in")
    parameters: dict[Name, float] = Field(
        default_factory=dict, max_length=100, description="values that replace the defaults"
    )


class HistoryEntry(Reply):
    """One revision."""

    revision: int
    kind: Literal["edit", "undo", "redo"]
    operations: list[Operation] = Field(
        default_factory=list,
        description="operations of an edit; an undo or redo has `target` instead",
    )
    target: int | None = Field(default=None, description="revision of the edit undone or redone")
    who: str = Field(default="", description="name given by the client")
    created_at: str


class History(Reply):
    """Answer of `GET /v1/scenarios/{id}/operations`, oldest first."""

    revision: int
    can_undo: bool
    can_redo: bool
    entries: list[HistoryEntry]


class ScenarioDocument(Reply):
    """A whole scenario in one file, for `GET .../export` and `POST .../import`.

    It refers to its scene by hash and to its assets by id and hash; it contains no Gaussians.
    """

    format: Literal["real2sim.scenario"] = "real2sim.scenario"
    version: Literal[1] = 1
    name: str = Field(default="", max_length=200)
    scene: str = Field(description="name of its scene on the worker that exported it")
    scene_hash: str = Field(pattern=r"^[0-9a-f]{64}$")
    assets: dict[str, str] = Field(default_factory=dict, description="content hash by asset id")
    entries: list[HistoryEntry] = Field(default_factory=list, max_length=100_000)
    exported_at: str = ""
