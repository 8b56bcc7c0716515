"""Attacks on a worker's sockets from outside.

Attacks on readers, imports and the store are tested with those.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import resource
import signal
import socket
import threading
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_server.scene.io import save_scene
from real2sim_server.service.http.telemetry import Metrics
from real2sim_server.service.routes import sockets as view_route
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.service.sessions import messages
from real2sim_server.settings import Settings
from tests.waiting import LIMIT_S, wait_until

from ..worker_processes import json_lines, printed_url, start_real2sim
from .waiting import wait_ready

TOKEN = "a long enough secret"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def site(tmp_path_factory, tiny_scene) -> Iterator[RunningWorker]:
    """A worker with a token on a real socket. Its connections may stay idle for long."""
    root = tmp_path_factory.mktemp("attacked")
    save_scene(tiny_scene, root / "scenes" / "tiny.r2s")
    settings = Settings(
        data_dir=root,
        port=0,
        backend="cpu",
        token=TOKEN,
        head_seconds=600,
        body_seconds=600,
        write_seconds=600,
        max_connections=12,
    )
    with running_worker(settings) as running:
        yield running


def opened(url: str) -> socket.socket:
    host, port = re.fullmatch(r"http://([^:]+):(\d+)", url).groups()
    return socket.create_connection((host, int(port)), timeout=LIMIT_S)


def read_to_end(connection: socket.socket) -> bytes:
    """Read until the worker closes the connection. Fails if it does not."""
    received = b""
    with contextlib.suppress(ConnectionResetError):
        while data := connection.recv(65536):
            received += data
    return received


def status_of(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


# --- metrics ----------------------------------------------------------------------------------


def test_unknown_methods_share_one_metric_label(client):
    for k in range(20):
        client.request(f"METHOD{k}", "/v1/server")
    text = client.get("/metrics").text
    assert 'method="other"' in text
    assert "METHOD" not in text


def test_unknown_paths_do_not_appear_in_metrics(client):
    client.get("/v1/secret-of-somebody")
    assert "secret-of-somebody" not in client.get("/metrics").text


def test_metrics_are_written_on_another_thread(client, monkeypatch):
    threads = []

    def expose(self) -> bytes:
        threads.append(threading.current_thread())
        return b""

    monkeypatch.setattr(Metrics, "_expose", expose)
    asking = client.portal.call(threading.current_thread)
    client.get("/metrics")
    assert threads != [asking]


# --- idle and slow connections -----------------------------------------------------------------


class Received:
    """The worker's side of a client connection."""

    def __init__(self, site: RunningWorker, connection: socket.socket, monkeypatch: Any) -> None:
        self._connections, self._client = site.worker.connections, connection.getsockname()
        self._monkeypatch = monkeypatch
        self.protocol: Any = wait_until(self._found, "the worker to accept the connection")

    def _found(self) -> Any:
        open_now = list(self._connections._open)
        return next((c for c in open_now if c.client == self._client), None)

    def wait_received(self, size: int) -> None:
        """Wait until the worker has received this many bytes of the request."""
        wait_until(lambda: self.protocol.received == size, f"{size} bytes to arrive")

    def time_out(self) -> None:
        """Let all timeouts of the connection expire."""
        hasty = replace(self._connections.limits, head_s=0.0, body_s=0.0)
        self._monkeypatch.setattr(self._connections, "limits", hasty)


@pytest.mark.network
def test_an_idle_connection_is_closed(site, monkeypatch):
    with opened(site.url) as connection:
        Received(site, connection, monkeypatch).time_out()
        assert read_to_end(connection) == b""


@pytest.mark.network
def test_incomplete_headers_time_out_even_if_bytes_trickle_in(site, monkeypatch):
    head = b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "
    with opened(site.url) as connection:
        received, began = Received(site, connection, monkeypatch), set()
        for size, part in ((len(head), head), (len(head) + 1, b"a"), (len(head) + 2, b"a")):
            connection.sendall(part)
            received.wait_received(size)
            began.add(received.protocol._head_since)
        assert len(began) == 1
        received.time_out()
        answer = read_to_end(connection)
    assert status_of(answer) == 408
    assert b"REQUEST_TIMEOUT" in answer


@pytest.mark.network
def test_an_incomplete_body_times_out(site, monkeypatch):
    head = (
        f"POST /v1/scenarios HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
        "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
    )
    with opened(site.url) as connection:
        received = Received(site, connection, monkeypatch)
        connection.sendall(head.encode())
        received.wait_received(len(head))
        received.time_out()
        answer = read_to_end(connection)
    assert status_of(answer) == 408
    assert b"Content-Security-Policy" in answer


@pytest.mark.network
def test_an_incomplete_second_request_times_out(site, monkeypatch):
    with opened(site.url) as connection:
        received = Received(site, connection, monkeypatch)
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /li")
        answers = connection.recv(65536)
        connection.sendall(b"v")
        received.wait_received(len(b"v"))
        received.time_out()
        answers += read_to_end(connection)
    assert answers.startswith(b"HTTP/1.1 200")
    assert answers.count(b"HTTP/1.1 408") == 1


@pytest.fixture
def hasty(site, monkeypatch) -> RunningWorker:
    """A worker that drops clients that read nothing for half a second."""
    connections = site.worker.connections
    monkeypatch.setattr(connections, "limits", replace(connections.limits, write_s=0.5))
    return site


@pytest.mark.network
@pytest.mark.slow
def test_an_http_client_that_never_reads_is_dropped(hasty):
    request = b"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    before = dropped(hasty, "write_timeout")
    with opened(hasty.url) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(100):
            connection.sendall(request)
        wait_until(lambda: dropped(hasty, "write_timeout") > before, "it to be given up")


@pytest.mark.network
def test_a_drive_client_that_never_reads_is_dropped(hasty):
    before = dropped(hasty, "write_timeout")
    info = create_session(hasty)
    render = {"v": 1, "type": "render", "sensors": [{"camera": "front", "codec": "raw"}]}
    with contextlib.suppress(ConnectionClosed), joined(info, max_queue=1) as drive:
        drive.send(encode({"v": 1, "type": "reset", "id": 2, "spec": {}}))
        for k in range(5000):
            drive.send(encode(render | {"id": 3 + k}))
    wait_until(lambda: dropped(hasty, "write_timeout") > before, "it to be given up")


@pytest.mark.network
def test_bytes_that_are_not_http_get_a_problem_document(site):
    with opened(site.url) as connection:
        connection.sendall(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n")
        answer = read_to_end(connection)
    assert status_of(answer) == 400
    assert b"application/problem+json" in answer
    assert answer.count(b"HTTP/1.1 400") == 1


@pytest.mark.network
def test_a_broken_body_is_refused_once_without_a_traceback(site, caplog):
    request = (
        b"POST /v1/scenarios HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        b"Transfer-Encoding: chunked\r\n\r\nno size\r\n"
    )
    with opened(site.url) as connection:
        connection.sendall(request)
        answer = read_to_end(connection)
    wait_until(lambda: len(site.worker.connections) == 0, "the connection to end")
    assert status_of(answer) == 400
    assert answer.count(b"HTTP/1.1 400") == 1
    assert not any(record.exc_info for record in caplog.records)


@pytest.mark.network
def test_an_unsupported_websocket_version_gets_a_problem_document(site):
    request = (
        "GET /v1/scenarios/any/view HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 8\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    with opened(site.url) as connection:
        connection.sendall(request.encode())
        answer = read_to_end(connection)
    assert status_of(answer) == 400
    assert b"WebSocket handshake of version 13" in answer


def dropped(site: RunningWorker, reason: str) -> float:
    counter = site.worker.metrics.dropped_connections.labels(reason)
    return next(s.value for s in counter.collect()[0].samples if s.name.endswith("_total"))


@pytest.mark.network
def test_idle_connections_are_closed_to_make_room_for_requests(site):
    before = dropped(site, "crowded_out")
    with contextlib.ExitStack() as stack:
        for _ in range(30):
            stack.enter_context(opened(site.url))
        assert httpx2.get(f"{site.url}/livez", timeout=LIMIT_S).status_code == 200
    assert dropped(site, "crowded_out") > before


@pytest.mark.network
def test_open_sockets_survive_a_crowd_of_idle_connections(site):
    info = create_session(site)
    with joined(info) as drive, contextlib.ExitStack() as stack:
        for _ in range(30):
            stack.enter_context(opened(site.url))
        drive.send(encode({"v": 1, "type": "reset", "id": 2, "spec": {}}))
        assert drive.recv(timeout=LIMIT_S)


@pytest.mark.network
def test_a_connection_over_the_limit_is_refused_if_none_is_idle(make_settings, kernels):
    with running_worker(make_settings(max_connections=2)) as running:
        url = f"{running.url}/v1/sessions?scene=tiny"
        info = httpx2.post(url, headers={"Connection": "close"}, timeout=LIMIT_S).json()
        with joined(info), joined(info, role="observer"), opened(running.url) as third:
            answer = read_to_end(third)
    assert status_of(answer) == 503
    assert b"TOO_MANY_CONNECTIONS" in answer


@pytest.mark.network
@pytest.mark.slow
def test_a_thousand_idle_and_half_open_connections_block_no_client(tmp_path, tiny_scene):
    wanted = 1000
    allow_descriptors(wanted + 200)
    save_scene(tiny_scene, tmp_path / "scenes" / "tiny.r2s")
    with worker_process(tmp_path, descriptors=1024) as (url, log):
        answer = httpx2.post(f"{url}/v1/sessions?scene=tiny", timeout=LIMIT_S)
        with joined(answer.json()) as drive, contextlib.ExitStack() as stack:
            for k in range(wanted):
                connection = stack.enter_context(opened(url))
                if k % 3 == 1:
                    connection.sendall(b"GET /livez HTTP/1.1\r\nHost: 127")
                elif k % 3 == 2:
                    connection.sendall(
                        b"POST /v1/scenarios HTTP/1.1\r\nHost: 127.0.0.1\r\n"
                        b"Content-Type: application/json\r\nContent-Length: 9\r\n\r\n{"
                    )
            drive.send(encode({"v": 1, "type": "reset", "id": 2, "spec": {}}))
            assert drive.recv(timeout=LIMIT_S)
            for _ in range(5):
                assert httpx2.get(f"{url}/livez", timeout=LIMIT_S).status_code == 200

            def crowded_out() -> int:
                told = [e for e in json_lines(log) if e["event"] == "connections dropped"]
                return sum(e["reasons"].get("crowded_out", 0) for e in told)

            wait_until(lambda: crowded_out() > 100, "the log to tell of them")
    assert any(e["event"] == "connections near their limit" for e in json_lines(log))


def allow_descriptors(count: int) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < count:
        pytest.skip(f"{count} descriptors are needed, {hard} are allowed")
    if soft != resource.RLIM_INFINITY and soft < count:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))


@contextlib.contextmanager
def worker_process(folder: Path, *, descriptors: int) -> Iterator[tuple[str, Path]]:
    """A worker in its own process. Yields its address and its log."""
    limit = f"({descriptors}, {descriptors})"
    log_file = folder / "worker.log"
    process = start_real2sim(
        ["serve", "--port", "0", "--data", str(folder)],
        log_file=log_file,
        environment={
            "REAL2SIM_BACKEND": "cpu",
            "REAL2SIM_LOG_FORMAT": "json",
            "REAL2SIM_DRAIN_SECONDS": "0",
        },
        before=f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, {limit})",
    )
    try:
        url = printed_url(process, log_file)
        ready = f"{url}/readyz"
        wait_until(lambda: httpx2.get(ready, timeout=LIMIT_S).status_code == 200, "the worker")
        yield url, log_file
    finally:
        os.kill(process.pid, signal.SIGTERM)
        process.join(LIMIT_S)


def create_session(site: RunningWorker) -> dict[str, Any]:
    url = f"{site.url}/v1/sessions?scene=tiny"
    return httpx2.post(url, headers=BEARER, timeout=LIMIT_S).json()


@contextlib.contextmanager
def joined(info: dict[str, Any], *, role: str = "controller", **options: Any) -> Iterator[Any]:
    """A drive socket after its welcome."""
    with connect(
        info["ws_url"], subprotocols=[DRIVE_SUBPROTOCOL], compression=None, proxy=None, **options
    ) as drive:
        hello = {"protocols": [DRIVE_SUBPROTOCOL], "token": info["token"], "role": role}
        drive.send(encode({"v": 1, "type": "hello", "id": 1, **hello}))
        while b"welcome" not in drive.recv(timeout=LIMIT_S):
            pass
        yield drive


# --- the view socket --------------------------------------------------------------------------


def view(client: Any, scenario_id: str = "any") -> Any:
    return client.websocket_connect(
        f"/v1/scenarios/{scenario_id}/view", headers={"Host": "127.0.0.1"}
    )


def close_code(socket: Any) -> int:
    with pytest.raises(WebSocketDisconnect) as closed:
        socket.receive_text()
    return closed.value.code


NESTED = "[" * 100_000 + "]" * 100_000
FIRST_MESSAGES: dict[str, Callable[[Any], None]] = {
    "bytes": lambda socket: socket.send_bytes(b"\x00\x01"),
    "nested": lambda socket: socket.send_text(NESTED),
    "nested token": lambda socket: socket.send_text('{"token": ' + NESTED + "}"),
    "lone surrogate": lambda socket: socket.send_text('{"token": "\\ud800"}'),
    "no object": lambda socket: socket.send_text("7"),
    "no json": lambda socket: socket.send_text("{"),
}


@pytest.mark.parametrize("first", FIRST_MESSAGES)
def test_a_first_message_other_than_hello_closes_the_view(start_worker, logged, first):
    client = start_worker(token=TOKEN)
    with view(client) as socket:
        FIRST_MESSAGES[first](socket)
        assert close_code(socket) in (4400, 4401)
    assert not any("exc_info" in entry for entry in logged)


def test_a_view_without_a_hello_times_out(start_worker, monkeypatch):
    monkeypatch.setattr(view_route, "HANDSHAKE_TIMEOUT_S", 0.1)
    with view(start_worker(token=TOKEN)) as socket:
        assert close_code(socket) == 4408


@pytest.mark.parametrize(
    "message", [b"\x00", NESTED, '{"camera": "\\ud800", "t_us": 0}', '{"camera": "x", "t_us": NaN}']
)
def test_an_invalid_view_request_is_refused_and_the_view_stays_open(client, message):
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()
    with view(client, made["scenario_id"]) as socket:
        socket.send_json({"type": "hello"})
        assert socket.receive_json() == {"type": "welcome"}
        for _ in range(2):
            if isinstance(message, bytes):
                socket.send_bytes(message)
            else:
                socket.send_text(message)
            assert socket.receive_json()["type"] == "error"


def test_a_close_reason_is_cut_to_the_frame_limit(client):
    name = "%C3%A9" * 90
    with view(client, name) as socket:
        socket.send_json({"type": "hello"})
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
    assert closed.value.code == 4404
    assert len(closed.value.reason.encode()) <= 123


# --- the drive socket -------------------------------------------------------------------------


@pytest.mark.network
@pytest.mark.parametrize(
    "data",
    [
        b"\x91" * 100_000 + b"\x90",
        b"\x81\xa5token\xa3\xed\xa0\x80",
        b"\xc1",
        b"",
        "text",
        encode({"type": "hello", "id": np.zeros(2)}),
    ],
)
def test_a_first_message_other_than_hello_closes_the_drive_socket(site, data):
    info = create_session(site)
    with connect(
        info["ws_url"], subprotocols=[DRIVE_SUBPROTOCOL], compression=None, proxy=None
    ) as drive:
        drive.send(data)
        assert b"BAD_MESSAGE" in drive.recv(timeout=LIMIT_S, decode=False)
        with contextlib.suppress(Exception):
            drive.recv(timeout=LIMIT_S)
        assert drive.close_code == 1008


@pytest.mark.network
@pytest.mark.parametrize("version", [np.ones(3), np.zeros(0), [1], "1", 1.0, True, 2])
def test_a_message_of_an_unknown_version_is_refused(site, logged, version):
    info = create_session(site)
    with joined(info) as drive:
        drive.send(encode({"v": version, "type": "bye", "id": 7}))
        told = decode(drive.recv(timeout=LIMIT_S, decode=False))
        assert (told["code"], told["id"]) == ("UNSUPPORTED_PROTOCOL", 7)
    assert not any("exc_info" in entry for entry in logged)


@pytest.mark.network
@pytest.mark.parametrize("text", [b"\xff\xfe", b"\xed\xa0\x80", b"\xf0\x9f"])
def test_invalid_utf8_closes_the_socket_without_a_traceback(site, caplog, text):
    with connect(
        create_session(site)["ws_url"],
        subprotocols=[DRIVE_SUBPROTOCOL],
        compression=None,
        proxy=None,
    ) as drive:
        drive.protocol.send_text(text)
        drive.socket.sendall(b"".join(drive.protocol.data_to_send()))
        with pytest.raises(ConnectionClosed):
            drive.recv(timeout=LIMIT_S)
        assert drive.close_code == 1007
    assert caplog.records == []


@pytest.mark.network
def test_invalid_utf8_and_a_close_frame_at_once_log_no_error(site, caplog):
    with connect(
        create_session(site)["ws_url"],
        subprotocols=[DRIVE_SUBPROTOCOL],
        compression=None,
        proxy=None,
    ) as drive:
        drive.protocol.send_text(b"\xff\xfe")
        drive.protocol.send_close(1000)
        drive.socket.sendall(b"".join(drive.protocol.data_to_send()))
        with pytest.raises(ConnectionClosed):
            drive.recv(timeout=LIMIT_S)
    wait_until(lambda: len(site.worker.connections) == 0, "the connection to end")
    assert caplog.records == []


@pytest.mark.network
@pytest.mark.parametrize("last", [b"\x83\x80\0\0\0\0", b"\x81\x82\0\0\0\0\xff\xfe", b""])
def test_a_client_that_leaves_during_a_refused_view_hello_logs_no_error(
    site, caplog, monkeypatch, last
):
    async def refuse_late(*_arguments: Any) -> None:
        await asyncio.to_thread(left.wait, LIMIT_S)
        refused.set()
        raise view_route.NoHelloError(4400, "no hello")

    left, refused = threading.Event(), threading.Event()
    monkeypatch.setattr(view_route, "_check_hello", refuse_late)
    handshake = (
        "GET /v1/scenarios/any/view HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    with opened(site.url) as connection:
        connection.sendall(handshake.encode())
        assert status_of(connection.recv(65536)) == 101
        connection.sendall(last)
        connection.shutdown(socket.SHUT_WR)
        left.set()
        assert refused.wait(LIMIT_S)
        read_to_end(connection)
    wait_until(lambda: len(site.worker.connections) == 0, "the connection to end")
    assert caplog.records == []


@pytest.mark.network
def test_refused_handshakes_log_no_error(site, caplog):
    path = create_session(site)["ws_url"].split("/", 3)[3]
    request = (
        f"GET /{path} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    for _ in range(200):
        with opened(site.url) as connection:
            connection.sendall(request.encode())
            assert status_of(connection.recv(65536)) == 426
    assert caplog.records == []


@pytest.mark.network
def test_a_drive_socket_without_a_hello_times_out(site, monkeypatch):
    monkeypatch.setattr(messages, "HANDSHAKE_TIMEOUT_S", 0.1)
    info = create_session(site)
    with connect(
        info["ws_url"], subprotocols=[DRIVE_SUBPROTOCOL], compression=None, proxy=None
    ) as drive:
        assert b"TIMEOUT" in drive.recv(timeout=LIMIT_S, decode=False)


# --- cross-origin requests ----------------------------------------------------------------------

FOREIGN = [
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
    {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "cors"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
    {"Origin": "http://127.0.0.1:3000"},
    {"Origin": "https://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://["},
]


@pytest.mark.parametrize("headers", FOREIGN)
@pytest.mark.parametrize("token", [None, TOKEN])
def test_cross_origin_requests_are_refused(start_worker, headers, token):
    client = start_worker(token=token)
    auth = BEARER if token else {}
    for method, path in (("GET", "/v1/scenes/tiny/render"), ("POST", "/v1/scenarios")):
        answer = client.request(method, path, headers=headers | auth)
        assert (answer.status_code, answer.json()["code"]) == (403, "FOREIGN_PAGE")


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1"},
        {"Sec-Fetch-Site": "none"},
    ],
)
def test_same_origin_pages_and_programs_are_allowed(client, headers):
    assert client.get("/v1/server", headers=headers).status_code == 200


def test_the_studio_can_be_linked_but_not_framed_by_other_sites(client):
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert client.get("/ui/", headers=link | {"Sec-Fetch-Dest": "document"}).status_code == 200
    assert client.get("/ui/", headers=link | {"Sec-Fetch-Dest": "iframe"}).status_code == 403


# --- response headers ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", ["/livez", "/v1/server", "/v1/nothing", "/ui/", "/docs", "/v1/scenes/tiny/render", "/"]
)
def test_every_response_has_security_headers(client, path):
    headers = client.get(path, follow_redirects=False).headers
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    policy = headers["Content-Security-Policy"]
    # Only the studio compiles WebAssembly (its vendored renderer). No page evaluates text as code.
    allowed = {"'wasm-unsafe-eval'"} if path == "/ui/" else set()
    assert {word.strip(";") for word in policy.split() if "unsafe" in word} == allowed
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_the_import_map_is_the_only_inline_script_of_the_studio(client):
    page = client.get("/ui/")
    policy = page.headers["Content-Security-Policy"]
    (sources,) = [d for d in policy.split("; ") if d.startswith("script-src ")]
    inline = re.findall(r"<script(?! [^>]*src=)[^>]*>(.*?)</script>", page.text, re.DOTALL)
    hashes = [b64encode(sha256(text.encode()).digest()).decode() for text in inline]
    assert len(hashes) == 1
    assert sources.split()[1:] == ["'self'", "'wasm-unsafe-eval'", f"'sha256-{hashes[0]}'"]
    for path in json.loads(inline[0])["imports"].values():
        answer = client.get("/ui/" + path.removeprefix("./"))
        assert answer.status_code == 200
        assert "immutable" in answer.headers["Cache-Control"]


def test_the_api_reference_has_no_scripts_or_external_links(client):
    answer = client.get("/docs")
    assert answer.headers["content-type"].startswith("text/html")
    assert "<script" not in answer.text
    assert re.findall(r'(?:src|href)="(?:https?:)?//[^"]*"', answer.text) == []
    for path in re.findall(r'href="(/[^"#]*)"', answer.text):
        assert client.get(path).status_code == 200
    assert "/v1/scenarios/{scenario_id}/operations" in answer.text


# --- tokens -----------------------------------------------------------------------------------


def test_every_call_checks_the_token_before_the_body(start_worker):
    client = start_worker(token=TOKEN)
    asked = []
    for path, item in client.get("/openapi.json").json()["paths"].items():
        for method in set(item) & {"get", "post", "put", "delete"}:
            if path in ("/livez", "/readyz"):
                continue
            asked.append(path)
            found = re.sub(r"\{\w+\}", "w0.0123456789abcdef", path)
            answer = client.request(
                method, found, content=b"{" * 99, headers={"Content-Type": "application/json"}
            )
            assert answer.status_code == 401, f"{method} {path}"
    assert len(asked) > 30


def test_an_evicted_session_is_not_rebuilt_for_a_wrong_token(start_worker, monkeypatch):
    client = start_worker(token=TOKEN)
    info = client.post("/v1/sessions?scene=tiny", headers=BEARER).json()
    sessions = client.app.state.worker.sessions
    for session in sessions:
        client.portal.call(sessions.evict, session)
    path = f"/v1/sessions/{info['session_id']}/state"
    for headers in ({}, {"Authorization": "Bearer guess"}):
        assert client.get(path, headers=headers).status_code == 401
    url = f"/v1/sessions/{info['session_id']}/drive"
    with client.websocket_connect(url, subprotocols=[DRIVE_SUBPROTOCOL]) as drive:
        hello = {"v": 1, "type": "hello", "id": 1, "protocols": [DRIVE_SUBPROTOCOL]}
        drive.send_bytes(encode(hello | {"token": "guess"}))
        assert b"UNAUTHORIZED" in drive.receive_bytes()
    assert len(sessions) == 0


def test_failed_authentications_are_counted(start_worker):
    client = start_worker(token=TOKEN)
    client.get("/v1/server")
    text = client.get("/metrics", headers=BEARER).text
    assert 'real2sim_auth_failures_total{where="http"} 1.0' in text


# --- methods and paths ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "method", "allowed"),
    [
        ("/v1/scenarios", "PATCH", "GET, HEAD, POST"),
        ("/v1/scenarios/any", "PUT", "GET, HEAD, PATCH, DELETE"),
        ("/v1/scenes/tiny/residency", "PATCH", "PUT, DELETE"),
        ("/v1/sessions", "PATCH", "GET, HEAD, POST"),
    ],
)
def test_the_allow_header_lists_all_methods(client, path, method, allowed):
    answer = client.request(method, path)
    assert (answer.status_code, answer.headers["Allow"]) == (405, allowed)


@pytest.mark.parametrize("path", ["/livez", "/readyz", "/v1/server", "/v1/scenes/tiny/render"])
def test_head_equals_get_without_a_body(client, path):
    client.get("/v1/scenes/tiny/render")
    wait_ready(client)  # The response can change while the worker warms up.
    get, head = client.get(path), client.head(path)
    assert head.status_code == get.status_code
    assert head.headers["Content-Type"] == get.headers["Content-Type"]
    assert head.content == b""


def test_routes_are_built_before_the_worker_starts(make_settings, monkeypatch):
    from fastapi.routing import _IncludedRouter

    from real2sim_server.service.app import create_app
    from real2sim_server.service.worker import Worker

    app, built = create_app(make_settings()), []
    running = Worker.running

    def noted(self: Worker) -> Any:
        built.extend(r._effective_candidates_version for r in routers)
        return running(self)

    routers = [route for route in app.routes if isinstance(route, _IncludedRouter)]
    for router in routers:  # Another application of this process may have built them already.
        router._effective_candidates_version = None
    monkeypatch.setattr(Worker, "running", noted)
    from fastapi.testclient import TestClient

    with TestClient(app, base_url="http://127.0.0.1"):
        pass
    assert len(built) > 5
    assert None not in built
