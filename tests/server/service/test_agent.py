"""What a worker reports to its proxy, and how it leaves a fleet."""

from __future__ import annotations

import socket

import pytest

from real2sim_server.service import membership, serve
from real2sim_server.service.membership import Agent, Willingness, loads_of
from real2sim_server.service.storage.fleet import WorkerRow
from tests.waiting import LIMIT_S, wait_until

from ..ports import reserved_port
from .test_fleet import by, start, store_url, tell  # noqa: F401, fixtures
from .test_trouble import Site
from .waiting import succeeded


@pytest.mark.parametrize(
    ("ready", "full", "handed_over", "word"),
    [
        (True, False, False, "up ready 70%"),
        (False, False, False, "up drain"),
        (True, True, False, "up drain"),
        (False, True, True, "down"),
    ],
)
def test_the_agent_reports_the_state_for_the_proxy(ready, full, handed_over, word):
    found = Willingness(ready=ready, full=full, handed_over=handed_over)
    assert Agent(lambda: found, weight=70).word() == word


def ask(port: int) -> str:
    with socket.create_connection(("127.0.0.1", port), LIMIT_S) as asked, asked.makefile() as lines:
        return lines.readline()


@pytest.mark.network
def test_a_worker_reports_to_the_proxy_whether_it_takes_sessions(start):  # noqa: F811
    port = reserved_port()
    client = start("w0", agent_port=port, max_sessions=1)
    wait_until(lambda: ask(port) == "up ready 100%\n", "the worker to be ready")
    Site(client)
    assert ask(port) == "up drain\n"


def ready(client):
    """Wait until a worker is ready and other workers know it."""
    worker = client.app.state.worker
    wait_until(lambda: worker.readiness().ready, "the worker to be ready")
    tell(client)
    return client


def test_sessions_are_handed_over_before_the_lease_expires(start):  # noqa: F811
    first = start("w0")
    site = Site(first)
    assert site.step().status_code == 200
    second = ready(start("w1"))
    other = by(second, site)
    assert other.step().json()["code"] == "SESSION_ELSEWHERE"

    worker = first.app.state.worker
    assert first.portal.call(worker.hand_over)
    assert worker._willingness().handed_over
    assert other.step().json()["step"] == 2
    # Requests to the old worker are redirected, and it does not take the session back.
    assert site.step().json()["code"] == "SESSION_ELSEWHERE"


def test_jobs_are_handed_over_without_counting_a_worker_death(start, held_videos):  # noqa: F811
    first, second = start("w0"), ready(start("w1"))
    body = {"scene": "tiny", "camera": "front", "width": 64, "fps": 1}
    job = first.post("/v1/exports", json=body).headers["Location"]
    assert held_videos.begun.wait(LIMIT_S)
    first.portal.call(first.app.state.worker.hand_over)
    held_videos.released.set()
    done = succeeded(second, job)
    assert (done["worker"], done["attempt"]) == ("w1", 1)


def test_a_single_worker_does_not_hand_over_its_sessions(start):  # noqa: F811
    client = start("w0")
    site = Site(client)
    assert not client.portal.call(client.app.state.worker.hand_over)
    assert site.step().status_code == 200


def test_a_stopping_server_hands_over_before_it_exits(start, monkeypatch):  # noqa: F811
    first, second = start("w0"), ready(start("w1"))
    site = Site(first)
    server = serve.DrainingServer(
        serve.server_config(first.app, first.app.state.worker.settings), first.app.state.worker
    )
    monkeypatch.setattr(serve, "LINGER_S", 0.0)
    server._stops_at = 0.0
    first.portal.call(server.on_tick, 1)
    assert not server.should_exit
    assert by(second, site).step().json()["step"] == 1
    first.portal.call(server.on_tick, 1)
    assert server.should_exit


def member(name: str, alive: bool = True, **about) -> WorkerRow:
    return WorkerRow(name, alive, {"ready": True} | about)


def test_a_hot_scene_is_loaded_by_one_more_worker():
    hot = member("w0", scenes=["a", "b"], scene_sessions={"a": 4, "b": 3})
    rest = [
        member("w1"),
        member("w2", scenes=["b"]),
        member("w3", draining=True),
        member("w4", alive=False),
    ]
    loads = {name: loads_of(name, [hot, *rest], hot=4) for name in ("w0", "w1", "w2", "w3", "w4")}
    assert sorted(loads.values()) == [[], [], [], [], ["a"]]
    assert loads["w1"] or loads["w2"]
    # Two workers have the scene now, so no other loads it.
    again = [hot, member("w1", scenes=["a"]), member("w2", scenes=["a", "b"])]
    assert [loads_of(name, again, hot=4) for name in ("w0", "w1", "w2")] == [[], [], []]


def test_a_worker_preloads_a_hot_scene(start, monkeypatch):  # noqa: F811
    monkeypatch.setattr(membership, "LOOK_S", 0.05)
    first, second = start("w0", hot_scene_sessions=1), start("w1", hot_scene_sessions=1)
    Site(first)
    for client in (first, second):
        ready(client)
    cache = second.app.state.worker.scene_cache
    wait_until(lambda: cache.resident_names == ["tiny"], "the scene to be loaded")
