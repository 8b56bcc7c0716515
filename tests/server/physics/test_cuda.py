"""The CUDA backend against the reference, in Numba's simulator: two processes for all scenes.

The simulator takes seconds a scene, so every run sees one of each kind and the slow ones all.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba import cuda

from real2sim_server.physics import SolverError
from real2sim_server.physics.backends.cuda.backend import CudaSolverBackend

ROOT = Path(__file__).parents[3]
MATERIALS = ("FixedCorotated", "NeoHookean", "Metal", "Foam", "Sand", "Snow")
SCENES = (
    *MATERIALS,
    "slope",
    "moving box",
    "height field",
    "glue",
    "post",
    "two bodies",
    "leaving",
)
TOUCHES = dict.fromkeys(SCENES, 1) | {"two bodies": 2, "leaving": 0}
CASES = ("free_fall", "affine_patch", "spin", "invariants")
ALWAYS = ("Metal", "Sand", "height field", "post", "two bodies", "leaving", "free_fall")
TOLERANCES = {"Metal": 1e-7, "Foam": 1e-7}
"""Compiled laws hold the sqrt(2/3) of von Mises in single precision, the reference in double."""
pytestmark = pytest.mark.timeout(300, func_only=True)


def simulate(*names: str) -> dict[str, Any]:
    program = [sys.executable, "-W", "error::RuntimeWarning", "-m"]
    done = subprocess.run(
        [*program, "tests.server.physics.simulated_cuda", *names],
        cwd=ROOT,
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def always() -> dict[str, Any]:
    return simulate(*ALWAYS)


@pytest.fixture(scope="module")
def besides() -> dict[str, Any]:
    return simulate(*{*SCENES, *CASES} - {*ALWAYS})


@pytest.fixture
def simulated(request: pytest.FixtureRequest, name: str) -> dict[str, Any]:
    return request.getfixturevalue("always" if name in ALWAYS else "besides")


def every(*names: str) -> pytest.MarkDecorator:
    marked = [n if n in ALWAYS else pytest.param(n, marks=pytest.mark.slow) for n in names]
    return pytest.mark.parametrize("name", marked)


@every(*SCENES)
def test_the_device_follows_the_reference(simulated, name):
    off = dict(simulated["reference"][name])
    assert off.pop("contacts") == TOUCHES[name]
    bound = TOLERANCES.get(name, 1e-9)
    assert {field: value for field, value in off.items() if not value < bound} == {}


@every(*MATERIALS)
def test_the_device_follows_the_compiled_cpu(simulated, name):
    off = dict(simulated["cpu"][name])
    assert off.pop("contacts") == TOUCHES[name]
    assert {field: value for field, value in off.items() if not value < 1e-9} == {}


def test_single_precision_stays_near_double(always):
    assert 1e-12 < always["single"]["positions"] < 1e-6
    assert always["single"]["F_elastic"] < 1e-4


def test_a_run_that_is_taken_back_goes_on_as_before(always):
    assert always["restored"] < 1e-12


@every(*CASES)
def test_the_cheap_cases_of_the_table_hold(simulated, name):
    lines = [line for line in simulated["lines"] if line["case"] == name]
    assert lines
    assert [line for line in lines if not line["passed"]] == []


def test_without_a_device_the_reason_is_given(monkeypatch):
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with pytest.raises(SolverError, match=r"'cuda' is not usable here: .*NVIDIA GPU.*take 'cpu'"):
        CudaSolverBackend()
