"""Steps that no task is woken for are the steps that they are otherwise."""

from __future__ import annotations

import pytest

import real2sim
from real2sim_server.service.accounts import Account
from real2sim_server.service.sessions import connection, messages
from real2sim_server.service.sessions.connection import Connection
from real2sim_server.service.token_file import TokenLimits

pytestmark = pytest.mark.network

CONTROL = {"kind": "control", "acceleration": 0.5, "steering": 0.02}
CAMERA = {"camera": "front", "width": 160, "codec": "raw"}


@pytest.fixture
def woken(monkeypatch) -> list[int]:
    """Steps of the actions that came the ordinary way."""
    steps: list[int] = []
    ordinary = Connection._act

    async def act(self, action, content):
        steps.append(action.step)
        return await ordinary(self, action, content)

    monkeypatch.setattr(Connection, "_act", act)
    return steps


def test_a_due_action_without_sensors_wakes_no_task(planner, woken):
    planner.reset(sensors=[])
    assert [planner.act(step)["step"] for step in range(3)] == [1, 2, 3]
    assert woken == []


def test_steps_of_the_sdk_on_the_same_machine_wake_no_task(site, woken, monkeypatch):
    decoded = []
    for name in ("unpack", "decode"):
        read = getattr(messages, name)

        def counted(data, read=read, **limits):
            decoded.append(data)
            return read(data, **limits)

        monkeypatch.setattr(messages, name, counted)
    with (
        real2sim.connect(site.url) as client,
        client.session(scene="tiny", shared_memory=True) as session,
    ):
        session.reset(action="control")
        before = len(decoded)
        for step in range(3):
            obs = session.step(CONTROL)
            assert obs.step == step + 1
        assert len(decoded) - before == 3
    assert woken == []


def test_a_slot_that_is_not_there_goes_the_ordinary_way(planner, woken):
    planner.reset(sensors=[])
    # Nobody has attached, so that slots do not matter yet.
    assert planner.ask("action", step=0, plan=CONTROL, slot=4)["step"] == 1
    assert woken == [0]


def test_an_action_with_sensors_goes_the_ordinary_way(planner, woken):
    planner.reset(sensors=[CAMERA])
    assert planner.act(0)["step"] == 1
    assert woken == [0]


def test_what_is_not_due_is_answered_the_ordinary_way(planner, woken):
    planner.reset(sensors=[])
    first = planner.act(0)
    again = planner.act(0)
    assert (again["step"], again["metrics"]) == (1, first["metrics"])
    assert planner.act(5)["code"] == "BAD_STEP"
    assert woken == [0, 5]


def test_messages_sent_ahead_are_answered_in_order(site, planner):
    planner.reset(sensors=[])
    ids = [planner.send("action", step=step, plan=CONTROL) for step in range(3)]
    ids.append(planner.send("snapshot", name="here"))
    answers = [planner.receive() for _ in ids]
    assert [a["id"] for a in answers] == ids
    assert [a["step"] for a in answers] == [1, 2, 3, 3]


def test_a_refused_plan_leaves_the_action_due(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[])
    session = site.session(info)
    before = session.next_seq
    pose = {"kind": "pose", "x": 0.0, "y": 0.0, "yaw": 0.0}
    assert planner.ask("action", step=0, plan=pose)["code"] == "INVALID_ACTION"
    assert (session.next_seq, session.lock.locked(), session.world.steps) == (before, False, 0)
    assert planner.act(0)["step"] == 1


def test_an_observation_that_cannot_be_written_at_once_arrives_once(planner, monkeypatch, woken):
    monkeypatch.setattr(connection, "try_send_parts", lambda _socket, _parts: False)
    planner.reset(sensors=[])
    assert [planner.act(step)["step"] for step in range(2)] == [1, 2]
    assert woken == []


def test_a_step_whose_answer_cannot_be_written_is_due_still(planner, monkeypatch):
    def broken(_socket: object, parts: list[bytes]) -> bool:
        monkeypatch.undo()
        raise OSError("no such socket")

    planner.reset(sensors=[])
    monkeypatch.setattr(connection, "try_send_parts", broken)
    assert planner.act(0)["code"] == "INTERNAL"
    assert planner.act(0)["step"] == 1


def test_whoever_has_limits_is_asked_each_time(site, planner, monkeypatch, woken):
    account: Account = site.worker.accounts.default
    planner.reset(sensors=[])
    account.limit(TokenLimits(requests_per_second=1000))
    try:
        assert planner.act(0)["step"] == 1
    finally:
        account.limit(TokenLimits())
    assert woken == [0]


def test_messages_are_counted(site, planner):
    account: Account = site.worker.accounts.default
    planner.reset(sensors=[])
    before = account.requests
    planner.act(0)
    assert account.requests == before + 1


def test_an_observer_and_the_present_state_see_the_step(site, join):
    info = site.create()
    planner, observer = join(info), join(info, "observer")
    planner.reset(sensors=[])
    observer.receive()
    planner.act(0)
    assert observer.receive()["step"] == 1
    assert site.call("GET", info, "/state").json()["step"] == 1
