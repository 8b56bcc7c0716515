"""JSON Schema of every message, for planners in other languages.

``python -m real2sim_proto.schema DIR`` writes one file per message, as shown on the documentation
site. Each file is complete, except for storyboards: other files refer to ``Storyboard.json``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter

from . import (
    drive,
    errors,
    jobs,
    lanes,
    operations,
    scenarios,
    scenes,
    sessions,
    storyboard,
    sweeps,
)

MODELS: dict[str, type[BaseModel]] = {
    model.__name__: model
    for model in (
        drive.Hello,
        drive.Attach,
        drive.Reset,
        drive.Action,
        drive.Edit,
        drive.Render,
        drive.Agent,
        drive.Snapshot,
        drive.Restore,
        drive.Fork,
        drive.Bye,
        drive.Welcome,
        drive.Attached,
        drive.Obs,
        drive.Edited,
        drive.View,
        drive.Driven,
        drive.Kept,
        drive.Forked,
        drive.Progress,
        drive.Error,
        drive.Result,
        errors.Problem,
        scenes.ServerInfo,
        scenes.Fleet,
        scenes.Readiness,
        scenes.SceneInfo,
        scenes.SceneList,
        scenes.SceneImport,
        lanes.SceneLanes,
        sessions.SceneView,
        scenes.AssetCut,
        scenes.AssetPerson,
        scenes.AssetInfo,
        scenes.AssetList,
        jobs.JobInfo,
        jobs.JobList,
        jobs.SimulateRequest,
        jobs.CalibrateRequest,
        jobs.DriveRequest,
        jobs.ExportRequest,
        jobs.DatasetRequest,
        scenarios.ScenarioCreate,
        scenarios.ScenarioRename,
        scenarios.ScenarioFork,
        scenarios.ScenarioDocument,
        scenarios.ScenarioInfo,
        scenarios.ScenarioList,
        scenarios.OperationBatch,
        scenarios.OperationResult,
        scenarios.History,
        sessions.SessionCreate,
        sessions.SessionInfo,
        sessions.SessionList,
        sessions.SessionClock,
        sessions.StepRequest,
        sessions.SessionEdit,
        sessions.SessionEdited,
        sessions.SessionState,
        sessions.SessionRender,
        storyboard.Storyboard,
        sweeps.SweepRequest,
    )
}

UNIONS: dict[str, TypeAdapter[Any]] = {
    "Operation": operations.OPERATION,
    "ClientMessage": drive.CLIENT_MESSAGE,
    "ServerMessage": drive.SERVER_MESSAGE,
}

SHARED = ("Storyboard",)
"""Long messages that others contain; schemas refer to their files."""


def schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema (draft 2020-12) by message name; files of SHARED are referred to by name."""
    named = {name: model.model_json_schema() for name, model in MODELS.items()}
    named |= {name: adapter.json_schema() for name, adapter in UNIONS.items()}
    return {
        name: {"$schema": "https://json-schema.org/draft/2020-12/schema"} | _referring(schema)
        for name, schema in sorted(named.items())
    }


def _referring(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema with references to the files of SHARED, and without the definitions that only
    those files need."""
    files = {f"#/$defs/{name}": f"{name}.json" for name in SHARED}
    definitions = _renamed(schema.pop("$defs", {}), files)
    found: dict[str, Any] = _renamed(schema, files)
    needed: dict[str, Any] = {}
    wanted = _references(found)
    while wanted:
        name = wanted.pop()
        if name not in needed:
            needed[name] = definitions[name]
            wanted |= _references(definitions[name])
    return found | {"$defs": needed} if needed else found


def _renamed(part: Any, files: dict[str, str]) -> Any:
    if isinstance(part, dict):
        return {k: files.get(v, v) if k == "$ref" else _renamed(v, files) for k, v in part.items()}
    return [_renamed(each, files) for each in part] if isinstance(part, list) else part


def _references(part: Any) -> set[str]:
    """Names of the definitions in the same file that a part of a schema refers to."""
    if isinstance(part, dict):
        own = part.get("$ref", "")
        found = {own.rsplit("/", 1)[1]} if own.startswith("#/$defs/") else set()
        return found.union(*map(_references, part.values()))
    return set().union(*map(_references, part)) if isinstance(part, list) else set()


def schema_text(schema: dict[str, Any]) -> str:
    """Canonical file content of a schema."""
    return json.dumps(schema, indent=2, sort_keys=True) + "\n"


def write_schemas(folder: Path) -> list[Path]:
    """Write ``<Message>.json`` for every message into ``folder`` and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, schema in schemas().items():
        path = folder / f"{name}.json"
        path.write_text(schema_text(schema), encoding="utf-8")
        paths.append(path)
    return paths


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1]))
