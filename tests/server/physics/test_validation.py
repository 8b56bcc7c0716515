"""The validation table on both backends; every line must hold."""

from __future__ import annotations

import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest
import typer

from real2sim_server.cli.physics import validate
from real2sim_server.physics import PhysicsError
from real2sim_server.physics.validation import CASES, Check, ReferenceCurve
from real2sim_server.physics.validation import table as table_module
from real2sim_server.physics.validation.table import render_page, run_table
from real2sim_server.simulation.experiments import crash_tests

SLOW_ON_CPU = {
    "two_discs",
    "hertz",
    "cantilever",
    "loaded_beam",
    "incline",
    "braking",
    "restitution",
}
QUICK_ON_REFERENCE = {
    "affine_patch",
    "invariants",
    "reproducibility",
    "scale_invariance",
}
REFERENCE_ONLY = {"gradients"}
"""Cases that run on the reference whatever backend is asked for."""


def failures(case, backend):
    return [check for check in CASES[case](backend) if not check.passed]


def marked(cases, quick):
    slow = pytest.mark.slow
    return [c if c in quick else pytest.param(c, marks=slow) for c in cases]


@pytest.mark.parametrize("case", marked(CASES, set(CASES) - SLOW_ON_CPU))
def test_cpu(case):
    assert not failures(case, "cpu")


@pytest.mark.parametrize(
    "case", marked([c for c in CASES if c not in REFERENCE_ONLY], QUICK_ON_REFERENCE)
)
@pytest.mark.timeout(7200)
def test_reference(case):
    assert not failures(case, "reference")


def test_a_check_fails_on_nan_and_outside_its_tolerance():
    assert Check("a", 1.0, 1.1, 0.2).passed
    assert not Check("a", 1.0, 1.3, 0.2).passed
    assert not Check("a", float("nan"), 1.0, 10.0).passed


def test_unknown_cases_are_reported_by_name():
    with pytest.raises(PhysicsError, match=r"no cases \['gravity'\]; there are free_fall"):
        run_table(cases=["spin", "gravity"])
    with pytest.raises(PhysicsError, match="unknown backend"):
        run_table(backend="gpu")


def failing(backend):
    """A case that misses."""
    return [Check("missed <by> far", 2.0, 1.0, 0.1, "m"), Check("no number", math.nan, 1.0, 0.1)]


def breaking(backend):
    """A case that raises."""
    raise IndexError("no contact")


def fine(backend):
    """A case that passes, with a curve."""
    x = np.linspace(0, 1, 5).tolist()
    return [Check("held", 1.0, 1.0, 0.1, curve=ReferenceCurve(x, x, x, "time [s]", "way [m]"))]


@pytest.fixture
def small_table(monkeypatch):
    cases = {"failing": failing, "breaking": breaking, "fine": fine}
    monkeypatch.setattr(table_module, "CASES", cases)
    monkeypatch.setattr(crash_tests, "THEORY", {})


@pytest.mark.usefixtures("small_table")
def test_a_failing_line_gives_exit_code_1_and_all_figures(tmp_path):
    out = tmp_path / "table.json"
    with pytest.raises(typer.Exit) as left:
        validate(json=out)
    assert left.value.exit_code == 1
    figures = json.loads(out.read_text())
    assert not figures["passed"]
    assert [c["passed"] for c in figures["cases"]] == [False, False, True]
    assert [line["passed"] for line in figures["lines"]] == [False, False, True]
    assert "no contact" in figures["cases"][1]["error"]
    assert out.with_suffix(".html").exists()


@pytest.mark.usefixtures("small_table")
def test_passing_lines_give_no_exit_code(tmp_path):
    validate(cases="fine", page=tmp_path / "page.html")
    assert "all 1 lines hold" in (tmp_path / "page.html").read_text()


@pytest.mark.usefixtures("small_table")
def test_the_page_shows_every_line_with_complete_plots():
    page = render_page(run_table(), backend="cpu")
    assert "missed &lt;by&gt; far" in page
    assert "no contact" in page
    assert "src=" not in page
    assert 'href="http' not in page
    pictures = [part.split("</svg>")[0] + "</svg>" for part in page.split("<svg")[1:]]
    assert len(pictures) == 4
    for picture in pictures:
        ElementTree.fromstring("<svg" + picture)


def test_published_crash_figures_run_when_named(monkeypatch, tmp_path):
    monkeypatch.setattr(crash_tests, "PUBLISHED", {"malibu": fine, "pair": fine})
    validate(cases="published", json=tmp_path / "table.json")
    figures = json.loads((tmp_path / "table.json").read_text())
    assert [case["name"] for case in figures["cases"]] == ["malibu", "pair"]
