"""The curl samples of the OpenAPI document, run unchanged, with and without a worker token."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from real2sim_server.scenarios.gallery import corner_case
from real2sim_server.scenarios.openscenario import write_openscenario
from real2sim_server.scene import Lane, LaneGraph
from real2sim_server.scene.io import save_scene
from real2sim_server.service.app import create_app
from real2sim_server.service.http.openapi import operations, published

TOKEN = "a long enough secret"
STREAMS = ("jobs-events",)
"""Calls whose response lasts as long as a job."""
ENDS = (
    "sessions-delete",
    "storyboards-remove",
    "scenarios-delete",
    "assets-delete",
    "jobs-cancel",
    "scenes-unload",
)
"""Called last, because they remove what others need."""
FILES = {"@scenario.xosc": write_openscenario(corner_case("ccrb").storyboard())}
"""Files used by the samples."""
REFUSED = {400, 401, 403, 404, 405, 406, 410, 413, 415, 422}
"""Statuses that mean that the call itself was invalid."""
OBJECTS = {"van_0": "car_red", "car_0": "car_blue", "car_3": "car_red", "car_6": "post"}


@pytest.fixture(scope="module")
def demo_street(tiny_scene, tmp_path_factory) -> Path:
    """A scenes folder with a small scene that uses the demo's names."""
    folder = tmp_path_factory.mktemp("scenes")
    named = {
        name: replace(tiny_scene.objects[source], object_id=name)
        for name, source in OBJECTS.items()
    }
    line = np.array([[-20.0, 0.0, 0.0], [80.0, 0.0, 0.0]])
    lanes = LaneGraph.of([Lane("own", "driving", line, np.full(2, 3.5))])
    scene = replace(tiny_scene, name="demo_street", objects=named, lanes=lanes)
    save_scene(scene, folder / "demo_street.r2s")
    return folder


@pytest.fixture
def client(make_settings, demo_street, tiny_scene, tmp_path, request) -> Any:
    """A worker on that folder, with the parametrized token and a scene to import."""
    save_scene(tiny_scene, tmp_path / "import" / "street.r2s")
    app = create_app(make_settings(scenes_dir=demo_street, token=request.param))
    with TestClient(app, base_url="http://127.0.0.1") as client:
        yield client


@pytest.fixture
def samples(make_settings) -> dict[str, str]:
    """Samples by operation id, in an order in which they can be run."""
    found = {
        o["operationId"]: o["x-codeSamples"][0]["source"] for _, _, o in _operations(make_settings)
    }
    last = {name: found.pop(name) for name in ENDS}
    return found | last


def _operations(make_settings) -> list[tuple[str, str, dict[str, Any]]]:
    return list(operations(published(create_app(make_settings()))))


def call(client: TestClient, sample: str, variables: dict[str, str]) -> Any:
    """Run a sample as a shell would."""
    for name, value in variables.items():
        sample = sample.replace(f"${name}", value)
    words = shlex.split(sample)
    assert words.pop(0) == "curl"
    method, headers, data, url = "GET", {}, None, ""
    while words:
        match words.pop(0):
            case "-X":
                method = words.pop(0)
            case "-H":
                name, _, value = words.pop(0).partition(": ")
                headers[name] = value
            case "-d":
                data = words.pop(0)
            case "--data-binary":
                data = FILES[words.pop(0)]
            case other:
                url = other
    return client.request(method, url, headers=headers, content=data)


def prepared(client: TestClient, token: str | None) -> tuple[dict[str, str], dict[str, str]]:
    """Map ids in samples to ids that exist. Also returns the shell variables."""
    bearer = {"Authorization": f"Bearer {token}"} if token else {}
    there = {
        "sc_0123456789abcdef": client.post(
            "/v1/scenarios", json={"scene": "demo_street"}, headers=bearer
        ).json()["scenario_id"]
    }
    spec = {"reset": {"seed": 0}}
    session = client.post(
        "/v1/sessions", params={"scene": "demo_street"}, json=spec, headers=bearer
    ).json()
    there["w0.0123456789abcdef"] = session["session_id"]
    ask = {"scene": "demo_street", "camera": "front", "fps": 1, "width": 32}
    there["job_0123456789abcdef"] = client.post("/v1/exports", json=ask, headers=bearer).json()[
        "job_id"
    ]
    scene = client.get("/v1/scenes/demo_street", headers=bearer).json()
    there["0" * 64] = scene["content_hash"]
    variables = {
        "WORKER": "",
        "REAL2SIM_TOKEN": token or "",
        "SESSION_TOKEN": session["token"],
    }
    return there, variables


@pytest.mark.parametrize("client", [None, TOKEN], indirect=True, ids=["open", "token"])
def test_samples_succeed_unchanged(client, samples, request):
    token = request.node.callspec.params["client"]
    there, variables = prepared(client, token)
    refused = {}
    for name, sample in samples.items():
        if name in STREAMS:
            continue
        pattern = re.compile("|".join(map(re.escape, there)))
        real = pattern.sub(lambda found: there[found.group()], sample)
        answer = call(client, real, variables)
        if answer.status_code in REFUSED - _EXPECTED.get(name, set()):
            refused[name] = f"{answer.status_code} {answer.text[:200]}"
    assert refused == {}


_EXPECTED: dict[str, set[int]] = {
    # The sample names a file of another job kind, and a video job has no preview.
    "jobs-file": {404},
    "jobs-preview": {404, 422},
}


@pytest.mark.parametrize("client", [None, TOKEN], indirect=True, ids=["open", "token"])
def test_the_document_marks_exactly_the_calls_that_require_a_token(client, make_settings, request):
    token = request.node.callspec.params["client"]
    there, _ = prepared(client, token)
    wrong = {}
    for path, method, operation in _operations(make_settings):
        if operation["operationId"] in STREAMS:
            continue
        url = re.sub(r"\{[^}]*\}", "x", path.replace("{session_id}", there["w0.0123456789abcdef"]))
        schemes = {name for scheme in operation.get("security", ()) for name in scheme}
        wanted = "SessionToken" in schemes or (token is not None and bool(schemes))
        status = client.request(method.upper(), url).status_code
        if (status == 401) != wanted:
            wrong[operation["operationId"]] = (status, sorted(schemes))
    assert wrong == {}


def test_a_session_token_does_not_open_another_session(make_settings, demo_street):
    with TestClient(create_app(make_settings(scenes_dir=demo_street))) as client:
        client.base_url = "http://127.0.0.1"
        made = [
            client.post("/v1/sessions", params={"scene": "demo_street"}).json() for _ in range(2)
        ]
        url = f"/v1/sessions/{made[0]['session_id']}"
        statuses = [
            client.get(url, headers={"Authorization": f"Bearer {one['token']}"}).status_code
            for one in made
        ]
    assert statuses == [200, 401]


def test_the_document_describes_session_authentication(make_settings):
    made = published(create_app(make_settings()))
    schemes = made["components"]["securitySchemes"]
    assert set(schemes) == {"WorkerToken", "SessionToken"}
    assert "POST /v1/sessions" in schemes["SessionToken"]["description"]
    for path, method, operation in operations(made):
        expected = [{"SessionToken": []}, {"WorkerToken": []}]
        if "{session_id}" in path:
            assert operation["security"] == expected, f"{method} {path}"
        elif path.startswith("/v1"):
            assert operation["security"] == expected[1:], f"{method} {path}"
    assert json.dumps(made)
