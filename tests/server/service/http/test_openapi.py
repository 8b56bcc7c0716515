from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import httpx2
import pytest
from hypothesis import HealthCheck, given, settings

from real2sim_proto.jobs import DatasetRequest, ExportRequest, SimulateRequest
from real2sim_proto.scenarios import (
    CornerCaseChoice,
    OperationBatch,
    ScenarioCreate,
    ScenarioDocument,
    ScenarioFork,
)
from real2sim_proto.scenes import AssetCut
from real2sim_proto.storyboard import Storyboard
from real2sim_server.service.app import create_app
from real2sim_server.service.http.openapi import (
    BODIES,
    OF_OPERATION,
    operations,
    published,
    text_of,
)
from real2sim_server.service.serve import running_worker
from tests.waiting import LIMIT_S

HASHES = Path(__file__).resolve().parents[4] / "proto" / "contract.sha256"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, Any]:
    from real2sim_server.settings import Settings

    return published(create_app(Settings(data_dir=tmp_path_factory.mktemp("openapi"))))


def test_the_openapi_document_matches_the_recorded_hash(made):
    digest = hashlib.sha256(text_of(made).encode()).hexdigest()
    line = f"{digest}  openapi.json"
    assert line in HASHES.read_text().splitlines(), "run `make schema` if it is meant to change"


def test_every_operation_has_a_description_and_an_example(made):
    lacking = []
    for path, method, operation in operations(made):
        if not operation.get("description"):
            lacking.append(f"{method} {path}: description")
        for parameter in operation.get("parameters", ()):
            if parameter.get("required") and "example" not in parameter:
                lacking.append(f"{method} {path}: example of {parameter['name']}")
        body = operation.get("requestBody", {}).get("content", {}).get("application/json")
        if body is not None and "example" not in body:
            lacking.append(f"{method} {path}: example of the body")
        if "curl" not in operation["x-codeSamples"][0]["source"]:
            lacking.append(f"{method} {path}: call")
    assert lacking == []


def test_operation_ids_are_unique_and_errors_are_problem_documents(made):
    found = list(operations(made))
    ids = [operation["operationId"] for _, _, operation in found]
    assert len(set(ids)) == len(ids)
    for path, method, operation in found:
        for status, response in operation["responses"].items():
            if int(status) >= 400:
                content = response["content"]
                assert "application/problem+json" in content, f"{method} {path} {status}"


def test_every_operation_lists_its_statuses_and_error_codes(made):
    for path, method, operation in operations(made):
        assert "default" not in operation["responses"], f"{method} {path}"
        assert {"401", "403", "500", "503"} <= set(operation["responses"]), f"{method} {path}"
    edit = made["paths"]["/v1/scenarios/{scenario_id}/operations"]["post"]["responses"]
    assert "STALE_REVISION" in edit["412"]["description"]
    assert "UNKNOWN_SCENARIO" in edit["404"]["description"]


def test_error_codes_are_listed_for_existing_operations_only(made):
    ids = {operation["operationId"] for _, _, operation in operations(made)}
    assert set(OF_OPERATION) <= ids


def test_every_changing_post_accepts_an_idempotency_key(made):
    for path, method, operation in operations(made):
        if method == "post" and not path.endswith("/render"):
            names = [parameter["name"] for parameter in operation.get("parameters", ())]
            assert "Idempotency-Key" in names, path


@pytest.mark.parametrize(
    "model",
    [
        OperationBatch,
        ScenarioCreate,
        ScenarioDocument,
        ScenarioFork,
        SimulateRequest,
        ExportRequest,
        DatasetRequest,
        CornerCaseChoice,
        Storyboard,
    ],
)
def test_example_bodies_are_valid(model):
    model.model_validate_json(json.dumps(BODIES[model.__name__]))


def test_the_asset_cut_example_is_valid(made):
    body = made["paths"]["/v1/assets"]["post"]["requestBody"]["content"]["application/json"]
    AssetCut.model_validate(body["example"])


# These answer with streams that end with the job, or are sockets and pages of other programs.
UNFUZZED = ("/events", "/docs", "/ui")


TOKEN = "a long enough secret"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
VALID = {
    "expected-statuses": [200, 201, 202, 204, 304, 404, 406, 409, 410, 412, 413, 422, 429, 501, 503]
}
"""Statuses allowed for requests that are valid by the schema. Some checks need the scene."""


def examples(most: int) -> settings:
    return settings(
        max_examples=most,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


@pytest.mark.network
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "most", [3, pytest.param(30, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
)
def test_random_requests_pass_all_schemathesis_checks(make_settings, made, most):
    schemathesis = pytest.importorskip(
        "schemathesis", reason="not installed: pip install 'real2sim[dev]'"
    )
    from schemathesis.checks import load_all_checks

    load_all_checks()
    schema = schemathesis.openapi.from_dict(
        made, config=schemathesis.Config.from_dict({"checks": {"positive_data_acceptance": VALID}})
    )
    asked = 0
    with running_worker(make_settings(token=TOKEN)) as worker:

        def ask(case) -> None:
            nonlocal asked
            asked += 1
            response = case.call(base_url=worker.url, headers=BEARER, timeout=LIMIT_S)
            case.validate_response(response, headers=BEARER)

        for found in schema.get_all_operations():
            operation = found.ok()
            if not any(part in operation.path for part in UNFUZZED):
                examples(most)(given(case=operation.as_strategy())(ask))()
        assert httpx2.get(f"{worker.url}/livez", trust_env=False).status_code == 200
    assert asked > 100


@pytest.mark.network
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("opened_by", "most"),
    [
        ("session", 3),
        pytest.param("worker", 20, marks=[pytest.mark.slow, pytest.mark.timeout(1800)]),
    ],
)
def test_random_requests_on_existing_resources_get_documented_answers(
    make_settings, made, opened_by, most
):
    """With ids of a running session and a scenario, and the worker's or session's token."""
    schemathesis = pytest.importorskip(
        "schemathesis", reason="not installed: pip install 'real2sim[dev]'"
    )
    from schemathesis.checks import load_all_checks

    load_all_checks()
    config = {"checks": {"positive_data_acceptance": VALID}}
    schema = schemathesis.openapi.from_dict(made, config=schemathesis.Config.from_dict(config))
    statuses = set()
    with running_worker(make_settings(token=TOKEN)) as worker:
        there = {"scene": "tiny", "camera": "front"}
        with httpx2.Client(base_url=worker.url, headers=BEARER, trust_env=False) as client:
            session = client.post("/v1/sessions", params={"scene": "tiny"}, json={"reset": {}})
            there["session_id"] = session.json()["session_id"]
            scenario = client.post("/v1/scenarios", json={"scene": "tiny"})
            there["scenario_id"] = scenario.json()["scenario_id"]
        given_token = {"worker": TOKEN, "session": session.json()["token"]}[opened_by]
        headers = {"Authorization": f"Bearer {given_token}"}

        def ask(case) -> None:
            known = {k: v for k, v in there.items() if k in case.path_parameters}
            case.path_parameters = {**case.path_parameters, **known}
            response = case.call(base_url=worker.url, headers=headers, timeout=LIMIT_S)
            statuses.add(response.status_code)
            documented = case.operation.definition.raw["responses"]
            assert str(response.status_code) in documented, response.text
            if response.status_code < 400:
                case.validate_response(response, headers=headers)

        for found in schema.get_all_operations():
            operation = found.ok()
            named = [name for name in there if f"{{{name}}}" in operation.path]
            wanted = "session_id" in named or (opened_by == "worker" and named)
            if wanted and operation.method != "delete":
                examples(most)(given(case=operation.as_strategy())(ask))()
    assert {200, 422} <= statuses
    assert opened_by == "worker" or 401 not in statuses
