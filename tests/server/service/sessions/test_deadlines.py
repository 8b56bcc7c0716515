"""Planners that misbehave: each case ends as the rules say, and nobody else waits for it."""

from __future__ import annotations

import threading
import time

import pytest

import real2sim

pytestmark = pytest.mark.network

PLAN = {"kind": "control", "acceleration": 0.5, "steering": 0.0}
SOON = {"deadline_ms": 80}


@pytest.fixture
def client(site):
    with real2sim.connect(site.url) as client:
        yield client


@pytest.fixture
def bystander(client):
    """Another session, driven meanwhile; the longest step it had to wait for [s]."""
    waits: list[float] = []
    stop = threading.Event()

    def drive() -> None:
        with client.session(scene="tiny") as session:
            while not stop.is_set():
                obs = session.reset(action="control")
                while not obs.over and not stop.is_set():
                    began = time.monotonic()
                    obs = session.step(PLAN)
                    waits.append(time.monotonic() - began)

    thread = threading.Thread(target=drive)
    thread.start()
    yield waits
    until = time.monotonic() + 10
    while len(waits) <= 5 and time.monotonic() < until:
        time.sleep(0.01)
    stop.set()
    thread.join(30)
    assert len(waits) > 5
    assert max(waits) < 2.0


def kinds(obs: real2sim.Observation) -> list[str]:
    return [event.type for event in obs.events]


def test_a_planner_that_hangs_is_driven_on_by_its_last_plan(client, bystander):
    with client.session(scene="tiny") as session:
        session.reset(action="control", **SOON)
        first = session.step(PLAN)
        time.sleep(0.5)
        late = session.step(PLAN)
    assert late.step >= 4
    assert "deadline_missed" in kinds(late)
    assert late.ego.speed > first.ego.speed


def test_a_planner_that_hangs_for_good_comes_to_the_end_of_its_episode(client):
    with client.session(scene="tiny") as session:
        session.reset(action="control", horizon=4, deadline_ms=30)
        time.sleep(0.6)
        last = session.step(PLAN)
    assert (last.step, last.over, last.reason) == (4, True, "horizon")


def test_a_late_planner_can_be_braked_for(client):
    with client.session(scene="tiny") as session:
        begun = session.reset(action="control", on_timeout="brake", **SOON)
        time.sleep(0.3)
        late = session.step(PLAN)
    # On the way to -6 m/s^2 behind the lag of the brakes.
    assert -6.0 <= late.ego.acceleration < -1.0
    assert late.ego.speed < begun.ego.speed


def test_a_late_planner_can_be_waited_for(client):
    with client.session(scene="tiny") as session:
        session.reset(action="control", on_timeout="pause", **SOON)
        time.sleep(0.3)
        late = session.step(PLAN)
        assert (late.step, kinds(late)) == (1, ["deadline_missed"])
        assert kinds(session.step(PLAN)) == []


def test_a_late_planner_can_fail_its_episode(client):
    with client.session(scene="tiny") as session:
        session.reset(action="control", on_timeout="fail", **SOON)
        time.sleep(0.3)
        failed = session.step(PLAN)
        assert (failed.step, failed.truncated, failed.reason) == (0, True, "deadline")
        assert session.reset(action="control").step == 0


def test_an_episode_ends_with_its_wall_clock_time(client):
    with client.session(scene="tiny") as session:
        session.reset(action="control", wall_clock_s=0.2)
        time.sleep(0.4)
        ended = session.step(PLAN)
        assert (ended.truncated, ended.reason) == (True, "wall_clock")


def test_a_late_action_is_stale_and_never_applied(site, join):
    planner = join(site.create())
    planner.reset(deadline_ms=60)
    unasked = planner.receive()
    assert (unasked["id"], unasked["step"]) == (0, 1)
    answer = planner.act(0)
    while answer["type"] == "obs":
        answer = planner.receive()
    assert answer["code"] == "STALE_STEP"


def test_the_clock_stands_while_nobody_is_connected(site, join):
    info = site.create()
    first = join(info, None)
    token = first.hello()["resume_token"]
    first.reset(deadline_ms=150)
    first.stack.close()
    time.sleep(0.6)
    assert site.session(info).world.steps == 0
    second = join(info, None)
    second.hello(resume={"token": token, "last_step": 0})
    assert second.act(0)["step"] == 1


def test_measured_latency_is_on_record_and_delays_the_plan(site, join):
    planner = join(site.create())
    planner.reset(latency={"model": "measured"})
    time.sleep(0.25)
    # A quarter of a second is more than a step: meanwhile the recorded drive goes on.
    late, prompt = (planner.act(step, acceleration=-8.0)["ego"]["speed"] for step in (0, 1))
    assert late == pytest.approx(5.0, abs=0.05)
    assert prompt < 4.9


@pytest.mark.parametrize(
    ("plan", "code"),
    [
        ({"kind": "control", "acceleration": float("nan"), "steering": 0.0}, "BAD_MESSAGE"),
        (
            {"kind": "trajectory", "times_us": [100_000], "poses": [[float("inf"), 0, 0]]},
            "BAD_MESSAGE",
        ),
        ({"kind": "trajectory", "times_us": [1, 2], "poses": [[1, 0, 0]]}, "BAD_MESSAGE"),
        ({"kind": "trajectory", "times_us": [], "poses": []}, "BAD_MESSAGE"),
        (
            {"kind": "trajectory", "times_us": [100_000] * 1025, "poses": [[1, 0, 0]] * 1025},
            "BAD_MESSAGE",
        ),
        ({"kind": "pose", "x": 0.0, "y": 0.0, "yaw": 0.0}, "INVALID_ACTION"),
    ],
)
def test_plans_that_say_nothing_sensible_are_refused_and_move_nothing(
    site, join, bystander, plan, code
):
    planner = join(site.create())
    planner.reset()
    answer = planner.ask("action", step=0, plan=plan)
    assert (answer["code"], answer["fatal"], answer["step"]) == (code, False, 0)
    assert planner.act(0)["step"] == 1


def test_answers_twice_and_out_of_order_are_told_apart(site, join, bystander):
    planner = join(site.create())
    planner.reset()
    assert planner.act(0)["step"] == 1
    assert planner.act(0)["step"] == 1
    assert planner.act(0, acceleration=-1.0)["code"] == "STEP_CONFLICT"
    assert planner.act(3)["code"] == "BAD_STEP"
    assert planner.act(1)["step"] == 2
    assert planner.act(0)["code"] == "STALE_STEP"


def test_a_connection_that_drops_in_a_step_disturbs_nobody(site, join, bystander):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[{"camera": "front"}])
    planner.send("action", step=0, plan=PLAN)
    planner.socket.socket.close()
    until = time.monotonic() + 10
    while site.session(info).world.steps < 1 and time.monotonic() < until:
        time.sleep(0.02)
    assert site.session(info).world.steps == 1
