"""The CUDA backend against the reference, in Numba's simulator: one process for all scenes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

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
    "two bodies",
    "leaving",
)
TOUCHES = dict.fromkeys(SCENES, 1) | {"two bodies": 2, "leaving": 0}
CASES = ("free_fall", "affine_patch", "spin", "invariants")
TOLERANCES = {"Metal": 1e-7, "Foam": 1e-7}
"""Compiled laws hold the sqrt(2/3) of von Mises in single precision, the reference in double."""
pytestmark = pytest.mark.timeout(300, func_only=True)


@pytest.fixture(scope="module")
def simulated():
    program = [sys.executable, "-W", "error::RuntimeWarning", "-m"]
    done = subprocess.run(
        [*program, "tests.server.physics.simulated_cuda"],
        cwd=ROOT,
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("scene", SCENES)
def test_the_device_follows_the_reference(simulated, scene):
    off = dict(simulated["reference"][scene])
    assert off.pop("contacts") == TOUCHES[scene]
    bound = TOLERANCES.get(scene, 1e-9)
    assert {name: value for name, value in off.items() if not value < bound} == {}


@pytest.mark.parametrize("material", MATERIALS)
def test_the_device_follows_the_compiled_cpu(simulated, material):
    off = dict(simulated["cpu"][material])
    assert off.pop("contacts") == TOUCHES[material]
    assert {name: value for name, value in off.items() if not value < 1e-9} == {}


def test_single_precision_stays_near_double(simulated):
    assert 1e-12 < simulated["single"]["positions"] < 1e-6
    assert simulated["single"]["F_elastic"] < 1e-4


def test_a_run_that_is_taken_back_goes_on_as_before(simulated):
    assert simulated["restored"] < 1e-12


@pytest.mark.parametrize("case", CASES)
def test_the_cheap_cases_of_the_table_hold(simulated, case):
    lines = [line for line in simulated["lines"] if line["case"] == case]
    assert lines
    assert [line for line in lines if not line["passed"]] == []


def test_without_a_device_the_reason_is_given(monkeypatch):
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with pytest.raises(SolverError, match=r"'cuda' is not usable here: .*NVIDIA GPU.*take 'cpu'"):
        CudaSolverBackend()
