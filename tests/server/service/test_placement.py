"""Routing by the shipped proxy configuration, with small servers in place of the workers."""

from __future__ import annotations

import contextlib
import http.client
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer

import pytest

from tests.waiting import LIMIT_S, wait_until

from .haproxy import SHIPPED, program, running_haproxy

pytestmark = pytest.mark.network

NAMES = ("w0", "w1", "w2")
READY = "up ready 100%"


class Stand:
    """A fake worker that answers with its name and reports a configurable state to its proxy."""

    def __init__(self, name: str) -> None:
        stand = self
        self.word = READY

        class Web(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                body = name.encode()
                self.send_response(200)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            do_POST = do_GET

            def log_message(self, *_given) -> None:
                """Log nothing."""

        class Word(StreamRequestHandler):
            def handle(self) -> None:
                self.wfile.write(f"{stand.word}\n".encode())

        ThreadingTCPServer.daemon_threads = ThreadingHTTPServer.daemon_threads = True
        self.web = ThreadingHTTPServer(("127.0.0.1", 0), Web)
        self.agent = ThreadingTCPServer(("127.0.0.1", 0), Word)
        for server in (self.web, self.agent):
            threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()

    def stop(self) -> None:
        for server in (self.web, self.agent):
            server.shutdown()
            server.server_close()


class Site:
    def __init__(self, stands: dict[str, Stand], url: str) -> None:
        self.stands = stands
        self._address = url.removeprefix("http://")

    def ask(self, path: str, method: str = "GET") -> str:
        connection = http.client.HTTPConnection(self._address, timeout=LIMIT_S)
        try:
            connection.request(method, path)
            return connection.getresponse().read().decode()
        finally:
            connection.close()

    def new(self, scene: str) -> str:
        return self.ask(f"/v1/sessions?scene={scene}", "POST")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    program()
    stands = {name: Stand(name) for name in NAMES}
    webs = {name: stand.web.server_address[1] for name, stand in stands.items()}
    agents = {name: stand.agent.server_address[1] for name, stand in stands.items()}
    with running_haproxy(tmp_path, webs, agents) as url:
        site = Site(stands, url)
        wait_until(
            lambda: all(site.ask(f"/v1/sessions/{name}.7f/step") == name for name in NAMES),
            "the proxy to know all workers",
        )
        yield site
    for stand in stands.values():
        stand.stop()


def test_the_shipped_configuration_is_valid(tmp_path):
    text = SHIPPED.read_text()
    done = subprocess.run(
        [program(), "-c", "-f", str(SHIPPED)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "use-server" in text


def test_new_sessions_are_placed_by_scene_and_spread_over_all_workers(site):
    scenes = [f"scene_{k}" for k in range(60)]
    asked = [{scene: site.new(scene) for scene in scenes} for _ in range(5)]
    usual = {scene: Counter(a[scene] for a in asked).most_common(1)[0] for scene in scenes}
    # Not 100 %: a connection that is closing still counts as load. Chance level is 50 %.
    assert sum(many for _, many in usual.values()) >= 0.75 * 5 * len(scenes)
    shares = Counter(name for name, _ in usual.values())
    assert set(shares) == set(NAMES)
    # With 60 scenes the hash gives no worker more than twice its share.
    assert max(shares.values()) <= 40


def test_a_draining_worker_keeps_its_sessions_and_gets_no_new_ones(site):
    # One scene is not enough: load balancing can move it for one request.
    def hosts() -> set[str]:
        return {site.new(f"scene_{k}") for k in range(30)}

    site.stands["w1"].word = "up drain"
    wait_until(lambda: "w1" not in hosts(), "w1 to get no new sessions")
    assert [site.ask("/v1/sessions/w1.7f/step") for _ in range(5)] == ["w1"] * 5
    site.stands["w1"].word = READY
    wait_until(lambda: "w1" in hosts(), "w1 to get new sessions again")


def test_sessions_of_a_down_or_unknown_worker_go_to_a_live_one(site):
    def host() -> str:
        # The proxy also closes the open connections of a worker that is marked down.
        with contextlib.suppress(http.client.HTTPException, ConnectionError):
            return site.ask("/v1/sessions/w2.7f/step")
        return "w2"

    site.stands["w2"].word = "down"
    wait_until(lambda: host() != "w2", "the proxy to hear of it")
    assert site.ask("/v1/sessions/w9.7f/step") in ("w0", "w1")


def test_no_request_fails_when_a_worker_disappears(site):
    site.stands["w0"].stop()
    answers = [site.ask("/v1/sessions/w0.7f/step") for _ in range(10)]
    assert set(answers) <= {"w1", "w2"}
    site.stands["w0"] = Stand("w0")
