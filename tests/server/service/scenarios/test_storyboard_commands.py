"""``real2sim scenario`` and ``real2sim drive`` against a worker."""

from __future__ import annotations

import re

import pytest
from typer.testing import CliRunner

import real2sim
from real2sim.cli import build_app
from real2sim_server.service.serve import running_worker

pytestmark = pytest.mark.network


@pytest.fixture
def worker(make_settings):
    with running_worker(make_settings()) as running:
        yield running


def printed(worker, *words: str) -> str:
    """Output of a command, regardless of its exit code."""
    result = CliRunner().invoke(build_app(), [*words, "--url", worker.url])
    hint = getattr(result.exception, "hint", None) or ""
    return f"{result.output}{result.exception or ''} {hint}"


def test_a_gallery_case_is_exported_edited_imported_and_driven(worker, tmp_path):
    file = tmp_path / "ccrb.xosc"
    applied = printed(worker, "scenario", "apply", "ccrb", "--scene", "tiny", "--set", "gap=9")
    scenario = re.search(r"sc_\w+", applied).group()
    printed(worker, "scenario", "export", scenario, str(file))
    text = re.sub(r'(name="gap" [^>]*value=)"[^"]*"', r'\1"30"', file.read_text())
    file.write_text(text)

    assert "revision 2" in printed(worker, "scenario", "import", scenario, str(file))
    with real2sim.connect(worker.url) as client:
        assert client.scenarios.get(scenario).storyboard.parameters["gap"] == 30.0
    driven = printed(worker, "drive", "--scenario", scenario, "--cameras", "", "--steps", "5")
    assert re.search(r"storyboard \S+ start", driven), driven


PLANNER = """
from real2sim import Control
{head}
class Mine:
    {needs}
    def reset(self, obs): pass
    def plan(self, obs):
        obs.image("front")
        return Control(acceleration=0.0, steering=0.0)
"""


@pytest.mark.parametrize("asks", ["by its class", "by --reset"])
def test_a_custom_planner_receives_images_and_sends_controls(worker, tmp_path, monkeypatch, asks):
    monkeypatch.chdir(tmp_path)
    head = needs = ""
    options: tuple[str, ...] = ()
    if asks == "by its class":
        head = "from real2sim.planners import Needs"
        needs = 'needs = Needs(modalities=("rgb",), action="control")'
    else:
        options = ("--reset", '{"action": "control", "sensors": ["front"]}')
    module = f"planner_{asks[-5:].strip('-')}"
    (tmp_path / f"{module}.py").write_text(PLANNER.format(head=head, needs=needs))
    words = ("drive", "--scene", "tiny", "--planner", f"{module}:Mine", "--steps", "2", *options)

    assert "2 steps" in printed(worker, *words)


def test_a_planner_without_needs_gets_the_missing_line_as_a_hint(worker, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = PLANNER.format(head="", needs="")
    (tmp_path / "blind.py").write_text(text)
    (tmp_path / "steering.py").write_text(text.replace('obs.image("front")', "pass"))
    words = ("drive", "--scene", "tiny", "--steps", "2", "--planner")

    assert "needs = Needs(modalities=('rgb',))" in printed(worker, *words, "blind:Mine")
    assert "needs = Needs(action='control')" in printed(worker, *words, "steering:Mine")


def test_an_option_set_twice_is_refused_by_name(worker):
    words = ("drive", "--scene", "tiny", "--steps", "1", "--seed", "3", "--reset")

    assert "seed is set by both --seed and --reset" in printed(worker, *words, '{"seed": 4}')


def test_the_line_ending_of_a_token_is_stripped(make_settings):
    with running_worker(make_settings(token="correct-horse")) as worker:
        assert "ready" in printed(worker, "status", "--token", "correct-horse\r\n")
        told = printed(worker, "status", "--token", "correct-\rhorse")
    assert "character 9 of the token is U+000D" in told
    assert "horse" not in told


def test_a_refused_gallery_case_creates_no_scenario(worker):
    words = ("scenario", "apply", "ccrb", "--scene", "tiny", "--set", "gab=9")
    assert "no parameter 'gab'" in printed(worker, *words)
    with real2sim.connect(worker.url) as client:
        assert not client.scenarios.list()
