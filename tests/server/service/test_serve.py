from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace

import httpx2
import pytest

from real2sim_server.service import serve as serve_module
from real2sim_server.service.app import create_app
from real2sim_server.service.http.auth import OpenBindError
from real2sim_server.service.preflight import (
    AddressError,
    SceneFolderError,
    bind,
    check_start,
    listen,
    url_of,
)
from real2sim_server.service.serve import DrainingServer, run, running_worker, server_config
from tests.waiting import LIMIT_S, wait_until

from ..worker_processes import json_lines, printed_url, start_real2sim

pytestmark = pytest.mark.network


def test_a_running_worker_is_ready_and_stops_with_the_block(make_settings):
    with running_worker(make_settings()) as running:
        assert httpx2.get(f"{running.url}/readyz").status_code == 200
        assert httpx2.get(f"{running.url}/v1/scenes/tiny/render?camera=front").status_code == 200
        url, engine = running.url, running.worker.engine
    assert not engine.alive
    with pytest.raises(httpx2.ConnectError):
        httpx2.get(f"{url}/livez")


def test_a_worker_stops_if_its_block_raises(make_settings):
    with pytest.raises(KeyError), running_worker(make_settings()) as running:
        raise KeyError
    assert not running.worker.engine.alive


def test_two_workers_use_different_ports(make_settings, tmp_path):
    with (
        running_worker(make_settings()) as first,
        running_worker(make_settings(data_dir=tmp_path / "other", worker_id="w1")) as second,
    ):
        names = [httpx2.get(f"{w.url}/v1/server").json()["worker_id"] for w in (first, second)]
    assert names == ["w0", "w1"]


def test_a_running_worker_exposes_its_token(make_settings):
    with running_worker(make_settings(token="correct horse")) as running:
        headers = {"Authorization": f"Bearer {running.token}"}
        assert httpx2.get(f"{running.url}/v1/server").status_code == 401
        assert httpx2.get(f"{running.url}/v1/server", headers=headers).status_code == 200


def test_a_worker_that_does_not_become_ready_raises_with_the_reason(make_settings, monkeypatch):
    warm, now, ask = threading.Event(), [0.0], serve_module._ask_readiness

    def ask_until_told(address, *, timeout_s: float) -> tuple[bool, str]:
        ready, answer = ask(address, timeout_s=timeout_s)
        if "warming up kernels" in answer:
            now[0] += 2 * LIMIT_S
            warm.set()
        return ready, answer

    monkeypatch.setattr("real2sim_server.service.renderer.warm_up", lambda _: warm.wait(LIMIT_S))
    monkeypatch.setattr(serve_module, "_ask_readiness", ask_until_told)
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=time.sleep)
    monkeypatch.setattr(serve_module, "time", clock)
    with (
        pytest.raises(RuntimeError, match="warming up kernels"),
        running_worker(make_settings(), timeout_s=LIMIT_S),
    ):
        pass


def test_a_worker_that_cannot_start_raises_immediately_with_the_reason(make_settings, tmp_path):
    (tmp_path / "data").write_text("in the way")
    with (
        pytest.raises(RuntimeError, match="ended while it started: the state folder"),
        running_worker(make_settings()),
    ):
        pass


def test_a_public_address_without_a_token_is_refused_before_the_start(make_settings):
    settings = make_settings(host="0.0.0.0")
    with pytest.raises(OpenBindError):
        run(settings)
    with pytest.raises(OpenBindError), running_worker(settings):
        pass


@pytest.fixture
def taken_port() -> Iterator[int]:
    """A port in use by another program."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


def test_a_port_in_use_is_refused(make_settings, taken_port):
    with (
        pytest.raises(AddressError, match="in use"),
        running_worker(make_settings(port=taken_port)),
    ):
        pass


def test_the_command_refuses_a_port_in_use_before_loading_the_worker(taken_port):
    code = (
        "import sys\n"
        "from real2sim_server.cli.serve import serve\n"
        "try:\n"
        "    serve(port=int(sys.argv[1]))\n"
        "except OSError as error:\n"
        "    print(error)\n"
        "print('torch' in sys.modules or 'fastapi' in sys.modules)\n"
    )
    command = [sys.executable, "-c", code, str(taken_port)]
    told, heavy = subprocess.check_output(command, text=True).splitlines()
    assert f"port {taken_port}" in told
    assert "--port" in told
    assert heavy == "False"


def test_a_foreign_address_is_refused_with_a_hint(make_settings):
    with pytest.raises(AddressError, match="--host"):
        check_start(make_settings(host="192.0.2.1"))


@pytest.mark.parametrize("start", [check_start, run])
def test_a_missing_scene_folder_is_refused_with_its_path_and_a_hint(make_settings, tmp_path, start):
    missing = tmp_path / "missing"
    with pytest.raises(SceneFolderError, match="mkdir -p") as refused:
        start(make_settings(scenes_dir=missing))
    assert str(missing) in str(refused.value)


def test_a_worker_with_a_missing_scene_folder_does_not_start(make_settings, tmp_path):
    settings = make_settings(scenes_dir=tmp_path / "missing")
    with pytest.raises(SceneFolderError), running_worker(settings):
        pass


def test_a_file_as_scene_folder_is_refused(make_settings, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SceneFolderError, match="not a folder"):
        check_start(make_settings(scenes_dir=tmp_path / "file"))


def test_the_default_scene_folder_may_be_missing(make_settings):
    check_start(make_settings(scenes_dir=None))


def test_sockets_are_uncompressed_and_messages_are_limited(make_settings):
    from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES

    config = server_config(create_app(make_settings()), make_settings())
    assert config.ws_per_message_deflate is False
    assert config.ws_max_size == MAX_CLIENT_MESSAGE_BYTES


def test_a_queued_render_is_dropped_when_its_client_disconnects(make_settings):
    with running_worker(make_settings()) as running:
        engine, blocked, go_on = running.worker.engine, threading.Event(), threading.Event()

        def block() -> None:
            blocked.set()
            go_on.wait(2 * LIMIT_S)

        httpx2.put(f"{running.url}/v1/scenes/tiny/residency")
        blocker = threading.Thread(target=engine.call_sync, args=(block,))
        blocker.start()
        try:
            assert blocked.wait(LIMIT_S)
            address = ("127.0.0.1", int(running.url.rpartition(":")[2]))
            with socket.create_connection(address) as client:
                path = "/v1/scenes/tiny/render?camera=front"
                client.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
                wait_until(lambda: engine.queue_depth == 1, "the render to wait for the engine")
            wait_until(lambda: engine.queue_depth == 0, "the render to be dropped")
        finally:
            go_on.set()
            blocker.join()


def test_a_worker_process_prints_its_url_logs_json_and_exits_cleanly_on_sigterm(
    make_settings, tmp_path
):
    settings = make_settings(log_level="info")
    environment = {
        f"REAL2SIM_{name.upper()}": str(value)
        for name, value in settings.model_dump(exclude_none=True).items()
    }
    log_file = tmp_path / "log"
    process = start_real2sim(["serve"], log_file=log_file, environment=environment)
    url = printed_url(process, log_file)
    answer = httpx2.get(f"{url}/v1/server", timeout=None)
    os.kill(process.pid, signal.SIGTERM)
    process.join(LIMIT_S)
    first, second, *_ = log_file.read_text().splitlines()
    assert process.exitcode == 0
    assert url in first
    assert second == f"Studio: {url}/ui/"
    requests = [entry for entry in json_lines(log_file) if entry["event"] == "request"]
    assert [(r["path"], r["status"]) for r in requests] == [("/v1/server", 200)]
    assert requests[0]["client"] == "127.0.0.1"
    assert requests[0]["request_id"] == answer.headers["X-Request-Id"]


def test_sigterm_drains_a_worker_until_a_second_signal(make_settings):
    settings = make_settings(drain_seconds=600)
    app = create_app(settings)
    listener = bind("127.0.0.1", 0)
    listen(listener)
    server = DrainingServer(server_config(app, settings), app.state.worker)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    url = url_of("127.0.0.1", listener)
    wait_until(lambda: httpx2.get(f"{url}/readyz").status_code == 200, "the worker to be ready")
    server.handle_exit(signal.SIGTERM, None)
    draining, living = httpx2.get(f"{url}/readyz"), httpx2.get(f"{url}/livez")
    refused = httpx2.post(f"{url}/v1/sessions?scene=tiny")
    assert thread.is_alive()
    server.handle_exit(signal.SIGTERM, None)
    thread.join(LIMIT_S)
    assert draining.status_code == 503
    assert draining.json()["reasons"] == ["draining: the worker is stopping"]
    assert living.status_code == 200
    assert (refused.status_code, refused.json()["code"]) == (503, "DRAINING")
    assert not thread.is_alive()


def test_nagles_algorithm_is_disabled():
    """Otherwise the second part of a response waits for an acknowledgement."""

    async def is_sent_at_once() -> int:
        listener, found = bind("127.0.0.1", 0), asyncio.get_running_loop().create_future()

        def accept(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            found.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(accept, sock=listener):
            _, writer = await asyncio.open_connection(*listener.getsockname())
            writer.close()
            await writer.wait_closed()
            return await found

    assert asyncio.run(is_sent_at_once())
