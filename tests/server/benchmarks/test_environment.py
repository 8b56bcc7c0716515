"""Every bench records its environment."""

import importlib
import json
import platform
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import real2sim_bench
from real2sim_bench import cli as bench
from real2sim_bench import physics

NAMES = (
    "dataset",
    "detector",
    "edit",
    "learn",
    "physics",
    "planners",
    "reconstruct",
    "recovery",
    "render",
    "search",
    "sensors",
    "serve",
    "soak",
    "world",
)
MODULES = {name: importlib.import_module(f"{real2sim_bench.__name__}.{name}") for name in NAMES}
FIGURES = {"failures": [], "grows": False, "stage_ms": {}}


def test_versions_match_the_installed_libraries():
    found = bench.environment()
    assert found["python"] == platform.python_version()
    assert found["numpy"] == np.__version__
    assert found["numba"] == numba.__version__
    assert found["torch"] == torch.__version__
    assert found["cpu"]
    assert found["cpu_threads"] >= 1


def test_a_missing_library_is_reported(monkeypatch):
    monkeypatch.setattr(bench, "LIBRARIES", ("no-such-library",))
    assert bench.environment()["no-such-library"] == "not installed"


def test_every_bench_is_tested():
    folder = Path(real2sim_bench.__file__).parent
    named = {info.name for info in bench.app.registered_commands}
    assert named == set(MODULES)
    there = {path.stem for path in folder.iterdir()}
    assert named <= there


@pytest.mark.parametrize("name", sorted(MODULES))
def test_every_bench_writes_and_prints_its_environment(name, tmp_path, monkeypatch):
    monkeypatch.setattr(MODULES[name], "run", lambda *args, **options: {**FIGURES, "figure": 1})
    monkeypatch.setattr(physics, "as_rows", lambda figures: {})
    path = tmp_path / "figures.json"
    done = CliRunner().invoke(bench.app, [name, "--json", str(path)])
    assert done.exit_code == 0, done.output
    written = json.loads(path.read_text())
    assert written["figure"] == 1
    assert written["environment"] == bench.environment()
    assert "measured with" in done.output
    assert np.__version__ in done.output
