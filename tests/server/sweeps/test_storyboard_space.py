"""Scenario files as spaces, and failures as scenario files."""

from __future__ import annotations

import json
import math

import pytest
from typer.testing import CliRunner

from real2sim_server.cli import app
from real2sim_server.console import CommandError
from real2sim_server.scenarios.gallery import corner_case
from real2sim_server.scenarios.openscenario import write_openscenario
from real2sim_server.sweeps import load_space
from real2sim_server.sweeps.episode import adversaries_of
from real2sim_server.sweeps.optimise import SearchBudget
from real2sim_server.sweeps.parameters import drawn_parameters, values_at
from real2sim_server.sweeps.search import FAILURES, SearchOptions, run_search

SPACE = """
storyboard: brakes.xosc
case: {name: brakes, scene: tiny}
parameters:
  gap: {low: 2.0, high: 4.0}
  braking: {low: 7.0, high: 8.0}
"""


@pytest.fixture
def folder(tmp_path):
    """A car that brakes, as a file, with a text among its parameters."""
    text = write_openscenario(corner_case("ccrb").storyboard(speed=5.0, delay=0.5)).decode()
    declared = '<ParameterDeclaration name="shape" parameterType="string" value="linear" />'
    text = text.replace("</ParameterDeclarations>", f"{declared}</ParameterDeclarations>")
    text = text.replace('dynamicsShape="linear"', 'dynamicsShape="$shape"')
    assert "$shape" in text
    (tmp_path / "brakes.xosc").write_text(text)
    (tmp_path / "space.yaml").write_text(SPACE)
    return tmp_path


def _board(space, point):
    return space.case_at(values_at(space.parameters, point)).reset["storyboard"]


def test_numbers_of_a_file_are_varied(folder, scene_folder):
    space = load_space(folder / "space.yaml", scene_folder)
    assert list(drawn_parameters(space.parameters)) == ["gap", "braking"]
    near, far = (_board(space, [u, 0.5])["parameters"]["gap"] for u in (0.0, 1.0))
    assert (near, far) == (2.0, 4.0)
    reset = space.case.reset
    assert (reset["beyond_log"], reset["horizon"]) == ("extend", 150)


def test_text_parameters_of_a_file_are_varied_too(folder, scene_folder):
    (folder / "space.yaml").write_text(
        SPACE + "  shape: {values: [linear, sinusoidal]}\n", encoding="utf-8"
    )
    space = load_space(folder / "space.yaml", scene_folder)
    plain, smooth = (json.dumps(_board(space, [0.5, 0.5, u])["stories"]) for u in (0.2, 0.8))
    assert '"linear"' in plain
    assert '"sinusoidal"' not in plain
    assert '"sinusoidal"' in smooth


def test_distributions_of_a_file_are_parameters_of_its_space(folder, scene_folder):
    (folder / "drawn.xosc").write_text(
        """<OpenSCENARIO><FileHeader revMajor="1" revMinor="3" date="2026-01-01T00:00:00"
        author="a" description="d"/><ParameterValueDistribution>
        <ScenarioFile filepath="brakes.xosc"/><Stochastic numberOfTestRuns="9">
        <StochasticDistribution parameterName="gap">
        <UniformDistribution><Range lowerLimit="5" upperLimit="9"/></UniformDistribution>
        </StochasticDistribution><StochasticDistribution parameterName="braking">
        <NormalDistribution expectedValue="6" variance="4"><Range lowerLimit="2" upperLimit="8"/>
        </NormalDistribution></StochasticDistribution></Stochastic></ParameterValueDistribution>
        </OpenSCENARIO>"""
    )
    (folder / "space.yaml").write_text("storyboard: drawn.xosc\ncase: {name: d, scene: tiny}\n")
    drawn = drawn_parameters(load_space(folder / "space.yaml", scene_folder).parameters)
    assert (drawn["gap"].low, drawn["gap"].high) == (5.0, 9.0)
    assert (drawn["braking"].mean, drawn["braking"].std) == (6.0, 2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("storyboard: brakes.xosc\ncase: {scene: tiny}\n", "has no distributions"),
        (SPACE + "  gab: {low: 1, high: 2}\n", "no parameter 'gab'.* it has gap, speed"),
        (SPACE.replace("brakes.xosc", "none.xosc"), "none.xosc"),
        (SPACE.replace("low: 7.0, high: 8.0", "values: [steep]"), "not a number"),
        (SPACE.replace("brakes.xosc", "{file: brakes.xosc, eggo: x}"), "eggo"),
    ],
)
def test_invalid_scenario_spaces_are_refused_with_a_reason(folder, scene_folder, text, message):
    (folder / "space.yaml").write_text(text)
    with pytest.raises(CommandError, match=message):
        load_space(folder / "space.yaml", scene_folder)


def test_entities_of_a_storyboard_are_known_by_the_ids_of_their_objects():
    board = {"entities": [{"name": "Target 1"}]}
    assert "Target_1" in adversaries_of({"storyboard": board})


def test_a_found_failure_becomes_a_reproducible_scenario_file(folder, scene_folder, tmp_path):
    pytest.importorskip("cmaes")
    out = tmp_path / "out"
    (folder / "space.yaml").write_text(
        SPACE.replace("scene: tiny}", "scene: tiny, reset: {horizon: 40}}")
    )
    space = load_space(folder / "space.yaml", scene_folder)
    options = SearchOptions(SearchBudget(8, stop_at_first=True), shrink=0, scenes=scene_folder)
    run_search([space], "pid", out, options)
    [failure] = json.loads((out / FAILURES).read_text())["failures"]
    scenario = failure["scenario"]
    assert scenario["same"]
    assert scenario["file"] == "scenarios/failure_01.xosc"
    assert scenario["command"] in (out / "failures.html").read_text()

    # As a user would: the command as it is written, from the folder.
    told = scenario["command"].split()[1:]
    told[1] = str(out / told[1])
    figures = tmp_path / "figures.json"
    done = CliRunner().invoke(app, [*told, "--json", str(figures)])
    assert done.exit_code == 0, done.output
    driven = json.loads(figures.read_text())
    [hit] = [e for e in driven["events"] if e["type"] == "collision"]
    assert math.isclose(hit["t"], failure["impact"]["time"], abs_tol=0.101)
    assert driven["metrics"]["collisions"] == 1
