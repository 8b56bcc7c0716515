"""Planners that miss deadlines or send invalid answers. No other session is affected.

Time only advances when a test moves it, so no planner is late by accident.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

import real2sim
from tests.waiting import wait_until

pytestmark = pytest.mark.network

PLAN = {"kind": "control", "acceleration": 0.5, "steering": 0.0}
LATE = {"deadline_ms": 80}


@pytest.fixture
def episode(site):
    """Start an episode through the SDK. Keyword arguments go to ``reset``. Yields the SDK's
    session, the worker's session and the first observation."""

    @contextlib.contextmanager
    def begin(**spec) -> Iterator[tuple]:
        with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
            first = session.reset(action="control", **spec)
            (inside,) = (s for s in site.worker.sessions if s.session_id == session.session_id)
            yield session, inside, first

    return begin


def kinds(obs: real2sim.Observation) -> list[str]:
    return [event.type for event in obs.events]


def miss_deadlines(manual_clock, inside, *, after: real2sim.Observation, to: int) -> None:
    """Miss deadlines until the worker has driven on to a step.

    The session may reach the step slightly after its answer.
    """
    for step in range(after.step + 1, to + 1):
        manual_clock.expire_next()
        wait_until(lambda step=step: inside.world.steps == step, f"step {step}")


def test_the_last_plan_continues_while_a_planner_hangs(episode, manual_clock, bystander):
    with episode(**LATE) as (session, inside, _):
        first = session.step(PLAN)
        miss_deadlines(manual_clock, inside, after=first, to=4)
        # The observation is sent before the next deadline starts.
        manual_clock.wait_for_sleeper()
        late = session.step(PLAN)
    assert late.step == 4
    assert "deadline_missed" in kinds(late)
    assert late.ego.speed > first.ego.speed


def test_an_episode_ends_even_if_its_planner_never_answers(episode, manual_clock):
    with episode(horizon=4, **LATE) as (session, inside, first):
        miss_deadlines(manual_clock, inside, after=first, to=4)
        wait_until(lambda: inside.world.over, "the end of the episode")
        last = session.step(PLAN)
    assert (last.step, last.over, last.reason) == (4, True, "horizon")


def test_on_timeout_brake_brakes_the_vehicle(episode, manual_clock):
    with episode(on_timeout="brake", **LATE) as (session, inside, first):
        miss_deadlines(manual_clock, inside, after=first, to=3)
        manual_clock.wait_for_sleeper()
        late = session.step(PLAN)
    # Braking towards -6 m/s^2, delayed by the brake lag.
    assert -6.0 <= late.ego.acceleration < -1.0
    assert late.ego.speed < 5.0  # the initial speed


def test_on_timeout_pause_waits_for_the_planner(episode, manual_clock):
    with episode(on_timeout="pause", **LATE) as (session, inside, _):
        manual_clock.expire_next()
        wait_until(lambda: inside.late, "the deadline to be missed")
        late = session.step(PLAN)
        assert (late.step, kinds(late)) == (1, ["deadline_missed"])
        assert kinds(session.step(PLAN)) == []


def test_on_timeout_fail_ends_the_episode(episode, manual_clock):
    with episode(on_timeout="fail", **LATE) as (session, inside, _):
        manual_clock.expire_next()
        wait_until(lambda: inside.world.over, "the end of the episode")
        failed = session.step(PLAN)
        assert (failed.step, failed.truncated, failed.reason) == (0, True, "deadline")
        assert session.reset(action="control").step == 0


def test_an_episode_ends_at_its_wall_clock_limit(episode, manual_clock):
    with episode(wall_clock_s=0.2) as (session, inside, _):
        manual_clock.expire_next()
        wait_until(lambda: inside.world.over, "the end of the episode")
        ended = session.step(PLAN)
        assert (ended.truncated, ended.reason) == (True, "wall_clock")


def test_a_late_action_is_stale_and_not_applied(site, join, manual_clock):
    planner = join(site.create())
    planner.reset(**LATE)
    manual_clock.expire_next()
    unasked = planner.receive()
    assert (unasked["id"], unasked["step"]) == (0, 1)
    assert planner.act(0)["code"] == "STALE_STEP"


def test_the_deadline_pauses_without_a_controller(site, join, manual_clock):
    info = site.create()
    first = join(info, None)
    token = first.hello()["resume_token"]
    first.reset(**LATE)
    manual_clock.wait_for_sleeper()
    first.stack.close()
    wait_until(lambda: not manual_clock.anything_due, "the worker to stop the deadline")
    manual_clock.advance(1.0)
    assert site.session(info).world.steps == 0
    second = join(info, None)
    second.hello(resume={"token": token, "last_step": 0})
    assert second.act(0)["step"] == 1


def test_measured_latency_delays_the_plan(site, join, manual_clock):
    planner = join(site.create())
    # The deadline timer shows when the observation counts as sent.
    planner.reset(latency={"model": "measured"}, deadline_ms=900)
    manual_clock.wait_for_sleeper()
    manual_clock.advance(0.25)
    # A quarter of a second is longer than a step. The recorded drive continues in the meantime.
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
def test_invalid_plans_are_refused_and_do_not_advance_the_step(site, join, bystander, plan, code):
    planner = join(site.create())
    planner.reset()
    answer = planner.ask("action", step=0, plan=plan)
    assert (answer["code"], answer["fatal"], answer["step"]) == (code, False, 0)
    assert planner.act(0)["step"] == 1


def test_repeated_conflicting_and_stale_actions_get_different_answers(site, join, bystander):
    planner = join(site.create())
    planner.reset()
    assert planner.act(0)["step"] == 1
    assert planner.act(0)["step"] == 1
    assert planner.act(0, acceleration=-1.0)["code"] == "STEP_CONFLICT"
    assert planner.act(3)["code"] == "BAD_STEP"
    assert planner.act(1)["step"] == 2
    assert planner.act(0)["code"] == "STALE_STEP"


def test_a_connection_lost_during_a_step_does_not_affect_other_sessions(site, join, bystander):
    info = site.create()
    planner = join(info)
    planner.reset(sensors=[{"camera": "front"}])
    planner.send("action", step=0, plan=PLAN)
    planner.socket.socket.close()
    wait_until(lambda: site.session(info).world.steps == 1, "the step")
