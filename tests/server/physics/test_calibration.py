"""Known parameters are recovered from the motion they caused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.physics import FixedCorotated, Metal, SolverError
from real2sim_server.physics.calibration import calibrate, jacobian, rollout

from .scenes import cube, ground, solve

DT, EVERY, TIMES = 1e-3, 4, 6
TRUE = {"stiffness": 1.3, "yield_stress": 0.8, "viscosity": 1.5, "friction": 1.2, "speed": 1.1}
SOFT = FixedCorotated(young=2e5, poisson=0.3, viscosity=100)


def pressed(material):
    """A sliding block, sunk into the ground that holds it, while it swings and creeps."""
    body = cube(
        position=(0.013, 0.027, 0.06),
        edge=0.15,
        material=material,
        velocity=(1.5, 0.2, -1),
        friction=0.3,
    )
    return solve([body], [ground(separable=False)], backend="reference")


def path_of(solver, names):
    return rollout(solver, names, dt=DT, every=EVERY, observations=TIMES)


def observed(solver, names):
    with torch.no_grad():
        return path_of(solver, names)(torch.tensor([TRUE[n] for n in names]).double().log()).numpy()


@pytest.mark.parametrize(
    "names",
    [
        ["stiffness", "friction"],
        pytest.param(["stiffness", "viscosity", "friction", "speed"], marks=pytest.mark.slow),
    ],
)
def test_known_parameters_are_recovered_from_a_trajectory(names):
    found = calibrate(
        pressed(SOFT), observed(pressed(SOFT), names), parameters=names, dt=DT, every=EVERY
    )
    assert found.residual[-1] < 1e-4 * found.residual[0]
    for name in names:
        assert found.factors[name] == pytest.approx(TRUE[name], rel=0.01), name


@pytest.mark.slow
def test_yield_stress_is_recovered():
    metal = Metal(young=2e5, poisson=0.3, yield_stress=4e3, hardening=1e4, viscosity=50)
    names = list(TRUE)
    found = calibrate(
        pressed(metal), observed(pressed(metal), names), parameters=names, dt=DT, every=EVERY
    )
    for name in names:
        assert found.factors[name] == pytest.approx(TRUE[name], rel=0.01), name


@pytest.mark.slow
def test_parameters_observed_on_finer_cells_are_found_within_uncertainty():
    names = ["stiffness", "speed"]
    body = pressed(SOFT).bodies[0]
    fine = solve([body], [ground(separable=False)], backend="reference", dx=0.075)
    found = calibrate(
        pressed(SOFT), observed(fine, names), parameters=names, dt=DT, every=EVERY, steps=10
    )
    for name in names:
        assert abs(found.factors[name] / TRUE[name] - 1) < 2 * found.uncertainty[name], name
    assert found.discretisation["stiffness"] > 0.01


@pytest.mark.slow
def test_residuals_never_rise_and_diverging_steps_are_reverted():
    start = observed(pressed(SOFT), ["speed"])
    # A hundred times too stiff is far beyond what this substep can handle.
    hard = pressed(FixedCorotated(young=8e5, poisson=0.3, viscosity=100))
    found = calibrate(hard, start, parameters=["stiffness", "speed"], dt=DT, every=EVERY, steps=3)
    assert np.isfinite(found.residual).all()
    assert (np.diff(found.residual) < 0).all()


@pytest.mark.slow
def test_a_parameter_without_effect_stays_and_is_reported_unknown():
    solver = pressed(SOFT)
    names = ["yield_stress", "speed"]
    target = observed(pressed(SOFT), ["speed"])
    found = calibrate(solver, target, parameters=names, dt=DT, every=EVERY, steps=3)
    assert found.factors["yield_stress"] == 1.0
    assert found.uncertainty["yield_stress"] == np.inf
    assert found.factors["speed"] == pytest.approx(TRUE["speed"], rel=1e-3)


def test_dual_numbers_agree_with_central_differences():
    path, at = path_of(pressed(SOFT), ["stiffness", "friction"]), torch.zeros(2).double()
    J = jacobian(path, at)
    for k in range(2):
        step = 1e-5 * torch.eye(2, dtype=torch.float64)[k]
        slope = ((path(at + step) - path(at - step)) / 2e-5).reshape(-1)
        assert (J[:, k] - slope).abs().max() < 1e-3 * slope.abs().max()


@pytest.mark.parametrize(
    ("parameters", "seen", "message"),
    [
        (["colour"], np.zeros((1, 27, 3)), "allowed are"),
        ([], np.zeros((1, 27, 3)), "allowed are"),
        (["speed"], np.zeros((1, 3, 3)), "observed must be"),
        (["speed"], np.full((1, 27, 3), np.nan), "must be finite"),
    ],
)
def test_parameters_that_cannot_be_fitted_are_named(parameters, seen, message):
    with pytest.raises(SolverError, match=message):
        calibrate(pressed(SOFT), seen, parameters=parameters, dt=DT, every=1)
