"""The OpenAPI document, possible errors of each call, and the API reference page."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator
from html import escape
from itertools import groupby
from typing import Any

from fastapi import FastAPI

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, ErrorCode
from real2sim_proto.errors import title_of

from .auth import SESSION_SCHEME, WORKER_SCHEME

C = ErrorCode

OF_EVERY_CALL = (
    C.BAD_MESSAGE,
    C.UNAUTHORIZED,
    C.FOREIGN_PAGE,
    C.FORBIDDEN,
    C.REQUEST_TIMEOUT,
    C.PAYLOAD_TOO_LARGE,
    C.TOO_MANY_REQUESTS,
    C.INTERNAL,
    C.QUEUE_FULL,
    C.DRAINING,
    C.TOO_MANY_CONNECTIONS,
    C.STORAGE_UNAVAILABLE,
    C.STORAGE_FULL,
)
_OF_SCENES = (C.UNKNOWN_SCENE, C.SCENE_BROKEN, C.OUT_OF_MEMORY)
OF_PARAMETER: dict[str, tuple[ErrorCode, ...]] = {
    "scene": _OF_SCENES,
    "scenario_id": (C.UNKNOWN_SCENARIO, *_OF_SCENES),
    "session_id": (
        C.UNKNOWN_SESSION,
        C.SESSION_CLOSED,
        *_OF_SCENES,
        C.OVER_CAPACITY,
        C.TOO_MANY_SESSIONS,
    ),
    "job_id": (C.UNKNOWN_JOB,),
    "asset_id": (C.UNKNOWN_ASSET,),
    "accept": (C.NOT_ACCEPTABLE,),
    "If-Match": (C.STALE_REVISION,),
    "Idempotency-Key": (C.IDEMPOTENCY_CONFLICT,),
    "camera": (C.UNKNOWN_CAMERA,),
    "t_us": (C.TIME_OUT_OF_RANGE,),
}
"""Error codes by name of path, query and header parameters."""

_OF_EDITS = (C.INVALID_OPERATION, C.UNKNOWN_OBJECT, C.UNKNOWN_ASSET, C.ALREADY_EXISTS)
_OF_EPISODES = (C.NOT_RESET, C.EPISODE_OVER, C.CONTROLLER_TAKEN, C.INVALID_ACTION)
OF_OPERATION: dict[str, tuple[ErrorCode, ...]] = {
    "assets-add": (
        C.QUOTA_EXCEEDED,
        C.UNKNOWN_OBJECT,
        C.ALREADY_EXISTS,
        C.IMPORT_FAILED,
        *_OF_SCENES,
    ),
    "assets-delete": (C.ASSET_IN_USE,),
    "exports-create": (
        *_OF_SCENES,
        C.UNKNOWN_SCENARIO,
        C.UNKNOWN_JOB,
        C.UNKNOWN_SESSION,
        C.SESSION_CLOSED,
        C.NOT_RESET,
        C.JOB_NOT_DONE,
        C.UNSUPPORTED,
        C.TOO_MANY_JOBS,
        C.QUOTA_EXCEEDED,
    ),
    "health-metrics": (C.NOT_FOUND,),
    "jobs-file": (C.JOB_NOT_DONE, C.NOT_FOUND),
    "jobs-preview": (C.JOB_NOT_DONE, C.JOB_FAILED, *_OF_SCENES),
    "scenarios-create": _OF_SCENES,
    "scenarios-edit": _OF_EDITS,
    "scenarios-import_": (*_OF_SCENES, *_OF_EDITS),
    "scenarios-points": (*_OF_SCENES, C.TIME_OUT_OF_RANGE),
    "scenarios-redo": (C.NOTHING_TO_REDO,),
    "scenarios-simulate": (C.TOO_MANY_JOBS, C.QUOTA_EXCEEDED, C.UNSUPPORTED, C.UNKNOWN_OBJECT),
    "scenarios-undo": (C.NOTHING_TO_UNDO,),
    "scenes-import_": (
        C.QUOTA_EXCEEDED,
        C.IMPORT_FAILED,
        C.ALREADY_EXISTS,
        C.NOT_FOUND,
        C.OUT_OF_MEMORY,
    ),
    "scenes-load": (C.JOB_FAILED,),
    "scenes-sky": (C.NOT_FOUND,),
    "scenes-splats": (C.NOT_FOUND, C.UNKNOWN_OBJECT),
    "scenes-unload": (C.SCENE_IN_USE,),
    "sessions-create": (
        *_OF_SCENES,
        C.UNKNOWN_SCENARIO,
        C.UNKNOWN_CAMERA,
        C.OVER_CAPACITY,
        C.TOO_MANY_SESSIONS,
    ),
    "sessions-edit": (*_OF_EDITS, C.NOT_RESET, C.STALE_REVISION),
    "sessions-fork": _OF_EPISODES,
    "sessions-recording": _OF_EPISODES,
    "sessions-render": (*_OF_EPISODES, C.UNKNOWN_CAMERA, C.NOT_ACCEPTABLE),
    "sessions-reset": (*_OF_EPISODES, C.UNKNOWN_CAMERA),
    "sessions-state": _OF_EPISODES,
    "sessions-step": _OF_EPISODES,
    "storyboards-apply_corner_case": _OF_EDITS,
    "storyboards-import_xosc": _OF_EDITS,
    "storyboards-picture": (C.NOT_FOUND,),
    "storyboards-remove": _OF_EDITS,
    "storyboards-replace": _OF_EDITS,
    "sweeps-create": (*_OF_SCENES, C.TOO_MANY_JOBS, C.QUOTA_EXCEEDED),
}
"""Error codes that do not follow from the parameters, by operation id."""


def document_errors(operation: dict[str, Any]) -> None:
    """Document one reply per error status of an operation, and remove others."""
    responses = operation["responses"]
    for undocumented in ("422", "default"):
        responses.pop(undocumented, None)
    by_status: dict[str, list[ErrorCode]] = {}
    for code in dict.fromkeys(_codes(operation)):
        by_status.setdefault(str(HTTP_STATUS[code]), []).append(code)
    for status, codes in by_status.items():
        if status in responses:  # the operation describes it in more detail
            responses[status].setdefault("content", {})[PROBLEM_MEDIA_TYPE] = _content()
            continue
        told = "; ".join(f"`{code.value}`: {title_of(code).lower()}" for code in codes)
        responses[status] = {"description": told, "content": {PROBLEM_MEDIA_TYPE: _content()}}


def _codes(operation: dict[str, Any]) -> Iterable[ErrorCode]:
    yield from OF_EVERY_CALL
    parameters = operation.get("parameters", ())
    if parameters or "requestBody" in operation:
        yield C.INVALID_REQUEST
    for parameter in parameters:
        yield from OF_PARAMETER.get(parameter["name"], ())
    yield from OF_OPERATION.get(operation["operationId"], ())


def _content() -> dict[str, Any]:
    return {"schema": {"$ref": "#/components/schemas/Problem"}}


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
"""Sample upload file by media type."""

SAMPLE_QUERY: dict[str, tuple[str, ...]] = {"sessions-create": ("scene",)}
"""Optional query parameters to show in an operation's sample."""

TOKEN_OF = {WORKER_SCHEME: "$REAL2SIM_TOKEN", SESSION_SCHEME: "$SESSION_TOKEN"}
"""Shell variable with the token of each security scheme."""

_published: dict[str, Any] = {}


def published(app: FastAPI) -> dict[str, Any]:
    """The document, computed once per process because it does not depend on settings.

    Computing it during a request would block the event loop for some tenths of a second.
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
    """(path, method, operation) of all calls in a document."""
    for path, item in made["paths"].items():
        for method in METHODS:
            if method in item:
                yield path, method, item[method]


def curl(path: str, method: str, operation: dict[str, Any]) -> str:
    """A curl call of the operation, with the address ``$WORKER`` and the token in a variable of
    :data:`TOKEN_OF`."""
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
    """Allow the worker's token, too, for calls that accept a session's token."""
    schemes = operation.get("security", [])
    if {SESSION_SCHEME: []} in schemes and {WORKER_SCHEME: []} not in schemes:
        schemes.append({WORKER_SCHEME: []})


def _schema_name(schema: dict[str, Any]) -> str:
    references = [schema, *schema.get("anyOf", ()), *schema.get("oneOf", ())]
    return next((r["$ref"].rsplit("/", 1)[1] for r in references if "$ref" in r), "")


def text_of(made: dict[str, Any]) -> str:
    """The committed form of a document."""
    return json.dumps(made, indent=1, sort_keys=True) + "\n"


STYLE = "ui/docs.css"
POLICY = (
    "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Content security policy of the page."""


def reference_page(made: dict[str, Any]) -> str:
    """The reference page of a document."""
    info = made["info"]
    found = sorted(operations(made), key=lambda found: _tag(found[2]))
    tags = [(tag, list(group)) for tag, group in groupby(found, key=lambda found: _tag(found[2]))]
    return "\n".join(
        (
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f"<title>{escape(info['title'])}</title>",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<link rel="stylesheet" href="{STYLE}"></head><body>',
            f"<h1>{escape(info['title'])} <small>{escape(info['version'])}</small></h1>",
            '<p>The same for programs: <a href="openapi.json">openapi.json</a>. In the examples '
            "<code>$WORKER</code> is the address of this worker, <code>$REAL2SIM_TOKEN</code> its "
            "token, if it has one, and <code>$SESSION_TOKEN</code> the <code>token</code> in the "
            "answer that made the session.</p>",
            "<nav>",
            *(f'<a href="#{escape(tag)}">{escape(tag)}</a>' for tag, _ in tags),
            "</nav>",
            *(line for tag, group in tags for line in _section(tag, group)),
            "<h2>Schemas</h2>",
            *_schemas(made["components"]["schemas"]),
            "</body></html>",
        )
    )


def _section(tag: str, group: list[tuple[str, str, dict[str, Any]]]) -> Iterator[str]:
    yield f'<h2 id="{escape(tag)}">{escape(tag)}</h2>'
    for path, method, operation in group:
        yield f'<details id="{escape(operation["operationId"])}"><summary>'
        yield f"<b>{method.upper()}</b> <code>{escape(path)}</code> "
        yield f"{escape(operation.get('summary', ''))}</summary>"
        yield f"<p>{escape(operation.get('description', ''))}</p>"
        yield from _parameters(operation.get("parameters", ()))
        yield from _contents("Body", operation.get("requestBody", {}).get("content", {}))
        yield "<table><tr><th>status</th><th>answer</th></tr>"
        for status, response in sorted(operation["responses"].items()):
            kinds = ", ".join(response.get("content", ()))
            described = escape(f"{response.get('description', '')}")
            yield f"<tr><td>{status}</td><td>{described} <i>{escape(kinds)}</i></td></tr>"
        yield f"</table><pre>{escape(operation['x-codeSamples'][0]['source'])}</pre></details>"


def _parameters(parameters: Any) -> Iterator[str]:
    if not parameters:
        return
    yield "<table><tr><th>parameter</th><th>in</th><th>meaning</th></tr>"
    for parameter in parameters:
        name = escape(parameter["name"]) + (" *" if parameter.get("required") else "")
        meaning = escape(parameter.get("description", ""))
        schema = escape(_kind(parameter.get("schema", {})))
        yield f"<tr><td><code>{name}</code></td><td>{escape(parameter['in'])}</td>"
        yield f"<td>{meaning} <i>{schema}</i></td></tr>"
    yield "</table>"


def _contents(title: str, contents: dict[str, Any]) -> Iterator[str]:
    for kind, content in contents.items():
        yield f"<p>{title}: <code>{escape(kind)}</code> {_linked(content.get('schema', {}))}</p>"
        if "example" in content:
            yield f"<pre>{escape(json.dumps(content['example'], indent=1))}</pre>"


def _schemas(schemas: dict[str, Any]) -> Iterator[str]:
    for name, schema in sorted(schemas.items()):
        yield f'<details id="schema-{escape(name)}"><summary><code>{escape(name)}</code></summary>'
        yield f"<p>{escape(schema.get('description', ''))}</p>"
        yield f"<pre>{escape(json.dumps(schema, indent=1))}</pre></details>"


def _linked(schema: dict[str, Any]) -> str:
    name = _reference(schema)
    return f'<a href="#schema-{escape(name)}">{escape(name)}</a>' if name else ""


def _kind(schema: dict[str, Any]) -> str:
    choices = schema.get("anyOf", [schema])
    kinds = [str(c.get("type") or _reference(c) or "") for c in choices]
    return " or ".join(kind for kind in kinds if kind and kind != "null")


def _reference(schema: dict[str, Any]) -> str:
    choices = [schema, *schema.get("anyOf", ())]
    return next((c["$ref"].rsplit("/", 1)[1] for c in choices if "$ref" in c), "")


def _tag(operation: dict[str, Any]) -> str:
    return str(operation.get("tags", ["worker"])[0])
