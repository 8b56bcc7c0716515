"""Requests and responses without a network."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable

import httpx2
import numpy as np
import pytest

import real2sim
from real2sim.errors import CapacityError
from real2sim_proto import encode

from .fake_episode import IMAGE, frame

Handler = Callable[[httpx2.Request], httpx2.Response]
SCENES = {"scenes": [{"scene": "street", "state": "resident"}]}


class Script:
    """Answers in order, then repeats the last answer."""

    def __init__(self, *answers: httpx2.Response | Exception) -> None:
        self.answers = list(answers)
        self.requests: list[httpx2.Request] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        request.read()
        self.requests.append(request)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer


def client_of(handler: Handler, **options: object) -> real2sim.Client:
    transport = httpx2.MockTransport(handler)
    return real2sim.connect("http://worker:8600", transport=transport, **options)


def problem(status: int, code: str, **members: object) -> httpx2.Response:
    body = {"status": status, "code": code, "title": code, "detail": f"about {code}"} | members
    headers = {"content-type": "application/problem+json"}
    return httpx2.Response(status, content=json.dumps(body).encode(), headers=headers)


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    delays: list[float] = []
    monkeypatch.setattr("real2sim._sync.transport.sleep", delays.append)
    return delays


# --- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "code", "error"),
    [
        (401, "UNAUTHORIZED", real2sim.UnauthorizedError),
        (404, "UNKNOWN_SCENE", real2sim.NotFoundError),
        (409, "SCENE_IN_USE", real2sim.ConflictError),
        (409, "CONTROLLER_TAKEN", real2sim.ControllerTakenError),
        (410, "SESSION_CLOSED", real2sim.SessionClosedError),
        (503, "SESSION_ELSEWHERE", real2sim.SessionElsewhereError),
        (412, "STALE_REVISION", real2sim.StaleRevisionError),
        (413, "PAYLOAD_TOO_LARGE", real2sim.InvalidRequestError),
        (422, "INVALID_OPERATION", real2sim.InvalidOperationError),
        (422, "TIME_OUT_OF_RANGE", real2sim.InvalidRequestError),
        (426, "UNSUPPORTED_PROTOCOL", real2sim.ProtocolMismatchError),
        (429, "OVER_CAPACITY", real2sim.CapacityError),
        (500, "INTERNAL", real2sim.WorkerFailedError),
        (507, "OUT_OF_MEMORY", real2sim.CapacityError),
        (507, "STORAGE_FULL", real2sim.CapacityError),
        (503, "STORAGE_UNAVAILABLE", real2sim.CapacityError),
        (418, "CODE_OF_THE_FUTURE", real2sim.StatusError),
    ],
)
def test_a_problem_raises_the_error_of_its_code(status, code, error):
    with (
        client_of(Script(problem(status, code)), retries=0) as client,
        pytest.raises(error, match=f"about {code}") as caught,
    ):
        client.scenes.get("street")
    assert type(caught.value) is error


def test_an_error_contains_all_fields_of_the_problem():
    said = problem(
        422,
        "INVALID_REQUEST",
        hint="see the limits",
        request_id="r-17",
        errors=[{"pointer": "/width", "message": "at most 8192"}],
    )
    with client_of(Script(said)) as client, pytest.raises(real2sim.StatusError) as caught:
        client.scenes.get("street")
    error = caught.value
    assert (error.status, error.code, error.request_id) == (422, "INVALID_REQUEST", "r-17")
    assert (error.hint, error.errors[0].pointer) == ("see the limits", "/width")
    assert "/width: at most 8192" in str(error)


def test_an_error_message_is_not_repeated():
    said = problem(
        422, "INVALID_REQUEST", errors=[{"pointer": "/x", "message": "about INVALID_REQUEST"}]
    )
    with client_of(Script(said)) as client, pytest.raises(real2sim.StatusError) as caught:
        client.scenes.get("street")
    assert str(caught.value) == "about INVALID_REQUEST [INVALID_REQUEST]"


def test_an_html_error_of_a_proxy_becomes_one_sentence():
    page = httpx2.Response(502, text="<html>bad gateway</html>")
    with (
        client_of(Script(page), retries=0) as client,
        pytest.raises(real2sim.WorkerFailedError, match=r"status 502.*bad gateway"),
    ):
        client.scenes.list()


@pytest.mark.parametrize("content", [b"", b"hello", b"[]", b'{"scenes": 3}', b'{"scenes": [{}]}'])
def test_a_reply_of_another_shape_is_malformed(content):
    with (
        client_of(Script(httpx2.Response(200, content=content))) as client,
        pytest.raises(real2sim.MalformedReplyError, match="not a SceneList"),
    ):
        client.scenes.list()


def test_members_of_a_newer_worker_are_ignored():
    newer = {"scenes": [{"scene": "street", "state": "resident", "extra": "sunny"}], "more": 1}
    with client_of(Script(httpx2.Response(200, json=newer))) as client:
        assert [s.scene for s in client.scenes.list()] == ["street"]


# --- retries ----------------------------------------------------------------------------------


def test_a_busy_worker_is_retried_after_retry_after(slept):
    busy = problem(503, "QUEUE_FULL")
    busy.headers["Retry-After"] = "3"
    script = Script(busy, httpx2.Response(200, json=SCENES))
    with client_of(script) as client:
        assert len(client.scenes.list()) == 1
    assert slept == [3.0]


def test_a_full_disk_is_retried_but_a_full_device_is_not(slept):
    script = Script(problem(507, "STORAGE_FULL"), httpx2.Response(200, json=SCENES))
    with client_of(script) as client:
        assert len(client.scenes.list()) == 1
    assert len(slept) == 1
    with client_of(Script(problem(507, "OUT_OF_MEMORY"))) as client, pytest.raises(CapacityError):
        client.scenes.list()
    assert len(slept) == 1


def test_a_worker_that_stays_busy_raises_with_retry_after(slept):
    busy = problem(429, "OVER_CAPACITY")
    busy.headers["Retry-After"] = "5"
    script = Script(busy)
    with client_of(script, retries=2) as client, pytest.raises(CapacityError) as caught:
        client.session(scene="street").open()
    assert (len(script.requests), slept, caught.value.retry_after) == (3, [5.0, 5.0], 5.0)


def test_retries_share_an_idempotency_key_and_calls_do_not(slept):
    script = Script(problem(503, "DRAINING"))
    with client_of(script, retries=2) as client:
        for _ in range(2):
            with pytest.raises(CapacityError):
                client.scenarios.create(scene="street")
    keys = [request.headers["idempotency-key"] for request in script.requests]
    assert len(keys) == 6
    assert len(set(keys[:3])) == len(set(keys[3:])) == 1
    assert keys[0] != keys[3]


def test_a_broken_connection_is_retried(slept):
    script = Script(httpx2.ReadError("reset by peer"), httpx2.Response(200, json=SCENES))
    with client_of(script) as client:
        assert len(client.scenes.list()) == 1


def test_a_step_is_not_retried_after_a_broken_connection(slept):
    script = Script(httpx2.ReadError("reset by peer"))
    with client_of(script) as client, pytest.raises(real2sim.UnreachableError):
        client.sessions.step("w0.abc", n=3)
    assert len(script.requests) == 1


def test_permanent_errors_are_not_retried(slept):
    script = Script(problem(404, "UNKNOWN_SCENE"))
    with client_of(script) as client, pytest.raises(real2sim.NotFoundError):
        client.scenes.get("nowhere")
    assert (len(script.requests), slept) == (1, [])


def test_a_timeout_error_names_the_call_and_the_limit(slept):
    script = Script(httpx2.ReadTimeout("slow"))
    with (
        client_of(script, timeout=4.0, retries=0) as client,
        pytest.raises(TimeoutError, match=r"no reply to GET /v1/scenes .* within 4 s"),
    ):
        client.scenes.list()


def test_a_slow_render_is_not_retried(slept):
    script = Script(httpx2.ReadTimeout("slow"))
    with client_of(script) as client, pytest.raises(real2sim.ReplyTimeoutError, match="300 s"):
        client.scenes.render("street", camera="front")
    assert len(script.requests) == 1


def test_the_async_client_retries_in_the_same_way(monkeypatch):
    delays: list[float] = []

    async def no_sleep(seconds: float) -> None:
        delays.append(seconds)

    monkeypatch.setattr("real2sim._async.transport.sleep", no_sleep)
    busy = problem(503, "QUEUE_FULL")
    busy.headers["Retry-After"] = "2"
    script = Script(busy, httpx2.Response(200, json=SCENES))

    async def run() -> None:
        transport = httpx2.MockTransport(script)
        async with real2sim.connect_async("http://worker:8600", transport=transport) as client:
            assert len(await client.scenes.list()) == 1

    asyncio.run(run())
    assert delays == [2.0]


# --- requests ---------------------------------------------------------------------------------


def test_the_token_is_sent_but_not_shown():
    script = Script(httpx2.Response(200, json=SCENES))
    with client_of(script, token="secret") as client:
        client.scenes.list()
        assert script.requests[0].headers["authorization"] == "Bearer secret"
        assert "secret" not in repr(client)
        assert "***" in repr(client)


def test_names_are_escaped_in_paths():
    script = Script(problem(404, "UNKNOWN_SCENE"))
    with client_of(script) as client, pytest.raises(real2sim.NotFoundError):
        client.scenes.get("../server?x=1")
    assert script.requests[0].url.raw_path == b"/v1/scenes/..%2Fserver%3Fx%3D1"


@pytest.mark.parametrize(
    ("url", "codec", "accept"),
    [
        ("http://127.0.0.1:8600", "auto", "application/msgpack"),
        ("http://[::1]:8600", "auto", "application/msgpack"),
        ("http://worker.example:8600", "auto", "image/jpeg"),
        ("http://127.0.0.1:8600", "png", "image/png"),
    ],
)
def test_images_are_raw_on_loopback_and_jpeg_over_a_network(url, codec, accept):
    script = Script(problem(404, "UNKNOWN_CAMERA"))
    transport = httpx2.MockTransport(script)
    with (
        real2sim.connect(url, transport=transport) as client,
        pytest.raises(real2sim.NotFoundError),
    ):
        client.scenes.render("street", camera="front", codec=codec)
    assert script.requests[0].headers["accept"] == accept


def test_depth_is_always_requested_losslessly():
    script = Script(problem(404, "UNKNOWN_CAMERA"))
    with client_of(script) as client, pytest.raises(real2sim.NotFoundError):
        client.scenes.render("street", camera="front", modality="depth", t_us=5, width=320)
    request = script.requests[0]
    assert request.headers["accept"] == "application/msgpack"
    assert dict(request.url.params) == {
        "camera": "front",
        "modality": "depth",
        "t_us": "5",
        "width": "320",
    }


def test_a_raw_image_has_its_pose():
    content = encode(frame("raw"))
    headers = {"content-type": "application/msgpack"}
    answer = httpx2.Response(200, content=content, headers=headers)
    with client_of(Script(answer)) as client:
        picture = client.scenes.render("street", camera="front", codec="raw")
    assert isinstance(picture, real2sim.Frame)
    np.testing.assert_array_equal(picture.array, IMAGE)
    np.testing.assert_array_equal(picture.T_world_sensor, np.eye(4))


def test_all_attempts_of_an_upload_send_the_same_bytes(tmp_path, slept):
    file = tmp_path / "street.ply"
    file.write_bytes(b"ply\n...")
    script = Script(problem(503, "QUEUE_FULL"))
    with client_of(script, retries=1) as client, pytest.raises(CapacityError):
        client.scenes.upload(file, scene="mine")
    first, second = script.requests
    assert first.content == second.content
    assert b'name="file"; filename="street.ply"' in first.content
    assert b"mine" in first.content


@pytest.mark.parametrize("names", [{}, {"scene": "a", "scenario": "b"}])
def test_a_session_requires_exactly_one_world(names):
    script = Script(problem(500, "INTERNAL"))
    with client_of(script) as client, pytest.raises(ValueError, match="name exactly one"):
        client.session(**names).open()
    assert script.requests == []


SCENARIO = {
    "scenario_id": "sc_1",
    "name": "",
    "scene": "street",
    "scene_hash": "00",
    "revision": 0,
    "etag": '"r0"',
    "created_at": "2026-01-01T00:00:00Z",
    "can_undo": False,
    "can_redo": False,
}


def test_a_session_accepts_a_scenario_or_its_id():
    script = Script(httpx2.Response(200, json=SCENARIO), problem(404, "UNKNOWN_SCENARIO"))
    with client_of(script) as client:
        scenario = client.scenarios.get("sc_1")
        for given in (scenario, scenario.info, scenario.scenario_id):
            with pytest.raises(real2sim.NotFoundError):
                client.session(scenario=given).open()
    sent = [dict(request.url.params) for request in script.requests[1:]]
    assert sent == [{"scenario": "sc_1"}] * 3


def test_a_session_accepts_a_scene_or_its_name():
    script = Script(httpx2.Response(200, json=SCENES), problem(404, "UNKNOWN_SCENE"))
    with client_of(script) as client:
        (street,) = client.scenes.list()
        for given in (street, "street"):
            with pytest.raises(real2sim.NotFoundError):
                client.session(scene=given).open()
    assert [dict(r.url.params) for r in script.requests[1:]] == [{"scene": "street"}] * 2


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ({"scenario": object()}, "scenario is a object; give an id or a scenario's handle"),
        ({"scene": 3}, "scene is a int; give a name or a SceneInfo"),
    ],
)
def test_an_invalid_scene_or_scenario_is_refused_immediately(names, sentence):
    with (
        client_of(Script(problem(500, "INTERNAL"))) as client,
        pytest.raises(TypeError, match=sentence),
    ):
        client.session(**names)


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("worker:8600", "is not an address"),
        ("ftp://worker", "is not an address"),
        ("http://", "is not an address"),
        ("http://user:pw@worker", "holds credentials"),
    ],
)
def test_an_invalid_url_is_refused_immediately(url, sentence):
    with pytest.raises(ValueError, match=sentence):
        real2sim.connect(url)


def test_a_protocol_mismatch_names_both_versions():
    info = {
        "version": "9.0",
        "protocol_version": 9,
        "subprotocols": [],
        "worker_id": "w0",
        "device": {"backend": "x", "reason": "", "device": "cpu", "threads": 1},
        "limits": dict.fromkeys(real2sim_limits(), 1),
        "codecs": [],
        "modalities": [],
        "conventions": {},
    }
    with (
        client_of(Script(httpx2.Response(200, json=info))) as client,
        pytest.raises(real2sim.ProtocolMismatchError, match="protocol 9; this client speaks"),
    ):
        client.server()


def real2sim_limits() -> list[str]:
    from real2sim_proto.scenes import Limits

    return list(Limits.model_fields)


# --- waiting ----------------------------------------------------------------------------------


def test_a_wait_ready_timeout_includes_the_reasons(slept):
    answer = httpx2.Response(503, json={"ready": False, "reasons": ["compiling kernels"]})
    with (
        client_of(Script(answer)) as client,
        pytest.raises(real2sim.ReplyTimeoutError, match="ready worker") as caught,
    ):
        client.wait_ready(timeout=0.0)
    assert caught.value.hint == "compiling kernels"


def test_a_503_of_a_proxy_counts_as_not_ready(slept):
    proxy = httpx2.Response(503, html="<h1>503 Service Unavailable</h1>")
    with (
        client_of(Script(*[proxy] * 5)) as client,
        pytest.raises(real2sim.ReplyTimeoutError, match="ready worker") as caught,
    ):
        client.wait_ready(timeout=0.0)
    assert "503" in caught.value.hint


def test_loading_waits_until_the_scene_is_resident(slept):
    loading = httpx2.Response(200, json={"scene": "street", "state": "loading"})
    resident = httpx2.Response(200, json={"scene": "street", "state": "resident"})
    script = Script(httpx2.Response(202, json={}), loading, loading, resident)
    with client_of(script) as client:
        assert client.scenes.load("street").state == "resident"
    assert [r.method for r in script.requests] == ["PUT", "GET", "GET", "GET"]


def test_loading_a_broken_scene_raises_immediately(slept):
    broken = {"scene": "street", "state": "broken", "reason": "truncated"}
    script = Script(httpx2.Response(202, json={}), httpx2.Response(200, json=broken))
    with client_of(script) as client, pytest.raises(real2sim.Real2SimError, match="truncated"):
        client.scenes.load("street")


def test_a_collection_is_iterated_with_one_request_and_shows_its_worker():
    script = Script(httpx2.Response(200, json=SCENES))
    with client_of(script) as client:
        assert [info.scene for info in client.scenes] == ["street"]
        assert repr(client.scenes) == "Scenes('http://worker:8600', token=None)"
    assert len(script.requests) == 1


def test_a_collection_supports_async_iteration():
    async def names() -> list[str]:
        transport = httpx2.MockTransport(lambda _: httpx2.Response(200, json=SCENES))
        async with real2sim.connect_async("http://worker:8600", transport=transport) as client:
            return [info.scene async for info in client.scenes]

    assert asyncio.run(names()) == ["street"]
