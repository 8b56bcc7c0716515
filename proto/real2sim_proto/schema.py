"""JSON Schema of every message, for planners in other languages.

``python -m real2sim_proto.schema DIR`` writes one file a message; the committed copies live in
``proto/schema`` and a test holds them against the models.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter

from . import (
    assets,
    drive,
    drive_batch,
    errors,
    jobs,
    lanes,
    operations,
    scenarios,
    scenes,
    sessions,
    views,
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
        drive_batch.BatchHello,
        drive_batch.BatchReset,
        drive_batch.BatchAction,
        drive_batch.BatchBye,
        drive_batch.BatchWelcome,
        drive_batch.BatchObs,
        drive_batch.BatchResult,
        errors.Problem,
        scenes.ServerInfo,
        scenes.Fleet,
        scenes.Readiness,
        scenes.SceneInfo,
        scenes.SceneList,
        scenes.SceneImport,
        lanes.SceneLanes,
        views.SceneView,
        assets.AssetCut,
        assets.AssetInfo,
        assets.AssetList,
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
    )
}

UNIONS: dict[str, TypeAdapter[Any]] = {
    "Operation": operations.OPERATION,
    "ClientMessage": drive.CLIENT_MESSAGE,
    "ServerMessage": drive.SERVER_MESSAGE,
    "BatchClientMessage": drive_batch.BATCH_CLIENT_MESSAGE,
    "BatchServerMessage": drive_batch.BATCH_SERVER_MESSAGE,
}


def schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema (draft 2020-12) by message name."""
    named = {name: model.model_json_schema() for name, model in MODELS.items()}
    named |= {name: adapter.json_schema() for name, adapter in UNIONS.items()}
    return {
        name: {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema
        for name, schema in sorted(named.items())
    }


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
    for written in write_schemas(Path(sys.argv[1] if len(sys.argv) > 1 else "proto/schema")):
        print(written)
