from __future__ import annotations

import pytest

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, ErrorCode, Problem
from real2sim_server.render import RenderError
from real2sim_server.scene import TimeOutOfRangeError, UnknownObjectError
from real2sim_server.service.engine import QueueFullError
from real2sim_server.service.http.responses import ServiceError, service_error


def problem_of(response) -> Problem:
    assert response.headers["content-type"] == PROBLEM_MEDIA_TYPE
    problem = Problem.model_validate(response.json())
    assert problem.status == response.status_code == HTTP_STATUS[problem.code]
    assert problem.request_id == response.headers["X-Request-Id"]
    return problem


@pytest.mark.parametrize("code", list(ErrorCode))
def test_every_code_has_a_status(code):
    assert 400 <= ServiceError(code, "detail").status <= 599


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (QueueFullError("full"), ErrorCode.QUEUE_FULL),
        (TimeOutOfRangeError("late"), ErrorCode.TIME_OUT_OF_RANGE),
        (UnknownObjectError("who"), ErrorCode.UNKNOWN_OBJECT),
        (RenderError("what"), ErrorCode.INVALID_REQUEST),
        (MemoryError(), ErrorCode.OUT_OF_MEMORY),
        (KeyError("secret"), ErrorCode.INTERNAL),
    ],
)
def test_errors_of_other_modules_are_mapped_to_their_code(error, code):
    assert service_error(error).code is code


def test_an_unknown_path_returns_a_problem(client):
    problem = problem_of(client.get("/v1/nothing"))
    assert problem.code is ErrorCode.NOT_FOUND
    assert problem.instance == "/v1/nothing"


def test_a_method_that_is_not_allowed_returns_the_allowed_methods(client):
    response = client.put("/v1/server")
    assert problem_of(response).code is ErrorCode.METHOD_NOT_ALLOWED
    assert response.headers["Allow"] == "GET, HEAD"


def test_malformed_json_returns_a_problem_about_the_body(client):
    response = client.post(
        "/v1/scenarios", content=b'{"scene": ', headers={"Content-Type": "application/json"}
    )
    problem = problem_of(response)
    assert problem.code is ErrorCode.INVALID_REQUEST
    assert "not valid JSON" in problem.errors[0].message


def test_invalid_values_are_reported_as_json_pointers_into_the_body(client):
    body = {"operations": [{"op": "translate", "object_id": "a"}, {"op": "scale", "x": -1}]}
    problem = problem_of(client.post("/v1/scenarios/any/operations", json=body))
    assert [e.pointer for e in problem.errors] == ["/operations/1/object_id", "/operations/1/x"]


def test_unknown_members_are_refused(client):
    problem = problem_of(client.post("/v1/scenarios", json={"scene": "tiny", "sceen": "x"}))
    assert [e.pointer for e in problem.errors] == ["/sceen"]


def test_an_invalid_query_value_is_reported_by_its_pointer(client):
    problem = problem_of(client.get("/v1/scenes/tiny/render?camera=front&width=1"))
    assert [e.pointer for e in problem.errors] == ["/query/width"]


@pytest.mark.parametrize("streamed", [False, True])
def test_a_body_above_the_limit_is_refused(start_worker, streamed):
    client = start_worker(max_request_bytes=2048)
    content = b'{"scene": "' + b"x" * 4096 + b'"}'
    response = client.post(
        "/v1/scenarios",
        content=iter([content[:1000], content[1000:]]) if streamed else content,
        headers={"Content-Type": "application/json"},
    )
    problem = problem_of(response)
    assert problem.code is ErrorCode.PAYLOAD_TOO_LARGE
    assert "2048" in problem.detail


def test_an_unexpected_error_is_logged_and_hides_private_details(client, monkeypatch, logged):
    async def fail(self):
        raise KeyError("the password is 1234")

    monkeypatch.setattr(type(client.app.state.worker.scenarios), "list", fail)
    response = client.get("/v1/scenarios", headers={"X-Request-Id": "mine"})
    problem = problem_of(response)
    assert problem.code is ErrorCode.INTERNAL
    assert problem.request_id == "mine"
    assert "1234" not in response.text
    assert any(isinstance(entry.get("exc_info"), KeyError) for entry in logged)


def test_a_full_queue_is_retryable_and_sends_retry_after(client, monkeypatch):
    async def full(*_args, **_kwargs):
        raise QueueFullError("64 jobs wait")

    monkeypatch.setattr(client.app.state.worker.engine, "call", full)
    response = client.get("/v1/scenes/tiny/render?camera=front")
    problem = problem_of(response)
    assert problem.code is ErrorCode.QUEUE_FULL
    assert problem.retryable
    assert int(response.headers["Retry-After"]) >= 1


def test_a_request_id_is_echoed(client):
    assert (
        client.get("/livez", headers={"X-Request-Id": "abc-1"}).headers["X-Request-Id"] == "abc-1"
    )


@pytest.mark.parametrize("given", ["", "a" * 81, "new line", "<script>"])
def test_an_unsafe_request_id_is_replaced(client, given):
    sent_back = client.get("/livez", headers={"X-Request-Id": given}).headers["X-Request-Id"]
    assert sent_back != given
    assert len(sent_back) == 32


def test_each_request_gets_one_log_line(client, logged):
    client.get("/v1/server")
    (line,) = [entry for entry in logged if entry["event"] == "request"]
    assert (line["method"], line["path"], line["status"]) == ("GET", "/v1/server", 200)


def test_a_query_parameter_in_the_body_is_told_where_it_belongs(client):
    for name in ("scene", "scenario"):
        problem = problem_of(client.post("/v1/sessions", json={name: "tiny"}))
        said = f"belongs in the address, not in the body: POST /v1/sessions?{name}=..."
        assert problem.detail == f"/{name}: {said}"


def test_a_number_that_is_none_is_refused_in_words(client):
    response = client.post(
        "/v1/sessions?scene=tiny",
        content=b'{"reset": {"ego": {"max_steer": NaN}}}',
        headers={"Content-Type": "application/json"},
    )
    said = "/reset/ego/max_steer: must be a finite number, got NaN"
    assert problem_of(response).detail == said
