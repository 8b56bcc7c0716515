"""``real2sim scenario`` and ``real2sim drive`` against a worker, as a user has them."""

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
    """What a command prints, whatever its exit code."""
    result = CliRunner().invoke(build_app(), [*words, "--url", worker.url])
    return result.output + str(result.exception or "")


def test_a_case_of_the_gallery_goes_out_as_a_file_comes_in_and_is_driven(worker, tmp_path):
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


def test_a_case_that_is_refused_leaves_no_scenario(worker):
    words = ("scenario", "apply", "ccrb", "--scene", "tiny", "--set", "gab=9")
    assert "no parameter 'gab'" in printed(worker, *words)
    with real2sim.connect(worker.url) as client:
        assert not client.scenarios.list()
