"""Gradients through the reference against central differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..backends.reference.backend import torch_model
from ..backends.reference.step import TorchParameters, TorchState, substep, with_stress
from ..colliders import Plane
from ..constitutive import material_row
from ..materials import Metal
from .check import Check, block, solve

STEPS, DT = 60, 5e-4


def gradients(backend: str = "reference") -> list[Check]:
    """How a bounce changes with stiffness, yield, viscosity, friction and speed."""
    metal = Metal(young=2e5, poisson=0.3, yield_stress=4e3, hardening=1e4, viscosity=50)
    body = block(
        metal, size=(0.2, 0.2, 0.2), at=(0.013, 0.027, 0.12), velocity=(1, 0.2, -2), friction=0.3
    )
    state, params = torch_model(solve([body], backend="reference").model)
    names = ("stiffness", "yield stress", "viscosity", "friction", "speed")
    knobs = torch.zeros(len(names), dtype=torch.float64, requires_grad=True)
    outcome = _outcome(state, params)
    [slopes] = torch.autograd.grad(outcome(knobs), [knobs])
    checks = []
    for i, name in enumerate(names):
        step = torch.zeros_like(knobs)
        step[i] = 1e-5
        with torch.no_grad():
            slope = float((outcome(knobs + step) - outcome(knobs - step)) / 2e-5)
        checks.append(Check(f"gradient: {name}", float(slopes[i]), slope, 1e-3 * abs(slope)))
    return checks


def _outcome(state: TorchState, params: TorchParameters) -> Callable[[Tensor], Tensor]:
    """Final motion as one number, of logarithms of factors on five parameters."""

    def run(knobs: Tensor) -> Tensor:
        factor = knobs.exp()
        ones = torch.ones_like(factor[0])
        columns = [ones] * material_row.MATERIAL_ROW
        columns[material_row.MU] = columns[material_row.LAMBDA] = factor[0]
        columns[material_row.A], columns[material_row.VISCOSITY] = factor[1], factor[2]
        changed = replace(
            params,
            rows=params.rows * torch.stack(columns),
            friction=params.friction * factor[3],
        )
        now = with_stress(replace(state, v=state.v * factor[4]), changed)
        for _ in range(STEPS):
            now, _ = substep(now, changed, [Plane(name="ground")], DT)
        momentum = (params.mass[:, None] * now.v).sum(0)
        return momentum @ torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)

    return run
