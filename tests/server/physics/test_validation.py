"""The validation table on both backends; every line must hold."""

from __future__ import annotations

import pytest

from real2sim_server.physics.validation import CASES
from real2sim_server.physics.validation.check import Check

SLOW_ON_CPU = {"free_fall", "hertz", "restitution", "cantilever", "braking"}
"""Free fall takes a hundred small steps; the others many large ones."""
ON_REFERENCE = {"affine_patch", "bulk_modulus", "invariants", "scale_invariance", "gradients"}
SLOW_ON_REFERENCE = {"free_fall", "spin", "oblique_impact", "collinear_cars", "vibrating_bar"}


def failures(case, backend):
    return [check for check in CASES[case](backend) if not check.passed]


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.slow) if c in SLOW_ON_CPU else c for c in CASES],
)
@pytest.mark.timeout(600)
def test_cpu(case):
    assert not failures(case, "cpu")


@pytest.mark.parametrize(
    "case",
    [
        *sorted(ON_REFERENCE - {"gradients"}),
        *(pytest.param(c, marks=pytest.mark.slow) for c in sorted(SLOW_ON_REFERENCE)),
    ],
)
@pytest.mark.timeout(900)
def test_reference(case):
    assert not failures(case, "reference")


def test_a_check_fails_on_nan_and_outside_its_tolerance():
    assert Check("a", 1.0, 1.1, 0.2).passed
    assert not Check("a", 1.0, 1.3, 0.2).passed
    assert not Check("a", float("nan"), 1.0, 10.0).passed
