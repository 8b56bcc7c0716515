"""A step runs the documented phases in order."""

from __future__ import annotations

import re
import threading

import pytest

from real2sim_server.service.sessions import pipeline
from real2sim_server.service.sessions.connection import Connection
from real2sim_server.service.sessions.pipeline import StepPipeline

pytestmark = pytest.mark.network

CAMERA = {"camera": "front", "width": 160, "codec": "raw"}
PHASES = re.findall(r"(?m)^``(\w+)``", pipeline.__doc__ or "")
"""From the docstring of the module."""


@pytest.fixture
def passed(monkeypatch) -> list[tuple[str, str]]:
    """(phase, thread) of every started phase."""
    phases: list[tuple[str, str]] = []

    def note(owner: type, method: str, phase: str) -> None:
        original = getattr(owner, method)

        def noted(*given, **options):
            phases.append((phase, threading.current_thread().name))
            return original(*given, **options)

        monkeypatch.setattr(owner, method, noted)

    for phase in ("receive", "check"):
        note(Connection, f"_{phase}", phase)
    for phase in ("advance", "render", "evaluate", "encode"):
        note(StepPipeline, phase, phase)
    note(Connection, "_send", "send")
    return phases


def test_the_phases_are_the_documented_ones():
    assert PHASES == ["receive", "check", "advance", "render", "evaluate", "encode", "send"]


def test_an_action_with_raw_images_runs_every_phase_once(planner, passed):
    planner.reset(sensors=[CAMERA])
    passed.clear()
    assert planner.act(0)["step"] == 1
    seen = [phase for phase, _ in passed if phase != "receive"]
    # Evaluation overlaps with rendering.
    assert sorted(seen[2:4]) == ["evaluate", "render"]
    assert [seen[0], seen[1], *seen[4:]] == ["check", "advance", "encode", "send"]


def test_evaluation_runs_on_another_thread_than_rendering(planner, passed):
    planner.reset(sensors=[CAMERA])
    passed.clear()
    planner.act(0)
    threads = dict(passed)
    assert threads["advance"] == threads["render"] == "engine"
    assert threads["evaluate"].startswith("evaluate")
    assert threads["check"] == threads["send"] != "engine"


def test_a_world_without_sensors_does_not_use_the_engine(planner, passed):
    planner.reset(sensors=[])
    passed.clear()
    planner.act(0)
    threads = dict(passed)
    assert threads["advance"] == threads["evaluate"]
    assert threads["advance"].startswith("worlds")
    assert "render" not in threads
