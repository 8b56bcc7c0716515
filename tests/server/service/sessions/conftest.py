"""A worker on a real socket, and clients that exchange messages with it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import httpx2
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_server.scene.io import save_scene
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.service.sessions import Session
from real2sim_server.settings import Settings

CONTROL = {"kind": "control", "acceleration": 0.5, "steering": 0.02}


class Planner:
    """A client of a drive socket."""

    def __init__(self, info: dict[str, Any], *, max_queue: int = 16) -> None:
        self.info = info
        self.ids = 0
        self.stack = ExitStack()
        connection = connect(
            info["ws_url"],
            subprotocols=[DRIVE_SUBPROTOCOL],
            compression=None,
            max_size=None,
            max_queue=max_queue,
            close_timeout=2,
            proxy=None,
        )
        self.socket = self.stack.enter_context(connection)

    def __enter__(self) -> Planner:
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()

    def send(self, type_: str, **fields: Any) -> int:
        self.ids += 1
        self.socket.send(encode({"v": 1, "type": type_, "id": self.ids, **fields}))
        return self.ids

    def receive(self) -> dict[str, Any]:
        """The next message, skipping progress messages."""
        while True:
            message = decode(self.socket.recv(timeout=120, decode=False))
            if message["type"] != "progress":
                return message

    def ask(self, type_: str, **fields: Any) -> dict[str, Any]:
        message_id = self.send(type_, **fields)
        answer = self.receive()
        assert answer["id"] == message_id, answer
        return answer

    def hello(self, *, role: str = "controller", **fields: Any) -> dict[str, Any]:
        fields = {"protocols": [DRIVE_SUBPROTOCOL], "token": self.info["token"], **fields}
        return self.ask("hello", role=role, **fields)

    def reset(self, **spec: Any) -> dict[str, Any]:
        return self.ask("reset", spec={"action": "control", **spec})

    def act(self, step: int, **plan: Any) -> dict[str, Any]:
        return self.ask("action", step=step, plan=CONTROL | plan)

    def wait_closed(self) -> int | None:
        """Close code sent by the worker. Discards earlier messages."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                self.socket.recv(timeout=120)
        return self.socket.close_code


class Site:
    """A worker and its REST interface."""

    def __init__(self, running: RunningWorker, *, stop: Callable[[], None]) -> None:
        self.stop = stop
        self.worker = running.worker
        self.url = running.url
        self.http = httpx2.Client(base_url=running.url, timeout=60)
        self.made: list[dict[str, Any]] = []

    def create(self, spec: dict[str, Any] | None = None, **query: str) -> dict[str, Any]:
        body = None if spec is None else {"reset": spec}
        answer = self.http.post("/v1/sessions", params=query or {"scene": "tiny"}, json=body)
        assert answer.status_code == 201, answer.text
        self.made.append(answer.json())
        return answer.json()

    def call(
        self, method: str, info: dict[str, Any], path: str = "", **options: Any
    ) -> httpx2.Response:
        headers = {"Authorization": f"Bearer {info['token']}"} | options.pop("headers", {})
        path = f"/v1/sessions/{info['session_id']}{path}"
        return self.http.request(method, path, headers=headers, **options)

    def session(self, info: dict[str, Any]) -> Session:
        """The worker's session object."""
        (found,) = (s for s in self.worker.sessions if s.session_id == info["session_id"])
        return found

    def clear(self) -> None:
        for info in self.made:
            self.call("DELETE", info)
        self.made.clear()


@pytest.fixture(scope="package")
def own_site(tmp_path_factory, tiny_scene) -> Iterator[Callable[..., Site]]:
    """Start workers with the scene ``tiny``. Keyword arguments are settings."""
    with ExitStack() as stack:

        def start(**overrides: Any) -> Site:
            root = tmp_path_factory.mktemp("worker")
            save_scene(tiny_scene, root / "scenes" / "tiny.r2s")
            defaults = {"data_dir": root, "port": 0, "backend": "cpu", "log_level": "error"}
            life = stack.enter_context(ExitStack())
            running = life.enter_context(running_worker(Settings(**defaults | overrides)))
            site = Site(running, stop=life.close)
            life.callback(site.http.close)
            return site

        yield start


@pytest.fixture(scope="package")
def shared_site(own_site) -> Site:
    return own_site()


@pytest.fixture
def site(shared_site: Site) -> Iterator[Site]:
    """A worker shared by all tests here, without sessions at the start of each test."""
    yield shared_site
    shared_site.clear()
    assert len(shared_site.worker.sessions) == 0


@pytest.fixture
def join() -> Iterator[Callable[..., Planner]]:
    """Connect to a session and say hello in a role, unless ``role`` is None."""
    with ExitStack() as stack:

        def connected(
            info: dict[str, Any], role: str | None = "controller", **options: Any
        ) -> Planner:
            planner = stack.enter_context(Planner(info, **options))
            if role is not None:
                assert planner.hello(role=role)["type"] == "welcome"
            return planner

        yield connected


@pytest.fixture
def planner(site: Site, join) -> Planner:
    """The controller of a new session on ``tiny``."""
    return join(site.create())


@pytest.fixture
def bystander(site: Site, join) -> Iterator[Planner]:
    """Another session, which must still be drivable after the test."""
    planner = join(site.create())
    planner.reset(sensors=[{"camera": "front"}])
    yield planner
    assert planner.act(0)["step"] == 1
