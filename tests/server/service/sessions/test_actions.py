"""Controller actions are decoded once, answered in order, counted, and visible to observers."""

from __future__ import annotations

import pytest

import real2sim
from real2sim_server.service.accounts import Account
from real2sim_server.service.sessions import messages

pytestmark = pytest.mark.network

CONTROL = {"kind": "control", "acceleration": 0.5, "steering": 0.02}
CAMERA = {"camera": "front", "width": 160, "codec": "raw"}


@pytest.mark.parametrize("sensors", [[], [CAMERA]])
def test_an_sdk_action_over_shared_memory_is_decoded_once(site, monkeypatch, sensors):
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
        session.reset(action="control", sensors=sensors)
        before = len(decoded)
        for step in range(3):
            assert session.step(CONTROL).step == step + 1
        assert len(decoded) - before == 3


def test_pipelined_messages_are_answered_in_order(site, planner):
    planner.reset(sensors=[])
    ids = [planner.send("action", step=step, plan=CONTROL) for step in range(3)]
    ids.append(planner.send("snapshot", name="here"))
    answers = [planner.receive() for _ in ids]
    assert [a["id"] for a in answers] == ids
    assert [a["step"] for a in answers] == [1, 2, 3, 3]


def test_a_refused_plan_does_not_advance_the_step(site, join):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[])
    session = site.session(info)
    before = session.next_seq
    pose = {"kind": "pose", "x": 0.0, "y": 0.0, "yaw": 0.0}
    assert planner.ask("action", step=0, plan=pose)["code"] == "INVALID_ACTION"
    assert (session.next_seq, session.lock.locked(), session.world.steps) == (before, False, 0)
    assert planner.act(0)["step"] == 1


def test_messages_count_as_requests_of_the_account(site, planner):
    account: Account = site.worker.accounts.default
    planner.reset(sensors=[])
    before = account.requests
    planner.act(0)
    assert account.requests == before + 1


def test_observers_and_the_state_route_see_the_step(site, join):
    info = site.create()
    planner, observer = join(info), join(info, "observer")
    planner.reset(sensors=[])
    observer.receive()
    planner.act(0)
    assert observer.receive()["step"] == 1
    assert site.call("GET", info, "/state").json()["step"] == 1
