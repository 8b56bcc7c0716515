"""The OpenAPI document: what FastAPI makes of the routes, with examples and true error types.

``python -m real2sim_server.service.write_openapi FILE`` writes it; the committed copy is
``docs/openapi.json``, and a test holds it against the routes.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI

from .auth import SESSION_SCHEME, WORKER_SCHEME
from .documented_errors import document_errors

METHODS = ("get", "put", "post", "delete", "patch")

PARAMETERS: dict[str, Any] = {
    "object_id": "car_3",
    "scene": "demo_street",
    "scenario": "sc_0123456789abcdef",
    "scenario_id": "sc_0123456789abcdef",
    "session_id": "w0.0123456789abcdef",
    "job_id": "job_0123456789abcdef",
    "asset_id": "red_car",
    "case": "cut_in",
    "name": "video.webm",
    "camera": "front",
    "t_us": 2_000_000,
    "width": 640,
    "after": 0,
}
"""An example of each parameter, by name."""

BODIES: dict[str, Any] = {
    "ScenarioCreate": {"scene": "demo_street", "name": "cut-in"},
    "ScenarioRename": {"name": "cut-in in the rain"},
    "ScenarioFork": {"name": "cut-in, later"},
    "ScenarioDocument": {
        "format": "real2sim.scenario",
        "version": 1,
        "name": "cut-in",
        "scene": "demo_street",
        "scene_hash": "0" * 64,
        "entries": [
            {
                "revision": 1,
                "kind": "edit",
                "operations": [{"op": "translate", "object_id": "car_0", "y": 3.5}],
                "created_at": "2026-01-01T12:00:00.000+00:00",
            }
        ],
    },
    "OperationBatch": {
        "operations": [
            {"op": "translate", "object_id": "van_0", "y": 3.5, "frame": "object", "snap": True},
            {"op": "rotate", "object_id": "car_6", "angle": 0.2618},
        ]
    },
    "CornerCaseChoice": {"name": "cut_in", "parameters": {"gap": 8.0}},
    "Storyboard": {
        "parameters": {"gap": 25.0},
        "entities": [
            {"name": name, "kind": kind, "box": {"size": [4.6, 1.9, 1.5], "centre": [1.4, 0, 0.75]}}
            for name, kind in (("Ego", "ego"), ("lead", "new"))
        ],
        "init": [
            {
                "entity": "lead",
                "action": {
                    "kind": "teleport",
                    "position": {"kind": "relative_object", "entity": "Ego", "dx": "$gap", "dy": 0},
                },
            }
        ],
    },
    "SimulateRequest": {"start_us": 0, "end_us": 2_000_000, "objects": ["car_0", "van_0"]},
    "DriveRequest": {"planner": "idm"},
    "SweepRequest": {
        "scene": "demo_street",
        "corner_case": "cut_in",
        "parameters": {"gap": {"kind": "float", "low": 2.0, "high": 20.0}},
        "method": {"kind": "sobol", "count": 8},
        "planners": ["idm"],
    },
    "SessionClock": {"state": "held", "steps": 5},
    "CalibrateRequest": {
        "object_id": "car_0",
        "parameters": ["friction", "speed"],
        "observations": {"recorded": True},
        "simulate": {"start_us": 0, "end_us": 2_000_000},
    },
    "ExportRequest": {"scenario": "sc_0123456789abcdef", "camera": "front", "fps": 10},
    "DatasetRequest": {
        "kind": "dataset",
        "scenario": "sc_0123456789abcdef",
        "formats": ["nuscenes", "coco"],
        "period_us": 500_000,
        "splits": {"train": 0.8, "val": 0.2},
    },
    "SessionCreate": {"reset": {"seed": 0, "dt_us": 100_000}},
    "ResetSpec": {"seed": 0, "dt_us": 100_000},
    "SessionEdit": {
        "operations": [
            {"op": "spawn", "recorded_id": "van_0", "place": {"ahead": 40.0}, "speed": 8.0}
        ]
    },
    "StepRequest": {"n": 10},
    "SceneView": {
        "t_us": 1_000_000,
        "cameras": [
            {
                "name": "above",
                "width": 640,
                "height": 360,
                "K": [[400, 0, 320], [0, 400, 180], [0, 0, 1]],
                "pose": {"position": [0, 0, 20], "quaternion": [0.271, -0.653, 0.653, -0.271]},
            }
        ],
        "objects": [{"object_id": "car_6", "pose": {"position": [25, 0, 0.8]}}],
    },
    "SessionRender": {"sensors": [{"camera": "front", "width": 640, "codec": "jpeg"}]},
}
"""An example of each JSON body, by the name of its schema."""

FILES = {"application/xml": "scenario.xosc"}
"""A file of the caller that a sample sends, by its media type."""

SAMPLE_QUERY: dict[str, tuple[str, ...]] = {"sessions-create": ("scene",)}
"""Query parameters of a call's sample, by operation, though none of them alone is required."""

TOKEN_OF = {WORKER_SCHEME: "$REAL2SIM_TOKEN", SESSION_SCHEME: "$SESSION_TOKEN"}
"""Variable of the shell that holds the token of a security scheme."""

_published: dict[str, Any] = {}


def published(app: FastAPI) -> dict[str, Any]:
    """The document, made once a process: it is the same for all settings.

    Made on demand it would keep the event loop busy for tenths of a second.
    """
    if not _published:
        _published.update(document(app))
    return _published


def document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of ``app``."""
    made = app.openapi()
    for path, method, operation in operations(made):
        document_errors(operation)
        _add_examples(operation)
        _add_worker_token(operation)
        operation["x-codeSamples"] = [{"lang": "Shell", "source": curl(path, method, operation)}]
    schemas = made["components"]["schemas"]
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    return made


def operations(made: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """(path, method, operation) of everything in a document."""
    for path, item in made["paths"].items():
        for method in METHODS:
            if method in item:
                yield path, method, item[method]


def curl(path: str, method: str, operation: dict[str, Any]) -> str:
    """A call of the operation for a shell, with ``$WORKER`` as its address, and with the token
    that it wants in a variable of :data:`TOKEN_OF`."""
    query, in_sample = [], SAMPLE_QUERY.get(operation["operationId"], ())
    for parameter in operation.get("parameters", ()):
        given = parameter.get("example")
        if parameter["in"] == "path":
            path = path.replace(f"{{{parameter['name']}}}", str(given))
        elif parameter["in"] == "query" and (
            parameter.get("required") or parameter["name"] in in_sample
        ):
            query.append(f"{parameter['name']}={given}")
    address = f'"$WORKER{path}{"?" + "&".join(query) if query else ""}"'
    words = ["curl", *([] if method == "get" else ["-X", method.upper()]), address]
    if schemes := operation.get("security"):
        token = TOKEN_OF[next(iter(schemes[0]))]
        words += ["-H", f'"Authorization: Bearer {token}"']
    content = operation.get("requestBody", {}).get("content", {})
    example = content.get("application/json", {}).get("example")
    if example is not None:
        words += ["-H", "'Content-Type: application/json'", "-d", shlex.quote(json.dumps(example))]
    for media_type in content.keys() & FILES.keys():
        words += ["-H", f"'Content-Type: {media_type}'"]
        words += ["--data-binary", f"@{FILES[media_type]}"]
    return " ".join(words)


def _add_examples(operation: dict[str, Any]) -> None:
    for parameter in operation.get("parameters", ()):
        if "example" not in parameter and parameter["name"] in PARAMETERS:
            parameter["example"] = PARAMETERS[parameter["name"]]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json")
    if body is not None and "example" not in body:
        name = _schema_name(body["schema"])
        if name in BODIES:
            body["example"] = BODIES[name]


def _add_worker_token(operation: dict[str, Any]) -> None:
    """The worker's token opens sessions, too: either will do."""
    schemes = operation.get("security", [])
    if {SESSION_SCHEME: []} in schemes and {WORKER_SCHEME: []} not in schemes:
        schemes.append({WORKER_SCHEME: []})


def _schema_name(schema: dict[str, Any]) -> str:
    references = [schema, *schema.get("anyOf", ()), *schema.get("oneOf", ())]
    return next((r["$ref"].rsplit("/", 1)[1] for r in references if "$ref" in r), "")


def text_of(made: dict[str, Any]) -> str:
    """The committed form of a document."""
    return json.dumps(made, indent=1, sort_keys=True) + "\n"
