"""Drive jobs on a session, and control of its clock."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

import real2sim
from real2sim.cli import build_app
from real2sim_server.service.sessions.session import ClockHold
from real2sim_server.world.recording import recording_of_bytes

from ..waiting import finished

pytestmark = pytest.mark.network

CONTROL = {"kind": "control", "acceleration": 0.5, "steering": 0.0}
RESET = {"action": "control", "dt_us": 100_000}


@pytest.fixture
def drive(site):
    """Start a drive job on a session. Returns the response."""

    def begin(info, **body):
        return site.call("POST", info, "/drive", json=body)

    return begin


def steps_to(site, info, step: int) -> dict:
    """The state once the clock has reached a step."""
    state: dict = {"step": 0}
    for _ in range(20):
        after = {"after": state["step"], "wait_s": 5}
        state = site.call("GET", info, "/state", params=after).json()
        if state["step"] >= step:
            return state
    raise TimeoutError(state)


def ended(site, job: dict) -> dict:
    return finished(site.http, f"/v1/jobs/{job['job_id']}")


def test_a_drive_by_requests_records_every_step(site, drive):
    info = site.create(RESET)
    job = drive(info, planner=None, steps=4).json()
    for _ in range(4):
        site.call("POST", info, "/step", json={"n": 1, "plan": CONTROL})
    done = ended(site, job)
    assert (done["state"], done["result"]["steps"]) == ("succeeded", 4)
    files = f"/v1/jobs/{job['job_id']}/files"
    shown = site.http.get(f"{files}/playback.json").json()
    recording = recording_of_bytes(site.http.get(f"{files}/recording.r2e").content, "recording")
    assert shown["times_us"] == [instant.t_us for instant in recording.instants]
    lengths = {len(values) for values in (shown["plans"], *shown["metrics"].values())}
    assert lengths == {5}
    last = site.call("GET", info, "/state").json()["ego"]["position"]
    # The suspension compresses slightly.
    assert shown["ego"]["positions"][-1] == pytest.approx(last, abs=1e-2)
    assert {"car_red", "car_blue"} <= shown["tracks"].keys()


def test_a_planner_is_held_stepped_and_stopped_by_the_clock(site, drive):
    info = site.create({"dt_us": 100_000, "seed": 3, "on_collision": "continue"})
    site.call("PUT", info, "/clock", json={"state": "held", "steps": 2})
    job = drive(info, planner="follow_route").json()
    state = steps_to(site, info, 2)
    assert state["held"]
    assert len(state["plan"]) > 1
    site.call("PUT", info, "/clock", json={"state": "held", "steps": 1})
    assert steps_to(site, info, 3)["step"] == 3
    assert drive(info, planner=None).json()["code"] == "CONTROLLER_TAKEN"
    site.call("PUT", info, "/clock", json={"state": "ended"})
    done = ended(site, job)
    assert done["state"] == "succeeded", done
    assert (done["result"]["steps"], done["result"]["reason"]) == (3, "stopped")
    assert "error" not in done["result"]
    shown = site.http.get(f"/v1/jobs/{job['job_id']}/files/playback.json").json()
    assert all(len(plan) > 1 for plan in shown["plans"][:3])
    assert (shown["scenario_id"], shown["reason"]) == (None, "stopped")


def test_a_drive_is_previewed_from_its_own_vehicle(site, drive):
    info = site.create(RESET)
    job = drive(info, planner=None, steps=5).json()
    harder = {"kind": "control", "acceleration": 3.0, "steering": 0.0}
    site.call("POST", info, "/step", json={"n": 5, "plan": harder})
    ended(site, job)
    seen = site.http.get(
        f"/v1/jobs/{job['job_id']}/preview",
        params={"camera": "front", "t_us": 500_000},
        headers={"Accept": "image/png"},
    ).content
    of_the_session = site.call(
        "POST",
        info,
        "/render",
        json={"sensors": [{"camera": "front", "codec": "png"}]},
        headers={"Accept": "image/png"},
    )
    assert of_the_session.status_code == 200, of_the_session.text
    assert seen == of_the_session.content


@pytest.mark.parametrize("end", ["cancel", "delete"])
def test_an_unstarted_drive_is_cancelled_or_fails_with_its_session(site, drive, end):
    info = site.create()
    job = drive(info, planner=None).json()
    if end == "cancel":
        site.http.delete(f"/v1/jobs/{job['job_id']}")
        assert ended(site, job)["state"] == "cancelled"
    else:
        site.call("DELETE", info)
        done = ended(site, job)
        assert done["state"] == "failed"
        assert "the planner did not drive" in done["error"]["detail"]


def test_a_fork_at_an_earlier_step_repeats_the_original(site):
    info = site.create(RESET)
    states = [
        site.call("POST", info, "/step", json={"n": 1, "plan": CONTROL}).json() for _ in range(4)
    ]
    fork = site.call("POST", info, "/fork", params={"step": 2}).json()
    site.made.append(fork)
    assert fork["step"] == 2
    again = site.call("POST", fork, "/step", json={"n": 1, "plan": CONTROL}).json()
    assert again["ego"] == states[2]["ego"]
    assert site.call("GET", info, "/state").json()["step"] == 4
    refused = site.call("POST", info, "/fork", params={"step": 9})
    assert refused.json()["code"] == "INVALID_REQUEST"
    assert "at 4" in refused.json()["detail"]


def test_the_command_drives_an_existing_session(site, drive):
    info = site.create()
    job = drive(info, planner=None, steps=3).json()
    arguments = ("--session", info["session_id"], "--session-token", info["token"])
    options = ("--planner", "follow_route", "--steps", "3", "--url", site.url)
    done = CliRunner().invoke(build_app(), ["drive", *arguments, *options])
    assert done.exit_code == 0, done.output
    assert ended(site, job)["result"]["steps"] == 3


def test_the_sdk_holds_the_clock(site):
    with real2sim.connect(site.url) as client:
        info = client.sessions.create(scene="tiny")
        assert client.sessions.set_clock(info.session_id, "held", steps=1).held is False
        assert client.sessions.set_clock(info.session_id, "held").held is True
        client.sessions.delete(info.session_id)


def test_a_held_clock_allows_a_number_of_actions():
    hold = ClockHold()
    assert hold.free
    hold.hold(after=2)
    held = []
    for _ in range(2):
        held.append(hold.held)
        hold.take_step(100_000)
    assert (held, hold.held, hold.wait_s) == ([False, False], True, float("inf"))
    hold.release()
    assert (hold.free, hold.wait_s) == (True, 0.0)


def test_a_paced_clock_delays_the_next_action():
    hold = ClockHold()
    hold.release(pace=0.5)
    assert (hold.free, hold.wait_s) == (False, 0.0)
    hold.take_step(1_000_000)
    assert 1.0 < hold.wait_s <= 2.0
